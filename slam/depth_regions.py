"""Pieces of a depth image that hang together: what moves in part moves as a whole."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from graph.geometry import Array
from slam.landmarks import Mask
from slam.static_check import Depths, Verdicts

_FAR_M = np.float32(1e6)


@dataclass(frozen=True)
class DepthRegionConfig:
    """When samples belong together, and when their region moves.

    Samples lie ``step_px`` apart both ways; neighbours whose depths differ by less than ``jump``
    of it are one region, which parts a floor that falls away steeply from who stands on it. A
    region moves if at least ``least`` of its samples lie in free space and they are at least
    ``share`` of those that views speak of: a surface that stood still can never lie in free
    space, but what moves often lies near where it, or something else, was. A region of more than
    ``largest`` of all samples is no single thing.
    """

    step_px: int = 16
    jump: float = 0.03
    least: int = 6
    share: float = 0.15
    largest: float = 0.5

    def __post_init__(self) -> None:
        if self.step_px < 1 or self.least < 1 or self.jump <= 0:
            raise ValueError("step_px and least must be at least 1, jump positive")
        if not (0 < self.share <= 1 and 0 < self.largest <= 1):
            raise ValueError("share and largest must be in (0, 1]")


@dataclass(frozen=True, eq=False)
class DepthRegions:
    """The regions of a depth image at every ``step``-th pixel both ways.

    Attributes:
        labels: (h, w) number of each sample's region, 0 where depth is missing.
        depth_m: (h, w) NaN where missing.
    """

    labels: NDArray[np.int32]
    depth_m: Depths
    config: DepthRegionConfig

    def moving(self, verdicts: Verdicts) -> Mask:
        """Which samples (h, w) are of moving regions, by what views say about each (h, w)."""
        count = int(self.labels.max()) + 1
        labels = self.labels.ravel()
        free, surface, size = (
            np.bincount(labels, weights=chosen.ravel(), minlength=count)
            for chosen in (verdicts < 0, verdicts > 0, np.ones(verdicts.shape))
        )
        moves = (free >= self.config.least) & (free >= self.config.share * (free + surface))
        moves &= size <= self.config.largest * len(labels)
        moves[0] = False
        return np.asarray(moves[self.labels])

    def on(self, moving: Mask, pixels: Array, depth_m: Array) -> Mask:
        """Which keypoints (N, 2) with depths (N,), NaN where missing, are on moving samples (h, w).

        Of the samples around a keypoint some must move, and it must be as far away as they are, or
        have no depth.
        """
        window, slack = np.ones((3, 3), np.uint8), 2 * self.config.jump
        nearest = cv2.erode(np.where(moving, self.depth_m, _FAR_M), window)
        farthest = cv2.dilate(np.where(moving, self.depth_m, -_FAR_M), window)
        height, width = self.labels.shape
        columns, rows = np.rint(pixels / self.config.step_px).astype(np.int64).T
        place = np.minimum(rows, height - 1), np.minimum(columns, width - 1)
        low, high = nearest[place] * (1 - slack), farthest[place] * (1 + slack)
        return (low < high) & ~((depth_m < low) | (depth_m > high))


def depth_regions(depth_m: Depths, config: DepthRegionConfig) -> DepthRegions:
    """The regions of a depth image (H, W) in metres, NaN where missing."""
    few = depth_m[:: config.step_px, :: config.step_px]
    there = np.isfinite(few)
    links = np.zeros((2 * few.shape[0] - 1, 2 * few.shape[1] - 1), np.uint8)
    links[::2, ::2] = there
    links[::2, 1::2] = np.abs(np.diff(few, axis=1)) < config.jump * few[:, 1:]
    links[1::2, ::2] = np.abs(np.diff(few, axis=0)) < config.jump * few[1:]
    _, labels = cv2.connectedComponents(links, connectivity=4, ltype=cv2.CV_32S)
    return DepthRegions(np.ascontiguousarray(labels[::2, ::2], np.int32), few, config)
