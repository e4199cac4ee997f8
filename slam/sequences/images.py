"""Decoding of one colour and one depth image, with every way in which they can be broken."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from graph.camera import Camera
from graph.errors import InputError

_TAIL_BYTES = 4096


def read_rgb(path: Path, camera: Camera) -> NDArray[np.uint8]:
    """The colour image (H, W, 3), red first; grey images are expanded.

    Raises:
        InputError: a missing, truncated or unreadable file, more than 8 bits a channel, or
            another size than the camera's.
    """
    bgr = _decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    if bgr.dtype != np.uint8:
        raise InputError(
            f"{path}: {8 * bgr.dtype.itemsize} bits a channel where colour is expected; "
            "list 8-bit colour images (are rgb and depth swapped?)"
        )
    _check_size(path, bgr, camera)
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)


def read_depth(path: Path, camera: Camera) -> NDArray[np.float32]:
    """The depth image (H, W) in metres (paper eq. 9: z = d / s), NaN where the sensor saw nothing.

    Raises:
        InputError: as for ``read_rgb``, and for anything but one channel of 16 bits.
    """
    stored = _decode(path, cv2.IMREAD_UNCHANGED)
    if stored.ndim == 3:
        raise InputError(
            f"{path}: {stored.shape[2]} channels where depth is expected; "
            "list 16-bit single-channel depth images (are rgb and depth swapped?)"
        )
    if stored.dtype != np.uint16:
        raise InputError(
            f"{path}: {8 * stored.dtype.itemsize}-bit depth, which is too coarse; "
            f"store 16-bit depth with {camera.depth_scale:g} to the metre"
        )
    _check_size(path, stored, camera)
    depth_m = np.divide(stored, np.float32(camera.depth_scale), dtype=np.float32)
    depth_m[stored == 0] = np.nan
    return depth_m


def _decode(path: Path, flags: int) -> NDArray:
    """The decoded image; a truncated file is refused, where OpenCV would fill it up with grey."""
    try:
        data = path.read_bytes()
    except OSError as error:
        reason = "no such image" if not path.exists() else f"cannot be read ({error.strerror})"
        raise InputError(f"{path}: {reason}; restore it or correct the list") from error
    if not data:
        raise InputError(f"{path}: the image is empty (0 bytes); restore it or correct the list")
    tail = data[-_TAIL_BYTES:]
    truncated = (data.startswith(b"\xff\xd8") and b"\xff\xd9" not in tail) or (
        data.startswith(b"\x89PNG") and b"IEND" not in tail
    )
    image = None if truncated else cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if image is None:
        reason = "truncated" if truncated else "not a readable image"
        raise InputError(f"{path}: {reason} ({len(data)} bytes); restore it or correct the list")
    return image


def _check_size(path: Path, image: NDArray, camera: Camera) -> None:
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise InputError(
            f"{path}: {width}x{height} pixels, but the camera has {camera.width}x{camera.height}; "
            "colour and registered depth must both have the size in camera.yaml"
        )
