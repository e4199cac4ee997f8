"""Pictures of a cloud: its nearest point at each pixel, in their colours or labels'."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Bytes, Image, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.files.whole_file import whole_file, writing
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.semantics.instances.image_files import write_image

BACKGROUND_COLOUR, WALL_COLOUR = (150, 150, 150), (70, 70, 80)
WALL = "wall"
EMPTY = 255
NEAREST_M, MAX_SIZE_PX = 0.05, 9


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


def nearest_points(
    points_world: NDArray[np.floating], camera: Camera, T_world_camera: Array, point_m: float
) -> Ints:
    """The number of the nearest point (N, 3) at each pixel (H, W), -1 where there is none.

    A point is drawn as a square with the edge ``point_m``, of at most MAX_SIZE_PX.
    """
    points = transform(inverse(T_world_camera), points_world.astype(float))
    ahead = np.flatnonzero(points[:, 2] > NEAREST_M)
    ahead = ahead[np.argsort(-points[ahead, 2], kind="stable")]  # the nearest last
    z, pixels = points[ahead, 2], np.rint(camera.project(points[ahead])).astype(np.int64)
    half = np.clip(np.ceil(point_m * camera.fx / z), 1, MAX_SIZE_PX).astype(np.int64) // 2
    order, reach = np.full(camera.height * camera.width, -1), int(half.max(initial=0))
    for dy, dx in product(range(-reach, reach + 1), repeat=2):
        u, v = pixels[:, 0] + dx, pixels[:, 1] + dy
        inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        rows = np.flatnonzero(inside & (half >= max(abs(dy), abs(dx))))
        at = v[rows] * camera.width + u[rows]
        drawn = np.full(len(order), -1)
        drawn[at] = rows
        np.maximum(order, drawn, out=order)
    found = np.where(order < 0, -1, ahead[order] if len(ahead) else -1)
    return np.asarray(found.reshape(camera.height, camera.width))


def painted(numbers: Ints, colours: Bytes) -> Image:
    """An image (H, W, 3), red first, of the colours (N, 3) of points (H, W); white without one."""
    image = np.full((*numbers.shape, 3), EMPTY, np.uint8)
    image[numbers >= 0] = colours[numbers[numbers >= 0]]
    return image


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


def write_picture(path: Path, image: Image) -> Path:
    """Save an image (H, W, 3), red first; returns its path. Raises InputError if it cannot."""
    with writing(path), whole_file(path) as temporary:
        write_image(temporary, image)
    return path
