"""Frames from a depth camera by OpenCV and OpenNI 2, such as a Kinect or an Astra."""

from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np

from bmask_slam.graph.errors import InputError
from bmask_slam.live.sources.cameras.camera_source import CameraImages, CameraSource
from bmask_slam.sequences.cameras import given_camera
from bmask_slam.sequences.checks import check_depth_scale, check_sizes
from bmask_slam.sequences.images import depth_in_metres

DEPTH_SCALE = 1000.0
"""Stored depth of one metre: OpenNI gives millimetres."""


class OpenCvSource(CameraSource):
    """Device N of OpenNI 2, depth registered to colour; stamps are this computer's clock."""

    def __init__(self, device: int, camera: Path | None, silence_s: float = 10.0) -> None:
        """Open the device.

        Raises:
            InputError: no camera.yaml is given (OpenCV does not know the intrinsics), or the device
                cannot be opened or cannot register depth to colour.
        """
        super().__init__(f"opencv-{device}", silence_s)
        if camera is None:
            raise InputError(f"{self.name}: OpenCV does not know the intrinsics; give --camera F")
        self.camera = given_camera(camera)
        check_depth_scale(self.camera, DEPTH_SCALE, str(camera), f"{self.name}'s depth")
        self._capture = cv2.VideoCapture(device, cv2.CAP_OPENNI2)
        registration = cv2.CAP_OPENNI_DEPTH_GENERATOR_REGISTRATION
        reason = ""
        if not self._capture.isOpened():
            reason = "cannot be opened; plug it in, and use an OpenCV with OpenNI 2"
        elif not (self._capture.set(registration, 1) and self._capture.get(registration)):
            reason = "does not register depth to colour; use a device that does"
        if reason:
            self._release()
            raise InputError(f"{self.name}: {reason}")

    def _capture_images(self) -> CameraImages | None:
        if not self._capture.grab():
            return None
        stamp_s = time.time()
        has_depth, stored = self._capture.retrieve(None, cv2.CAP_OPENNI_DEPTH_MAP)
        has_rgb, bgr = self._capture.retrieve(None, cv2.CAP_OPENNI_BGR_IMAGE)
        if not (has_depth and has_rgb):
            self.counts.unpaired_rgb += bool(has_rgb)
            self.counts.unpaired_depth += bool(has_depth)
            return None
        check_sizes(bgr, stored, self.camera, self.name)
        rgb = np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)
        return CameraImages(stamp_s, rgb, depth_in_metres(stored, self.camera))

    def _release(self) -> None:
        self._capture.release()
