"""Registration of depth to the colour camera, where both cameras and their places are known."""

from __future__ import annotations

import math
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Floats
from bmask_slam.graph.camera import Camera
from bmask_slam.sequences.images import SURFACE_STEP

DENSER = 1.05
"""Depth is enlarged until its pixels lie nearer than colour's by this, so that none is missed."""
MAX_FACTOR = 8
"""Largest factor by which a coarse depth image is enlarged."""


def register_depth(
    depth_m: Floats, depth_camera: Camera, T_colour_depth: Array, colour: Camera
) -> Floats:
    """Depth (H, W) in metres of the colour camera's pixels, NaN where it is not known.

    Each depth pixel (h, w) is lifted, moved by ``p_colour = T_colour_depth @ p_depth`` and
    projected, with the distortion of both cameras; of several in one pixel the nearest counts, so
    that what the colour camera sees hides what is behind it. A depth image that is not finer than
    the colour image is enlarged first: its inverse depth is linear between neighbours on one
    surface.
    """
    factor = min(math.ceil(DENSER * colour.fx / depth_camera.fx), MAX_FACTOR)
    z_m = _enlarged(depth_m, factor).ravel()
    directions = _directions(depth_camera, factor, np.asarray(T_colour_depth, float).tobytes())
    x, y, z = (
        z_m * d + np.float32(t) for d, t in zip(directions, T_colour_depth[:3, 3], strict=True)
    )
    columns, rows = _projected(x, y, z, colour)
    with np.errstate(invalid="ignore"):
        inside = (z > 0) & (columns >= 0) & (columns < colour.width)
        inside &= (rows >= 0) & (rows < colour.height)
    places = rows[inside].astype(np.int64) * colour.width + columns[inside].astype(np.int64)
    nearest_m = np.full(colour.width * colour.height, np.inf, np.float32)
    np.minimum.at(nearest_m, places, z[inside])
    nearest_m[np.isinf(nearest_m)] = np.nan
    return nearest_m.reshape(colour.height, colour.width)


def _projected(x: Floats, y: Floats, z: Floats, camera: Camera) -> tuple[NDArray, NDArray]:
    """Columns and rows (N,), whole but of a float type, of points in the camera's frame."""
    with np.errstate(invalid="ignore", divide="ignore"):
        if any(camera.distortion):
            points = np.stack([x, y, np.where(z > 0, z, np.nan)], axis=-1)
            columns, rows = camera.project_distorted(points.astype(float)).T
        else:
            columns = x / z * np.float32(camera.fx) + np.float32(camera.cx)
            rows = y / z * np.float32(camera.fy) + np.float32(camera.cy)
        return np.floor(columns + np.float32(0.5)), np.floor(rows + np.float32(0.5))


def _enlarged(depth_m: Floats, factor: int) -> Floats:
    """Depth (f h, f w) of depth (h, w): linear in 1/z on a surface, that of a pixel at edges."""
    if factor == 1:
        return depth_m
    size = (factor * depth_m.shape[1], factor * depth_m.shape[0])
    nearest_m = cv2.resize(depth_m, size, interpolation=cv2.INTER_NEAREST)
    with np.errstate(divide="ignore", invalid="ignore"):
        linear_m = 1 / cv2.resize(1 / depth_m, size, interpolation=cv2.INTER_LINEAR)
        one_surface = np.abs(linear_m - nearest_m) < SURFACE_STEP * nearest_m
    return np.where(one_surface, linear_m, nearest_m).astype(np.float32)


@lru_cache(4)
def _directions(camera: Camera, factor: int, T_colour_depth: bytes) -> Floats:
    """Points (3, f h f w) at z = 1 of the pixels of an enlarged image, turned as colour's frame."""
    rows, columns = np.mgrid[: factor * camera.height, : factor * camera.width]
    pixels = (np.stack([columns, rows], axis=-1).reshape(-1, 2) + 0.5) / factor - 0.5
    rays = camera.backproject(camera.undistort(pixels), np.ones(len(pixels)))
    R = np.frombuffer(T_colour_depth).reshape(4, 4)[:3, :3]
    return np.ascontiguousarray((rays @ R.T).T, np.float32)
