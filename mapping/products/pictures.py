"""Pictures of a cloud without a display: points through a z-buffer, classes by colour."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Bytes, Image, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, transform

BACKGROUND_COLOUR = (150, 150, 150)
EMPTY = 255


def palette(classes: int) -> Bytes:
    """Colours (classes, 3) of labels: grey for the background, else hues far from each other."""
    colours = [BACKGROUND_COLOUR]
    for k in range(1, classes):
        hue = (k * 0.618034) % 1.0  # the golden ratio spreads any number of hues
        rgb = colorsys.hsv_to_rgb(hue, (0.85, 0.6)[k % 2], (0.95, 0.75)[k // 2 % 2])
        colours.append((round(255 * rgb[0]), round(255 * rgb[1]), round(255 * rgb[2])))
    return np.array(colours, np.uint8)


class Picture:
    """An image into which points are drawn, nearest on top.

    Attributes:
        camera: its intrinsics.
        T_world_camera: (4, 4).
    """

    def __init__(self, camera: Camera, T_world_camera: Array, point_m: float) -> None:
        """``point_m`` is the edge of the square that stands for a point."""
        self.camera, self.T_world_camera = camera, T_world_camera
        self._point_m = point_m
        self._depth = np.full((camera.height, camera.width), np.inf, np.float32)
        self._rgb = np.full((camera.height, camera.width, 3), EMPTY, np.uint8)

    def draw(self, points_world: NDArray[np.floating], colours: Bytes) -> None:
        """Draw points (N, 3) with colours (N, 3)."""
        points = transform(inverse(self.T_world_camera), points_world.astype(float))
        front = points[:, 2] > 0.05
        points, colours = points[front], colours[front]
        pixels = np.rint(self.camera.project(points)).astype(np.int64)
        size_px = np.ceil(self._point_m * self.camera.fx / points[:, 2]).astype(np.int64)
        for dy, dx in _offsets(int(np.clip(size_px.max(initial=1), 1, 9))):
            reach = np.maximum(abs(dy), abs(dx)) <= size_px // 2
            self._put(pixels[reach] + (dx, dy), points[reach, 2], colours[reach])

    def _put(self, pixels: Ints, z: Array, colours: Bytes) -> None:
        height, width = self._depth.shape
        inside = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
        index = pixels[inside, 1] * width + pixels[inside, 0]
        z32 = z[inside].astype(np.float32)
        nearest = np.full(height * width, np.inf, np.float32)
        np.minimum.at(nearest, index, z32)
        depth, rgb = self._depth.reshape(-1), self._rgb.reshape(-1, 3)
        won = (z32 == nearest[index]) & (z32 < depth[index])
        depth[index[won]], rgb[index[won]] = z32[won], colours[inside][won]

    def image(self) -> Image:
        """(H, W, 3) uint8, red first, white where nothing is."""
        return self._rgb


def _offsets(size: int) -> list[tuple[int, int]]:
    half = size // 2
    steps = range(-half, half + 1)
    return [(dy, dx) for dy in steps for dx in steps]


def with_legend(image: Image, names: Sequence[str], labels: Sequence[int]) -> Bytes:
    """The image with a column of class names and colours at its right."""
    colours = palette(len(names))
    column = np.full((max(image.shape[0], 24 * len(labels) + 16), 190, 3), EMPTY, np.uint8)
    for row, label in enumerate(labels):
        y = 16 + 24 * row
        colour = [int(c) for c in colours[label]]
        cv2.rectangle(column, (8, y - 8), (24, y + 8), colour, -1)
        cv2.putText(
            column, names[label], (32, y + 5), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1,
            cv2.LINE_AA,
        )  # fmt: skip
    missing = column.shape[0] - image.shape[0]
    padded = cv2.copyMakeBorder(
        image, 0, missing, 0, 0, cv2.BORDER_CONSTANT, value=(EMPTY, EMPTY, EMPTY)
    )
    return np.hstack([padded, column])
