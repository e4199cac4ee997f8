"""Tracking's side of calibration: when the camera is estimated, and what came of it.

The process gets each keyframe's images, and the depth images around it. After so many frames with
one camera the map's process is asked for a state, and the calibration's process estimates from
that. Neither tracking nor the map waits for it, and a process that dies is not started again.
"""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass

from bmask_slam.calibration.edge_delay import MAX_DELAY_S
from bmask_slam.calibration.keyframe_depth import DepthImage, KeyframeImages
from bmask_slam.graph.arrays import Array, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.live.messages import CameraEstimated, EstimateCamera
from bmask_slam.live.processes.calibration_process import CalibrationSetup
from bmask_slam.live.processes.remote_mapper import RemoteMapper
from bmask_slam.live.processes.worker import Failure, Worker
from bmask_slam.sequences.frame import Frame
from bmask_slam.world.keyframe import Keyframe

logger = logging.getLogger(__name__)

NICENESS = 19
READ_AHEAD = 10
"""Frames at most that a source has made with the camera before."""
WAIT_S = 180.0
"""Longest time that a source which can wait is kept waiting for an estimate; one takes seconds."""
TARGET = "bmask_slam.live.processes.calibration_process:serve_calibration"


@dataclass(frozen=True, eq=False)
class _Pending:
    """A keyframe that waits for the depth image after it."""

    id: int
    rgb: Image
    pixels: Array
    lag_s: float


class RemoteCalibration:
    """Sends depth images of keyframes to a process, and asks it for estimates.

    Attributes:
        done: no further estimate will come.
        busy: an estimate is under way.
        adopts: whether what is found is used.
        text: the last of what was found, in one line; "" before.
    """

    def __init__(self, setup: CalibrationSetup) -> None:
        """Start the process."""
        self.done = self.busy = False
        self.text = ""
        self._due = setup.config.frames
        self.adopts = setup.mode == "auto"
        self._sends_colour = setup.looks_at_edges
        self._worker = Worker("calibration", TARGET, setup, NICENESS)
        self._frames = 0
        self._waited_until_s = 0.0  # 0: no longer
        self._asked: int | None = None  # the number of the message that asks for a state
        self._last: list[DepthImage] = []
        self._pending: _Pending | None = None
        self._frames_left = 0  # until a bent map begins anew at last

    @property
    def pid(self) -> int:
        """Process id."""
        return self._worker.pid

    @property
    def is_awaited(self) -> bool:
        """Whether a source that can wait waits for an estimate: not for one that takes too long."""
        if not (self.adopts and self.busy and self._waited_until_s):
            return False
        if time.monotonic() >= self._waited_until_s:
            self._waited_until_s = 0.0
            text = "the calibration has not answered for %.0f s; tracking goes on without it"
            logger.warning(text, WAIT_S)
        return bool(self._waited_until_s)

    def add_frame(self, frame: Frame, keyframe: Keyframe | None) -> None:
        """Add a tracked frame, and the keyframe that it has become, if it has."""
        self._frames += 1
        if self.done or self.busy:
            self._last, self._pending = [], None
            return
        taken_s = frame.timestamp_s + frame.depth_lag_s
        self._last = [*self._last[-2:], DepthImage(frame.depth_m.copy(), taken_s)]
        before, pending = self._last[:-1], self._pending
        if pending is not None and len(before) == 2:
            self._worker.send(
                KeyframeImages(
                    id=pending.id,
                    rgb=pending.rgb,
                    pixels=pending.pixels,
                    depth=before[1],
                    before=before[0],
                    after=self._last[-1],
                    lag_s=pending.lag_s,
                )
            )
        self._pending = None
        if keyframe is not None and before:
            pixels = keyframe.features.image_pixels
            rgb = (frame.rgb if self._sends_colour else frame.rgb[:0]).copy()
            self._pending = _Pending(keyframe.id, rgb, pixels, frame.depth_lag_s)

    def begins_anew(self, frame: Frame, camera: Camera) -> bool:
        """Whether the map, which the camera before has bent, begins anew with this frame.

        With the first one whose depth is by the new camera, since some were read ahead, or after
        ``READ_AHEAD`` others.
        """
        if not self._frames_left:
            return False
        follows = abs(frame.depth_lag_s + camera.depth_time_offset_s) < MAX_DELAY_S
        self._frames_left = 0 if follows else self._frames_left - 1
        return not self._frames_left

    def update(self, mapper: RemoteMapper) -> CameraEstimated | None:
        """Ask for an estimate when it is due; returns one that has come."""
        if self.done:
            return None
        if not self.busy and self._frames >= self._due:
            self._due *= 2
            mapper.save_state()
            self.busy, self._asked = True, mapper.worker.sent
            self._waited_until_s = time.monotonic() + WAIT_S
        if self._asked is not None:
            self._begin_estimate(mapper, self._asked)
        for message in self._worker.receive():
            match message:
                case CameraEstimated():
                    return self._answered(message)
                case Failure():
                    logger.error("the calibration failed: %s", message.text)
        if not self._worker.is_running:
            logger.warning("the calibration's process died; the camera stays as it is")
            self.end()
        return None

    def _begin_estimate(self, mapper: RemoteMapper, asked: int) -> None:
        """Send the state that was asked for, once it is there; if it cannot come, give it up."""
        worker = mapper.worker
        is_skipped = mapper.given_up or not worker.lacks(asked - 1, asked)
        if worker.saved >= asked and worker.state is not None:
            self._asked = None
            self._worker.send(EstimateCamera(worker.state))
        elif mapper.handled >= asked or is_skipped:
            logger.warning("calibration: the map's state was not saved; it is tried again later")
            self._asked, self.busy = None, False

    def end(self) -> None:
        """End the process, without waiting for it."""
        self.done, self.busy = True, False
        threading.Thread(target=self._worker.kill, daemon=True).start()

    def close(self) -> None:
        """Kill the process."""
        self._worker.kill()

    def _answered(self, found: CameraEstimated) -> CameraEstimated:
        self.busy, self.text = False, found.text or self.text
        if found.bent:
            self._frames_left = READ_AHEAD
        logger.info("calibration: %s", found.text or "nothing new")
        if found.done:
            self.end()
        return found
