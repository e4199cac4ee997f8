"""Frames from a Luxonis OAK with stereo, by depthai 3; the device aligns depth to colour."""

from __future__ import annotations

import time
from datetime import timedelta
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
from bmask_slam.sequences.images import depth_in_metres

SIZE, STEREO_SIZE, FPS = (640, 480), (640, 400), 30
DEPTH_SCALE = 1000.0
SYNC_S = 0.02
FIRST_S = 15.0
COLOUR, DEPTH = "colour", "depth"


class OakSource(CameraSource):
    """The first connected OAK: 640x480 at 30 Hz, undistorted on the device."""

    def __init__(self, camera: Path | None = None, silence_s: float = 10.0) -> None:
        """Start the device, and wait for its first frame, which tells the intrinsics.

        Raises:
            InputError: depthai is not installed, there is no device, or it gives nothing.
        """
        super().__init__("oak", silence_s)
        self._dai: Any = import_extra("depthai", "oak:", "oak")
        try:
            self._pipeline = self._dai.Pipeline()
            self._queue = self._stream()
            self._pipeline.start()
        except RuntimeError as error:
            raise InputError(f"oak: cannot start ({error}); plug the camera in") from error
        try:
            self._first: Any = self._wait_for_first()
            self.camera = chosen_camera(camera, self._own_camera(), "oak's depth")
        except BaseException:
            self._release()
            raise

    def _stream(self) -> Any:
        """Colour, depth by the stereo pair, and their partners in time: a queue of groups."""
        dai, make = self._dai, self._pipeline.create
        socket, node = dai.CameraBoardSocket, dai.node
        colour = make(node.Camera).build(socket.CAM_A)
        stereo = make(node.StereoDepth)
        stereo.setRectifyEdgeFillColor(0)
        for where, eye in ((socket.CAM_B, stereo.left), (socket.CAM_C, stereo.right)):
            make(node.Camera).build(where).requestOutput(STEREO_SIZE, fps=FPS).link(eye)
        images = colour.requestOutput(
            SIZE, dai.ImgFrame.Type.RGB888i, dai.ImgResizeMode.CROP, FPS, True
        )
        depth = stereo.depth
        if self._pipeline.getDefaultDevice().getPlatform() == dai.Platform.RVC4:
            align = make(node.ImageAlign)
            depth.link(align.input)
            images.link(align.inputAlignTo)
            depth = align.outputAligned
        else:
            images.link(stereo.inputAlignTo)
        sync = make(node.Sync)
        sync.setSyncThreshold(timedelta(seconds=SYNC_S))
        images.link(sync.inputs[COLOUR])
        depth.link(sync.inputs[DEPTH])
        return sync.out.createOutputQueue(maxSize=4, blocking=False)

    def _wait_for_first(self) -> Any:
        end_s = time.monotonic() + FIRST_S
        while time.monotonic() < end_s:
            group = self._queue.tryGet()
            if group is not None:
                return group
            time.sleep(0.01)
        raise InputError(f"oak: no frame within {FIRST_S:g} s; use a USB 3 cable and socket")

    def _own_camera(self) -> Camera:
        """The pinhole of the device's undistorted colour image."""
        image = self._first[COLOUR]
        K = np.array(image.getTransformation().getIntrinsicMatrix(), float)
        width, height = image.getWidth(), image.getHeight()
        return Camera(
            width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2], depth_scale=DEPTH_SCALE, fps=FPS
        )

    def _capture_images(self) -> CameraImages | None:
        group, self._first = self._first, None
        if group is None:
            group = self._queue.tryGet()
        if group is None:
            return None
        colour, depth = group[COLOUR], group[DEPTH]
        rgb = np.asarray(cv2.cvtColor(colour.getCvFrame(), cv2.COLOR_BGR2RGB), np.uint8)
        stored = np.asarray(depth.getFrame())
        check_sizes(rgb, stored, self.camera, self.name)
        stamp_s = colour.getTimestamp().total_seconds()
        return CameraImages(stamp_s, rgb, depth_in_metres(stored, self.camera))

    def _release(self) -> None:
        self._pipeline.stop()
