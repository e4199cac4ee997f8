"""One registered RGB-D frame, and the checks of a frame that a caller hands in."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Floats, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.sequences.images import reduced_colour, reduced_depth, without_covered


@dataclass(frozen=True)
class Frame:
    """One registered RGB-D frame.

    Attributes:
        index: position in the sequence, from 0, counting skipped and broken frames too.
        timestamp_s: stamp of the colour image in seconds.
        rgb: (H, W, 3) uint8, red first.
        depth_m: (H, W) float32 z-depth in metres, NaN where missing.
        name: file name of the colour image relative to its sequence, for looking up its masks.
        depth_lag_s: stamp of the depth image less that of the colour image. Depth that was
            interpolated at the colour image's time, for a camera with ``depth_time_offset_s``, has
            the lag ``-depth_time_offset_s``.
    """

    index: int
    timestamp_s: float
    rgb: Image
    depth_m: Floats
    name: str = ""
    depth_lag_s: float = 0.0


def check_frame(frame: Frame, camera: Camera, last_stamp_s: float = -math.inf) -> Frame:
    """The frame as tracking needs it: float32 depth, NaN where it was 0 or the image is covered.

    The colour image is contiguous, also where a view such as ``bgr[..., ::-1]`` was given.

    Args:
        last_stamp_s: stamp of the frame before.

    Raises:
        InputError: an image that is no array of the camera's size and the type that ``Frame``
            states (depth may be of any float type), depth that is negative or infinite, or a stamp
            that is not finite or not later than ``last_stamp_s``.
    """
    _check_stamp(frame.timestamp_s, last_stamp_s)
    where, size = f"frame at {frame.timestamp_s}", (camera.height, camera.width)
    if _kind(frame.rgb) != "uint8" or frame.rgb.shape != (*size, 3):
        raise InputError(
            f"{where}: colour is {_described(frame.rgb)}, the camera gives uint8 {(*size, 3)}; "
            "resize it, or correct the camera"
        )
    if not _kind(frame.depth_m).startswith("float") or frame.depth_m.shape != size:
        raise InputError(
            f"{where}: depth is {_described(frame.depth_m)}; give metres as float32 {size}, "
            "registered to the colour image"
        )
    depth_m = _checked_depth(frame.depth_m, where)
    if camera.covered:
        depth_m = without_covered(depth_m.copy(), camera)
    return replace(frame, rgb=np.ascontiguousarray(frame.rgb), depth_m=depth_m)


def reduced_frame(frame: Frame, k: int) -> Frame:
    """A frame with images at a k-th of their size, NaN where depth is missing."""
    if k == 1:
        return frame
    depth_m = reduced_depth(frame.depth_m, k)
    depth_m[depth_m == 0] = np.nan
    return replace(frame, rgb=reduced_colour(frame.rgb, k), depth_m=depth_m)


def check_finite_stamp(stamp_s: float) -> None:
    """Raise InputError for a stamp that is no finite number."""
    if not isinstance(stamp_s, Real) or not math.isfinite(stamp_s):
        raise InputError(f"frame at {stamp_s!r}: the stamp is not a finite number of seconds")


def _check_stamp(stamp_s: float, last_stamp_s: float) -> None:
    check_finite_stamp(stamp_s)
    if stamp_s <= last_stamp_s:
        raise InputError(
            f"frame at {stamp_s}: not later than the frame before, at {last_stamp_s}; leave it "
            "out, or begin a new run if the clock was set back"
        )


def _checked_depth(depth_m: NDArray[np.floating], where: str) -> Floats:
    """Depth (H, W) as float32 with NaN in place of 0; the caller's array where nothing changes."""
    with np.errstate(over="ignore"):  # float64 beyond float32 becomes infinite
        known_m = depth_m.astype(np.float32, copy=False)
    lowest_m = np.fmin.reduce(known_m, axis=None)
    if lowest_m < 0 or np.isposinf(np.fmax.reduce(known_m, axis=None)):
        raise InputError(f"{where}: depth is negative or infinite; write NaN where it is missing")
    return np.where(known_m == 0, np.float32(np.nan), known_m) if lowest_m == 0 else known_m


def _kind(image: Any) -> str:
    """The name of an array's type; empty for what is no array."""
    return str(image.dtype) if isinstance(image, np.ndarray) else ""


def _described(image: Any) -> str:
    """Type and shape of an array, or what else it is."""
    return f"{image.dtype} {image.shape}" if _kind(image) else f"a {type(image).__name__}"
