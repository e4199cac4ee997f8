"""Frames as a caller hands them in, checked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.sequences.frame import Frame


def checked(frame: Frame, camera: Camera, last_s: float) -> Frame:
    """The frame with NaN where it has no depth.

    Raises:
        InputError: an image of another size or type than the camera's, or a stamp that is not later
            than ``last_s``.
    """
    rgb, depth_m, stamp_s = frame.rgb, frame.depth_m, frame.timestamp_s
    height, width = camera.height, camera.width
    if rgb.shape != (height, width, 3) or rgb.dtype != np.uint8:
        raise InputError(
            f"frame at {stamp_s}: colour is {rgb.dtype} {rgb.shape}, the camera gives "
            f"uint8 ({height}, {width}, 3); resize it, or correct the camera"
        )
    if depth_m.shape != (height, width) or depth_m.dtype.kind != "f":
        raise InputError(
            f"frame at {stamp_s}: depth is {depth_m.dtype} {depth_m.shape}; give metres as "
            f"float ({height}, {width}), registered to the colour image"
        )
    if not stamp_s > last_s:
        raise InputError(
            f"frame at {stamp_s}: not later than the one before, at {last_s}; leave "
            "it out, or begin anew if the clock was set back"
        )
    known = depth_m.astype(np.float32, copy=False)
    if (missing := known <= 0).any():  # most sources say NaN, and a copy costs a millisecond
        known = np.where(missing, np.float32(np.nan), known)
    return replace(frame, depth_m=known)
