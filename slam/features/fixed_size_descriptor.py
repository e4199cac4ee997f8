"""BRISK descriptors of keypoints of one size, vectorised over the keypoints.

The pattern, its smoothing, orientation and bits are those of Leutenegger, Chli and Siegwart 2011,
in OpenCV's order of points and bits, so that these descriptors match those of OpenCV. OpenCV
describes one keypoint at a time, which takes four times as long.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Bits, Floats, Image

RING_POINTS = (1, 10, 14, 15, 20)
RING_RADII = (0.0, 2.465, 4.165, 6.29, 9.18)
SHORTEST_LONG, LONGEST_SHORT = 8.2, 5.85
"""Limits of the point distances: pairs for the orientation, pairs for the bits."""
SMOOTHING = 1.3
"""Half the side of a point's box, in distances of neighbours on its ring."""
_SIZE_STEP = np.log2(30.0) / 64
"""Octaves from one size of BRISK's table to the next; its first is of 7.2 px."""
_GAIN = 64
"""Of smoothed intensities, which are whole numbers."""


class FixedSizeBrisk:
    """Describes keypoints of one size in pixels, as OpenCV's ``KeyPoint.size`` counts it.

    Attributes:
        reach_px: largest distance from a keypoint at which the image is sampled.
    """

    def __init__(self, size_px: float) -> None:
        step = int(np.log2(size_px / 7.2) / _SIZE_STEP + 0.5)
        scale = 2.0 ** (step * _SIZE_STEP)
        ring = np.repeat(np.arange(len(RING_POINTS)), RING_POINTS)
        turn = np.concatenate([np.arange(n) / n for n in RING_POINTS]) * 2 * np.pi
        points = np.array(RING_RADII)[ring, None] * np.column_stack([np.cos(turn), np.sin(turn)])
        self._points = (scale * points).astype(np.float32)
        self._ring = ring
        spacing = np.array(
            [0.5, *(np.array(RING_RADII) * np.sin(np.pi / np.array(RING_POINTS)))[1:]]
        )
        sides = 2 * SMOOTHING * scale * spacing
        self._kernels = [box_kernel(side) for side in sides]
        self.reach_px = int(np.ceil(np.abs(self._points).max() + max(sides) / 2)) + 1
        i, j = np.tril_indices(len(points), -1)
        apart = points[j] - points[i]
        length = np.linalg.norm(apart, axis=1)
        is_short, is_long = length < LONGEST_SHORT, length > SHORTEST_LONG
        self._pairs = i[is_short], j[is_short]
        pull = (apart / length[:, None] ** 2)[is_long]
        gradient = np.zeros(points.shape)
        np.add.at(gradient, i[is_long], pull)
        np.add.at(gradient, j[is_long], -pull)
        self._gradient = np.ascontiguousarray(gradient.T, np.float32)

    def describe(self, gray: Image, pixels: Floats) -> tuple[Bits, Array]:
        """Descriptors (N, 8) uint64 and orientations (N,) in radians of pixels (N, 2).

        Each must be at least ``reach_px`` away from the border of the image (H, W).
        """
        if not len(pixels):
            return np.zeros((0, 8), np.uint64), np.zeros(0)
        rings = self._smoothed(gray)
        x, y = self._points[:, :1], self._points[:, 1:]
        first = (self._ring * gray.shape[0]).astype(np.float32)[:, None]
        u, v = pixels.T.astype(np.float32)
        v = v + first
        values = cv2.remap(rings, u + x, v + y, cv2.INTER_LINEAR)
        dx, dy = self._gradient @ values.astype(np.float32)
        norm = np.hypot(dx, dy)
        flat = norm < 1  # rounding
        dx[flat], dy[flat], norm[flat] = 1, 0, 1
        cos, sin = dx / norm, dy / norm
        values = cv2.remap(
            rings, u + (x * cos - y * sin), v + (x * sin + y * cos), cv2.INTER_LINEAR
        )
        bits = values[self._pairs[0]] > values[self._pairs[1]]
        columns = cv2.transpose(bits.view(np.uint8))
        packed = np.packbits(columns, axis=1, bitorder="little")
        return packed.view(np.uint64), np.arctan2(dy, dx).astype(float) % (2 * np.pi)

    def _smoothed(self, gray: Image) -> NDArray[np.int16]:
        """The image (H, W) smoothed for every ring, one below the other: (5 H, W)."""
        height = len(gray)
        rings = np.empty((len(self._kernels) * height, gray.shape[1]), np.int16)
        for number, kernel in enumerate(self._kernels):
            here = rings[number * height : (number + 1) * height]
            cv2.sepFilter2D(gray, cv2.CV_16S, kernel, _GAIN * kernel, dst=here)
        return rings


def box_kernel(side_px: float) -> Array:
    """Weights of the mean over a box of this side, which may cover its outermost pixels in part."""
    reach = int(np.ceil((side_px - 1) / 2))
    weights = np.ones(2 * reach + 1)
    weights[[0, -1]] = (side_px - (2 * reach - 1)) / 2
    return weights / side_px
