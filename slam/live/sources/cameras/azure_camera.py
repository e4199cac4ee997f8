"""Frames from a connected Azure Kinect by pyk4a, depth aligned to colour; no recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.extras import import_extra
from bmask_slam.live.sources.cameras.camera_source import (
    CameraImages,
    CameraSource,
    chosen_camera,
)
from bmask_slam.sequences.checks import check_sizes
from bmask_slam.sequences.images import Lens, depth_in_metres

SIZE, FPS = (1280, 720), 30
DEPTH_SCALE = 1000.0
POLL_MS = 200


class AzureSource(CameraSource):
    """Device N: colour 1280x720, depth in the narrow field of view, both at 30 Hz.

    The lens has OpenCV's rational distortion, from which the five coefficients of a camera file
    differ by pixels; images are undistorted here, unless a camera file is given that is of the
    images as recorded.
    """

    def __init__(self, device: int, camera: Path | None = None, silence_s: float = 10.0) -> None:
        """Start the device.

        Raises:
            InputError: pyk4a is not installed, or there is no such device.
        """
        super().__init__(f"azure-{device}", silence_s)
        self._pyk4a: Any = import_extra("pyk4a", "azure:", "azure")
        k4a = self._pyk4a
        config = k4a.Config(
            color_resolution=k4a.ColorResolution.RES_720P,
            color_format=k4a.ImageFormat.COLOR_BGRA32,
            depth_mode=k4a.DepthMode.NFOV_UNBINNED,
            camera_fps=k4a.FPS.FPS_30,
            synchronized_images_only=True,
        )
        self._failures = (k4a.K4AException,)
        self._device = k4a.PyK4A(config, device_id=device)
        try:
            self._device.start()
        except k4a.K4AException as error:
            reason = str(error) or type(error).__name__
            raise InputError(f"{self.name}: cannot start ({reason}); plug the camera in") from error
        self._lens: Lens | None = None
        try:
            kind = k4a.CalibrationType.COLOR
            K = np.array(self._device.calibration.get_camera_matrix(kind), float)
            own = Camera(
                *SIZE, K[0, 0], K[1, 1], K[0, 2], K[1, 2], depth_scale=DEPTH_SCALE, fps=FPS
            )
            self.camera = chosen_camera(camera, own, f"{self.name}'s depth")
            terms = self._device.calibration.get_distortion_coefficients(kind)
            lens = Lens(own, tuple(float(term) for term in terms))
            if not lens.is_of_recorded(self.camera):
                self._lens = lens
        except BaseException:
            self._release()
            raise

    def _capture_images(self) -> CameraImages | None:
        try:
            capture = self._device.get_capture(POLL_MS)
        except self._pyk4a.K4ATimeoutException:
            return None
        colour, stored = capture.color, capture.transformed_depth
        if colour is None or stored is None:
            self.counts.unpaired_rgb += colour is not None
            self.counts.unpaired_depth += stored is not None
            return None
        rgb = np.asarray(cv2.cvtColor(colour, cv2.COLOR_BGRA2RGB), np.uint8)
        check_sizes(rgb, stored, self.camera, self.name)
        if self._lens is not None:
            rgb = self._lens.undistorted_colour(rgb)
            stored = self._lens.undistorted_depth(stored)
        stamp_s = 1e-6 * capture.color_timestamp_usec
        return CameraImages(stamp_s, rgb, depth_in_metres(stored, self.camera))

    def _release(self) -> None:
        self._device.stop()
