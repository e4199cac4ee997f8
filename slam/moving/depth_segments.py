"""Connected segments of a depth image: a segment that moves in part moves as a whole.

Unobserved samples that are connected to a moving segment (a carried box) move with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Floats, Ints, Mask
from bmask_slam.moving.free_space_check import PointMotion, PointMotions

_FAR_M = np.float32(1e6)


@dataclass(frozen=True)
class DepthSegmentConfig:
    """When samples form a segment, and when a segment moves.

    Samples lie ``step_px`` apart in both directions. Neighbours whose depths differ by less than
    ``jump`` times the depth are in one segment; a steep floor is thereby separated from a person on
    it. A segment moves if at least ``least`` of its samples lie in free space, and these are at
    least ``share`` of the samples that earlier views observed: a static surface is never in free
    space, but a moving one is often near a place where a surface was. A segment of more than
    ``largest`` of all samples is not taken as one thing.

    Samples that no view observed are carried by a moving segment if they are connected to it with
    depth differences below ``held_jump`` (larger than ``jump``, for the side of a box), and are at
    most ``load`` times as many as its samples.
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
    """The segments of a depth image, at every ``step``-th pixel in both directions.

    Attributes:
        labels: (h, w) number of the segment of each sample, 0 where depth is missing.
        depth_m: (h, w) NaN where missing.
    """

    labels: NDArray[np.int32]
    depth_m: Floats
    config: DepthSegmentConfig

    def moving(self, point_motions: PointMotions) -> Mask:
        """Mask (h, w) of samples in moving segments, from the motion (h, w) by earlier views."""
        count = int(self.labels.max()) + 1
        labels = self.labels.ravel()
        free, surface, size = (
            np.bincount(labels, weights=chosen.ravel(), minlength=count)
            for chosen in (
                point_motions == PointMotion.MOVING,
                point_motions == PointMotion.STATIC,
                np.ones(point_motions.shape),
            )
        )
        moves = (free >= self.config.least) & (free >= self.config.share * (free + surface))
        moves &= size <= self.config.largest * len(labels)
        moves[0] = False
        return np.asarray(moves[self.labels])

    def carried(self, moving: Mask, point_motions: PointMotions) -> Mask:
        """Mask (h, w) of samples that moving ones (h, w) carry, such as a box held by a person.

        Only samples that no view observed: a table that the person touches was observed as static.
        Carried and moving samples are split into connected pieces; in each the load must not be too
        large for what carries it, nor both together too large for one thing.
        """
        free_to_go = ~moving & (point_motions == PointMotion.UNKNOWN) & (self.labels > 0)
        pieces = _joined_up(self.depth_m, moving | free_to_go, self.config.held_jump)
        count = int(pieces.max()) + 1
        holder, load = (np.bincount(pieces[k], minlength=count) for k in (moving, free_to_go))
        carries = (load <= self.config.load * holder) & (load > 0)
        carries &= holder + load <= self.config.largest * pieces.size
        return np.asarray(free_to_go & carries[pieces])

    def space(self, moving: Mask) -> MovingSpace:
        """The depth ranges of moving samples (h, w)."""
        window, slack = np.ones((3, 3), np.uint8), 2 * self.config.jump
        nearest = cv2.erode(np.where(moving, self.depth_m, _FAR_M), window)
        farthest = cv2.dilate(np.where(moving, self.depth_m, -_FAR_M), window)
        return MovingSpace(nearest * (1 - slack), farthest * (1 + slack), self.config.step_px)


@dataclass(frozen=True, eq=False)
class MovingSpace:
    """Depth ranges of the moving things in an image.

    Attributes:
        low_m, high_m: (h, w) around every ``step_px``-th pixel in both directions; nothing moves
            where ``high_m`` is less.
    """

    low_m: Floats
    high_m: Floats
    step_px: int

    def on(self, pixels: Array, depth_m: Array) -> Mask:
        """Mask (N,) of the pixels (N, 2) with depths (N,), NaN where missing, on moving things.

        Some of the samples around a pixel must move, and its depth must be in their range, or
        missing.
        """
        columns, rows = np.rint(pixels / self.step_px).astype(np.int64).T
        return self._at((self._inside(rows, 0), self._inside(columns, 1)), depth_m)

    def covers(self, depth_m: Floats, step: int) -> Mask:
        """Mask (H', W') of every ``step``-th pixel in both directions, by the same rule."""
        rows, columns = (np.rint(np.arange(n) * step / self.step_px) for n in depth_m.shape)
        place = self._inside(rows.astype(np.int64), 0), self._inside(columns.astype(np.int64), 1)
        return self._at(np.ix_(*place), depth_m)

    def _inside(self, places: Ints, axis: int) -> Ints:
        return np.minimum(places, self.low_m.shape[axis] - 1)

    def _at(self, place: tuple[Ints, ...], depth_m: Array | Floats) -> Mask:
        low_m, high_m = self.low_m[place], self.high_m[place]
        return np.asarray((low_m < high_m) & ~((depth_m < low_m) | (depth_m > high_m)))


def depth_segments(depth_m: Floats, config: DepthSegmentConfig) -> DepthSegments:
    """The segments of a depth image (H, W) in metres, NaN where missing."""
    few = depth_m[:: config.step_px, :: config.step_px]
    return DepthSegments(_joined_up(few, np.isfinite(few), config.jump), few, config)


def _joined_up(depth_m: Floats, chosen: Mask, jump: float) -> NDArray[np.int32]:
    """Numbers (h, w) of the connected pieces of ``chosen`` samples (h, w), 0 for the others.

    Neighbours are connected if their depths differ by less than ``jump`` times the depth.
    """
    links = np.zeros((2 * depth_m.shape[0] - 1, 2 * depth_m.shape[1] - 1), np.uint8)
    links[::2, ::2] = chosen
    links[::2, 1::2] = np.abs(np.diff(depth_m, axis=1)) < jump * depth_m[:, 1:]
    links[1::2, ::2] = np.abs(np.diff(depth_m, axis=0)) < jump * depth_m[1:]
    _, labels = cv2.connectedComponents(links, connectivity=4, ltype=cv2.CV_32S)
    return np.ascontiguousarray(labels[::2, ::2], np.int32)
