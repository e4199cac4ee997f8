"""Pictures of a cloud: points drawn into an image with a z-buffer, in their colours or labels'."""

from __future__ import annotations

import colorsys
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Bytes, Image, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.graph.whole_file import whole_file
from bmask_slam.mapping.products.cloud import Cloud

BACKGROUND_COLOUR, WALL_COLOUR = (150, 150, 150), (70, 70, 80)
WALL = "wall"
EMPTY = 255


def palette(names: Sequence[str]) -> Bytes:
    """Colours (C, 3) of labels: greys for background and walls, distinct hues for the others."""
    colours = [BACKGROUND_COLOUR]
    for k, name in enumerate(names[1:], 1):
        if name == WALL:
            colours.append(WALL_COLOUR)
            continue
        hue = (k * 0.618034) % 1.0  # steps of the golden ratio keep any number of hues apart
        rgb = colorsys.hsv_to_rgb(hue, (0.85, 0.6)[k % 2], (0.95, 0.75)[k // 2 % 2])
        colours.append((round(255 * rgb[0]), round(255 * rgb[1]), round(255 * rgb[2])))
    return np.array(colours, np.uint8)


class Picture:
    """An image into which points are drawn with a z-buffer.

    Attributes:
        camera: its intrinsics.
        T_world_camera: (4, 4).
    """

    def __init__(self, camera: Camera, T_world_camera: Array, point_m: float) -> None:
        """``point_m`` is the edge of the square that a point is drawn as."""
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
        """(H, W, 3) uint8, red first, white where no point was drawn."""
        return self._rgb


def _offsets(size: int) -> list[tuple[int, int]]:
    half = size // 2
    steps = range(-half, half + 1)
    return [(dy, dx) for dy in steps for dx in steps]


def with_legend(image: Image, names: Sequence[str], labels: Sequence[int]) -> Bytes:
    """The image (H, W, 3) with a column of class names and colours at its right."""
    colours = palette(names)
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


class CloudPictures:
    """Pictures of a cloud from several viewpoints, in the points' colours and in their labels'.

    Attributes:
        names: of the labels.
        palette: (C, 3), their colours.
        counts: (C,), number of points drawn with each label.
    """

    def __init__(
        self, views: Mapping[str, tuple[Camera, Array]], point_m: float, names: Sequence[str]
    ) -> None:
        """``views`` are cameras with their T_world_camera (4, 4), by name."""
        self.names, self.palette = names, palette(names)
        self.counts = np.zeros(len(names), np.int64)
        self._coloured = {n: Picture(*view, point_m) for n, view in views.items()}
        self._labelled = {n: Picture(*view, point_m) for n, view in views.items()}

    @property
    def present(self) -> list[int]:
        """Labels of the points drawn."""
        return [int(k) for k in np.flatnonzero(self.counts)]

    def draw(self, cloud: Cloud) -> None:
        """Draw the points into all pictures."""
        self.counts += np.bincount(cloud.labels, minlength=len(self.names))
        for picture in self._coloured.values():
            picture.draw(cloud.points, cloud.colours)
        for picture in self._labelled.values():
            picture.draw(cloud.points, self.palette[cloud.labels])

    def write(self, folder: Path) -> list[Path]:
        """Save view_NAME.png, and view_NAME_semantic.png if there are several labels."""
        images = {f"view_{n}.png": p.image() for n, p in self._coloured.items()}
        if len(self.present) > 1:
            for n, p in self._labelled.items():
                image = with_legend(p.image(), self.names, self.present)
                images[f"view_{n}_semantic.png"] = image
        return [write_picture(folder / name, image) for name, image in images.items()]


def write_picture(path: Path, image: Image) -> Path:
    """Save an image (H, W, 3), red first; returns its path. Raises InputError if it cannot."""
    with whole_file(path) as temporary:
        if not cv2.imwrite(str(temporary), cv2.cvtColor(image, cv2.COLOR_RGB2BGR)):
            raise InputError(f"{path}: cannot be written; free some space")
    return path
