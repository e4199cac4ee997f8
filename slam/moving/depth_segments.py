"""Pieces of a depth image that hang together: what moves in part moves as a whole.

What moves also takes along what it holds, of which no view says anything.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Floats, Ints, Mask
from bmask_slam.moving.free_space_check import PointMotions

_FAR_M = np.float32(1e6)


@dataclass(frozen=True)
class DepthSegmentConfig:
    """When samples belong together, and when their region moves.

    Samples lie ``step_px`` apart both ways; neighbours whose depths differ by less than ``jump``
    of it are one region, which parts a floor that falls away steeply from who stands on it. A
    region moves if at least ``least`` of its samples lie in free space and they are at least
    ``share`` of those that views speak of: a surface that stood still can never lie in free
    space, but what moves often lies near where it, or something else, was. A region of more than
    ``largest`` of all samples is no single thing.

    Samples that no view speaks of are held by what moves if they are joined to it by depths that
    differ by less than ``held_jump``, more than ``jump`` since the side of a box falls away, and
    if they are at most ``load`` times as many.
    """

    step_px: int = 16
    jump: float = 0.03
    least: int = 6
    share: float = 0.15
    largest: float = 0.5
    held_jump: float = 0.12
    load: float = 2.0

    def __post_init__(self) -> None:
        if self.step_px < 1 or self.least < 1 or self.jump <= 0:
            raise ValueError("step_px and least must be at least 1, jump positive")
        if not (0 < self.share <= 1 and 0 < self.largest <= 1):
            raise ValueError("share and largest must be in (0, 1]")
        if self.held_jump <= 0 or self.load < 0:
            raise ValueError("held_jump must be positive, load not negative")


@dataclass(frozen=True, eq=False)
class DepthSegments:
    """The regions of a depth image at every ``step``-th pixel both ways.

    Attributes:
        labels: (h, w) number of each sample's region, 0 where depth is missing.
        depth_m: (h, w) NaN where missing.
    """

    labels: NDArray[np.int32]
    depth_m: Floats
    config: DepthSegmentConfig

    def moving(self, point_motions: PointMotions) -> Mask:
        """Which samples (h, w) are of moving regions, by what views say about each (h, w)."""
        count = int(self.labels.max()) + 1
        labels = self.labels.ravel()
        free, surface, size = (
            np.bincount(labels, weights=chosen.ravel(), minlength=count)
            for chosen in (point_motions < 0, point_motions > 0, np.ones(point_motions.shape))
        )
        moves = (free >= self.config.least) & (free >= self.config.share * (free + surface))
        moves &= size <= self.config.largest * len(labels)
        moves[0] = False
        return np.asarray(moves[self.labels])

    def held(self, moving: Mask, point_motions: PointMotions) -> Mask:
        """Which samples (h, w) moving ones (h, w) take along, as a man does a box before him.

        Only samples that no view speaks of: a table that he touches was seen to stand. They and
        the moving ones fall into pieces; in each the load must not be too large for its holder,
        nor both together for a single thing, as all of a space that was never seen would be.
        """
        free_to_go = ~moving & (point_motions == 0) & (self.labels > 0)
        pieces = _joined_up(self.depth_m, moving | free_to_go, self.config.held_jump)
        count = int(pieces.max()) + 1
        holder, load = (np.bincount(pieces[k], minlength=count) for k in (moving, free_to_go))
        takes = (load <= self.config.load * holder) & (load > 0)
        takes &= holder + load <= self.config.largest * pieces.size
        return np.asarray(free_to_go & takes[pieces])

    def space(self, moving: Mask) -> MovingSpace:
        """Where moving samples (h, w) are."""
        window, slack = np.ones((3, 3), np.uint8), 2 * self.config.jump
        nearest = cv2.erode(np.where(moving, self.depth_m, _FAR_M), window)
        farthest = cv2.dilate(np.where(moving, self.depth_m, -_FAR_M), window)
        return MovingSpace(nearest * (1 - slack), farthest * (1 + slack), self.config.step_px)


@dataclass(frozen=True, eq=False)
class MovingSpace:
    """Between which depths an image's moving things lie.

    Attributes:
        low_m, high_m: (h, w) around every ``step_px``-th pixel both ways; nothing moves where
            ``high_m`` is less.
    """

    low_m: Floats
    high_m: Floats
    step_px: int

    def on(self, pixels: Array, depth_m: Array) -> Mask:
        """Which keypoints (N, 2) with depths (N,), NaN where missing, are on moving things.

        Of the samples around a keypoint some must move, and it must be as far away as they are, or
        have no depth.
        """
        columns, rows = np.rint(pixels / self.step_px).astype(np.int64).T
        return self._at((self._inside(rows, 0), self._inside(columns, 1)), depth_m)

    def covers(self, depth_m: Floats, step: int) -> Mask:
        """Which of every ``step``-th pixel both ways (H', W') are on moving things, likewise."""
        rows, columns = (np.rint(np.arange(n) * step / self.step_px) for n in depth_m.shape)
        place = self._inside(rows.astype(np.int64), 0), self._inside(columns.astype(np.int64), 1)
        return self._at(np.ix_(*place), depth_m)

    def _inside(self, places: Ints, axis: int) -> Ints:
        return np.minimum(places, self.low_m.shape[axis] - 1)

    def _at(self, place: tuple[Ints, ...], depth_m: Array | Floats) -> Mask:
        low_m, high_m = self.low_m[place], self.high_m[place]
        return np.asarray((low_m < high_m) & ~((depth_m < low_m) | (depth_m > high_m)))


def depth_segments(depth_m: Floats, config: DepthSegmentConfig) -> DepthSegments:
    """The regions of a depth image (H, W) in metres, NaN where missing."""
    few = depth_m[:: config.step_px, :: config.step_px]
    return DepthSegments(_joined_up(few, np.isfinite(few), config.jump), few, config)


def _joined_up(depth_m: Floats, chosen: Mask, jump: float) -> NDArray[np.int32]:
    """Numbers (h, w) of the pieces of ``chosen`` samples (h, w), 0 for the others.

    Neighbours hang together if their depths differ by less than ``jump`` of it.
    """
    links = np.zeros((2 * depth_m.shape[0] - 1, 2 * depth_m.shape[1] - 1), np.uint8)
    links[::2, ::2] = chosen
    links[::2, 1::2] = np.abs(np.diff(depth_m, axis=1)) < jump * depth_m[:, 1:]
    links[1::2, ::2] = np.abs(np.diff(depth_m, axis=0)) < jump * depth_m[1:]
    _, labels = cv2.connectedComponents(links, connectivity=4, ltype=cv2.CV_32S)
    return np.ascontiguousarray(labels[::2, ::2], np.int32)
