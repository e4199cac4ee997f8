"""Frames from an iPhone or iPad on USB, by the app Record3D and its library."""

from __future__ import annotations

import threading
import time
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

TRUE_DEPTH = 0
POLL_S, FIRST_S = 0.2, 15.0
FPS = 30
MIN_M, MAX_M = 0.05, 20.0


class Record3dSource(CameraSource):
    """Device N in the app's USB streaming mode; stamps are this computer's clock.

    Depth is coarser than colour, and enlarged to it without mixing near and far. The front camera's
    images are mirrored, and are turned back.
    """

    def __init__(self, device: int, camera: Path | None = None, silence_s: float = 10.0) -> None:
        """Connect, and wait for the first frame, which tells the intrinsics.

        Raises:
            InputError: record3d is not installed, there is no such device, or it gives nothing.
        """
        super().__init__(f"record3d-{device}", silence_s)
        self._library: Any = import_extra("record3d", "record3d:", "record3d")
        devices = self._library.Record3DStream.get_connected_devices()
        if device >= len(devices):
            cure = "plug it in, open Record3D, and start its USB streaming"
            raise InputError(f"{self.name}: {len(devices)} devices are connected; {cure}")
        self._new, self._stamp_s = threading.Event(), 0.0
        self._stream = self._library.Record3DStream()
        self._stream.on_new_frame = self._on_frame
        self._stream.on_stream_stopped = self._closed.set  # no release in the library's thread
        if not self._stream.connect(devices[device]):
            raise InputError(f"{self.name}: does not connect; start USB streaming in Record3D")
        try:
            if not self._new.wait(FIRST_S):
                raise InputError(f"{self.name}: no frame within {FIRST_S:g} s; start the streaming")
            self.camera = chosen_camera(camera, self._own_camera(), f"{self.name}'s depth")
        except BaseException:
            self._release()
            raise

    def _on_frame(self) -> None:
        """Called by the library's thread."""
        self._stamp_s = time.time()
        self._new.set()

    @property
    def _is_mirrored(self) -> bool:
        return bool(self._stream.get_device_type() == TRUE_DEPTH)

    def _own_camera(self) -> Camera:
        """The colour image's pinhole, in metres as the depth that comes."""
        height, width = np.asarray(self._stream.get_rgb_frame()).shape[:2]
        K = self._stream.get_intrinsic_mat()
        cx = width - 1 - K.tx if self._is_mirrored else K.tx
        return Camera(width, height, K.fx, K.fy, cx, K.ty, depth_scale=1.0, fps=FPS)

    def _capture_images(self) -> CameraImages | None:
        if not self._new.wait(POLL_S):
            return None
        self._new.clear()
        stamp_s = self._stamp_s
        rgb = np.array(self._stream.get_rgb_frame(), np.uint8)
        depth_m = np.array(self._stream.get_depth_frame(), np.float32)
        if self._is_mirrored:
            rgb, depth_m = rgb[:, ::-1].copy(), depth_m[:, ::-1].copy()
        size = rgb.shape[1], rgb.shape[0]
        depth_m = np.asarray(cv2.resize(depth_m, size, interpolation=cv2.INTER_NEAREST))
        depth_m[~((depth_m > MIN_M) & (depth_m < MAX_M))] = np.nan
        check_sizes(rgb, depth_m, self.camera, self.name)
        return CameraImages(stamp_s, rgb, depth_m)

    def _release(self) -> None:
        self._stream.disconnect()
