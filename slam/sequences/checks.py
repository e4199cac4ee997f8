"""What a source needs before it is used: images that fit the camera."""

from __future__ import annotations

from numpy.typing import NDArray

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError

SCALE_TOLERANCE = 0.1
"""Largest relative difference between a calibrated depth scale and the nominal one."""


def check_sizes(
    rgb: NDArray, stored: NDArray, camera: Camera, where: str, depth_camera: Camera | None = None
) -> None:
    """Check that colour (H, W, 3) and stored depth (h, w) have the size of their cameras.

    Depth without a camera of its own is registered to colour.

    Raises:
        InputError: one has another size; ``where`` begins the text.
    """
    size = (camera.height, camera.width)
    if depth_camera is not None:
        if stored.shape != (depth_camera.height, depth_camera.width):
            raise InputError(
                f"{where}: depth has {stored.shape[1]}x{stored.shape[0]} pixels, its camera_info "
                f"{depth_camera.width}x{depth_camera.height}"
            )
        stored = rgb[..., 0]
    if rgb.shape[:2] != size or stored.shape != size:
        (rgb_height, rgb_width), (height, width) = rgb.shape[:2], stored.shape
        raise InputError(
            f"{where}: colour has {rgb_width}x{rgb_height} pixels, depth {width}x{height}, the "
            f"camera {camera.width}x{camera.height}; depth must be registered to colour and all "
            "three have one size, or a bag tell the depth camera and where it is"
        )


def check_depth_scale(camera: Camera, scale: float, given: str, where: str) -> None:
    """Check a camera file's depth scale against the scale that the images are known to have.

    Raises:
        InputError: they differ; ``given`` is the camera file, ``where`` the source.
    """
    if abs(camera.depth_scale / scale - 1) > SCALE_TOLERANCE:
        raise InputError(
            f"{given}: depth_scale is {camera.depth_scale:g}, but {where} has {scale:g} to the "
            f"metre; write depth_scale: {scale:g}"
        )
