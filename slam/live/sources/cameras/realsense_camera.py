"""Frames from an Intel RealSense, depth aligned to colour."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.extras import import_extra, load_libusb
from bmask_slam.live.sources.cameras.camera_source import (
    CameraImages,
    CameraSource,
    chosen_camera,
    fit_distortion,
    pixel_grid,
)
from bmask_slam.live.sources.pairing import MAX_DIFFERENCE_S
from bmask_slam.sequences.camera_presets import is_preset
from bmask_slam.sequences.images import depth_in_metres

SIZE = (640, 480)
FPS = 30
POLL_MS = 200


class RealSenseSource(CameraSource):
    """The first connected device, 640x480 at 30 Hz, or a recording that plays in its place."""

    def __init__(
        self, camera: Path | None = None, silence_s: float = 10.0, recording: Path | None = None
    ) -> None:
        """Start the device; ``recording`` is a file of RealSense's own tools.

        Raises:
            InputError: pyrealsense2 is not installed, there is no device, or its distortion cannot
                be described by OpenCV's model.
        """
        super().__init__("realsense" if recording is None else recording.stem, silence_s)
        load_libusb()
        self._rs: Any = import_extra("pyrealsense2", "realsense:", "realsense")
        rs = self._rs
        self._pipeline, self._align = rs.pipeline(), rs.align(rs.stream.color)
        streams = rs.config()
        size: tuple[int, ...] = SIZE
        if recording is not None:
            if not recording.is_file():
                raise InputError(f"{recording}: no such recording")
            streams.enable_device_from_file(str(recording), repeat_playback=False)
            size = ()  # as it was recorded
        rate_hz = FPS if recording is None else 0
        streams.enable_stream(rs.stream.color, *size, rs.format.rgb8, rate_hz)
        streams.enable_stream(rs.stream.depth, *size, rs.format.z16, rate_hz)
        self._is_recorded = recording is not None
        try:
            self._profile = profile = self._pipeline.start(streams)
        except RuntimeError as error:
            cure = "plug the camera in" if recording is None else "record colour (RGB8) and depth"
            raise InputError(f"realsense: cannot start ({error}); {cure}") from error
        try:
            self.camera = self._find_camera(profile, camera)
        except BaseException:
            self._release()
            raise

    def _capture_images(self) -> CameraImages | None:
        received, images = self._pipeline.try_wait_for_frames(POLL_MS)
        if not received:
            if self._is_recorded and self._has_ended():
                self.close()
            return None
        aligned = self._align.process(images)
        colour, depth = aligned.get_color_frame(), aligned.get_depth_frame()
        if not colour or not depth or _lag_s(colour, depth) > MAX_DIFFERENCE_S:
            self.counts.unpaired_rgb += bool(colour)
            self.counts.unpaired_depth += bool(depth)
            return None
        rgb = np.array(np.asanyarray(colour.get_data()), np.uint8)
        stored = np.asanyarray(depth.get_data())
        return CameraImages(
            1e-3 * colour.get_timestamp(), rgb, depth_in_metres(stored, self.camera)
        )

    def _has_ended(self) -> bool:
        playback = self._profile.get_device().as_playback()
        return bool(playback.current_status() == self._rs.playback_status.stopped)

    def _release(self) -> None:
        self._pipeline.stop()

    def _find_camera(self, profile: Any, given: Path | None) -> Camera:
        """The given camera, or the device's own calibration."""
        scale = 1.0 / float(profile.get_device().first_depth_sensor().get_depth_scale())
        if given is not None and not is_preset(given):  # its distortion need not fit OpenCV's
            nominal = Camera(*SIZE, 1.0, 1.0, 0.0, 0.0, depth_scale=scale)
            return chosen_camera(given, nominal, "realsense's depth")
        return chosen_camera(given, self._own_camera(profile, scale), "realsense's depth")

    def _own_camera(self, profile: Any, scale: float) -> Camera:
        """The device's calibration, whose depth is ``scale`` to the metre."""
        stream = profile.get_stream(self._rs.stream.color).as_video_stream_profile()
        i = stream.get_intrinsics()
        plain = Camera(i.width, i.height, i.fx, i.fy, i.ppx, i.ppy, depth_scale=scale, fps=FPS)
        if not any(i.coeffs):
            return plain
        pixels, rays = self._samples(i)
        return fit_distortion(plain, pixels, rays)

    def _samples(self, intrinsics: Any) -> tuple[Array, Array]:
        """Pixels (N, 2) on a grid, and their rays (N, 2) at z = 1 by the device's model."""
        pixels = pixel_grid(intrinsics.width, intrinsics.height)
        deproject = self._rs.rs2_deproject_pixel_to_point
        return pixels, np.array([deproject(intrinsics, list(p), 1.0)[:2] for p in pixels])


def _lag_s(colour: Any, depth: Any) -> float:
    """Time between the two images; 0 where their stamps are of different clocks."""
    if colour.get_frame_timestamp_domain() != depth.get_frame_timestamp_domain():
        return 0.0
    return abs(1e-3 * (depth.get_timestamp() - colour.get_timestamp()))
