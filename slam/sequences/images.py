"""Decoding of colour and depth images, with checks for all ways in which they can be broken."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Floats, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.instances.image_files import decode_image, read_colour

SURFACE_STEP = 0.05
"""Relative change of depth from one depth image to the next beyond which the surface changed."""


def read_rgb(path: Path, camera: Camera) -> Image:
    """The colour image (H, W, 3), red first; grey images are expanded.

    Raises:
        InputError: a missing, truncated or unreadable file, more than 8 bits a channel, or
            another size than the camera's.
    """
    rgb = read_colour(path)
    check_size(path, rgb, camera)
    return rgb


def read_depth(path: Path, camera: Camera) -> Floats:
    """The depth image (H, W) in metres (paper eq. 9: z = d / s, and an offset), NaN where missing.

    Raises:
        InputError: as for ``read_rgb``, and for anything but one channel of 16 bits.
    """
    stored = decode_image(path, cv2.IMREAD_UNCHANGED)
    check_depth_type(path, stored, camera)
    check_size(path, stored, camera)
    return depth_in_metres(stored, camera)


def check_depth_type(path: Path, stored: NDArray, camera: Camera) -> None:
    """Refuse what is not one channel of 16 bits or float32. Raises InputError."""
    if stored.ndim == 3:
        raise InputError(
            f"{path}: {stored.shape[2]} channels where depth is expected; "
            "list 16-bit single-channel depth images (are rgb and depth swapped?)"
        )
    if stored.dtype not in (np.uint16, np.float32):
        raise InputError(
            f"{path}: {8 * stored.dtype.itemsize}-bit depth, which is too coarse; "
            f"store 16-bit depth with {camera.depth_scale:g} to the metre"
        )


def depth_in_metres(stored: NDArray, camera: Camera) -> Floats:
    """Depth (H, W) in metres from stored values, integers or floats.

    Paper eq. 9 and an offset, 1/z less the camera's ``depth_distortion``; NaN where the values are
    0, negative or not finite.
    """
    depth_m = np.divide(stored, np.float32(camera.depth_scale), dtype=np.float32)
    if camera.depth_offset_m:
        depth_m += np.float32(camera.depth_offset_m)
    if any(camera.depth_distortion):
        with np.errstate(invalid="ignore", divide="ignore"):
            depth_m /= 1 - depth_m * _depth_bend(camera)
    depth_m[~((stored > 0) & (depth_m > 0) & (depth_m < np.inf))] = np.nan
    return depth_m


@lru_cache(2)
def _depth_bend(camera: Camera) -> Floats:
    """What the sensor adds to the inverse depth of each pixel (H, W), in 1/m."""
    v, u = np.mgrid[: camera.height, : camera.width]
    return camera.depth_bend(np.stack([u, v], axis=-1)).astype(np.float32)


def depth_between(near_m: Floats, other_m: Floats, share: float) -> Floats:
    """Depth (H, W) at a time between two depth images, ``share`` of the way to the other.

    At a fixed pixel on a surface the INVERSE depth changes linearly (exactly for a plane and a
    small motion). Where the two show different surfaces it cannot be told which one the pixel shows
    in between: NaN. Where the other one has no depth, the value is that of the nearer image.
    """
    one_surface = np.abs(near_m - other_m) < SURFACE_STEP * near_m
    with np.errstate(divide="ignore"):
        between = near_m * other_m / (other_m + np.float32(share) * (near_m - other_m))
    return np.where(one_surface, between, np.where(np.isnan(other_m), near_m, np.float32(np.nan)))


def check_size(path: Path, image: NDArray, camera: Camera) -> None:
    """Refuse an image of another size than the camera's. Raises InputError."""
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise InputError(
            f"{path}: {width}x{height} pixels, but the camera has {camera.width}x{camera.height}; "
            "colour and registered depth must both have the size in camera.yaml"
        )
