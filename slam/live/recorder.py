"""Writes files while a live run goes on; what cannot be written does not end the run."""

from __future__ import annotations

import logging
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.trajectory import Trajectory, write_tum
from bmask_slam.live.health import Health
from bmask_slam.run_folder.folder import CAMERA, HEALTH, RunFolder
from bmask_slam.sequences.cameras import format_camera
from bmask_slam.tracking.results import FrameResult

logger = logging.getLogger(__name__)

HEALTH_S = 1.0
SNAPSHOT_S = 5.0
SNAPSHOT_SHARE = 0.005
"""Largest share of the time that is spent on trajectory.txt, which takes longer as it grows."""
MESSAGE_S = 60.0
"""Interval of the message that something cannot be written."""


class Recorder:
    """Writes frames.csv, and now and then health.json and trajectory.txt, into a run folder.

    Attributes:
        unwritten: how often something could not be written, as on a full disk.
    """

    def __init__(self, folder: RunFolder) -> None:
        self.folder = folder
        self.unwritten = 0
        self._message_s = -np.inf
        self._health_s = time.monotonic()
        self._snapshot_due_s = self._health_s + SNAPSHOT_S

    def camera(self, camera: Camera, text: str) -> None:
        """Write the camera that was found, with a comment that says how."""
        self._guarded(lambda: self.folder.write_text(CAMERA, format_camera(camera, text)))

    def frames_apart(self, lost: list[Trajectory], first: int) -> None:
        """Write the frames of keyframes that no map has, as segments numbered from ``first``."""
        for number, frames in enumerate(lost, first):
            self.folder.write_trajectory(frames, f"trajectory_segment_{number}.txt")

    def frame(
        self,
        result: FrameResult,
        health: Callable[[], Health],
        trajectory: Callable[[], Trajectory],
    ) -> None:
        """Write a frame, and the other files when they are due; what cannot be is logged."""
        self._guarded(lambda: self._write(result, health, trajectory))

    def _guarded(self, write: Callable[[], None]) -> None:
        try:
            write()
        except Exception as error:  # no file is worth the tracking
            self.unwritten += 1
            if time.monotonic() - self._message_s > MESSAGE_S:
                self._message_s = time.monotonic()
                if isinstance(error, OSError | InputError):
                    cure = "free some space or change permissions before it ends"
                    logger.error("%s; tracking goes on, %s", error, cure)
                else:
                    logger.exception("a file of the run was not written; tracking goes on")

    def _write(
        self,
        result: FrameResult,
        health: Callable[[], Health],
        trajectory: Callable[[], Trajectory],
    ) -> None:
        self.folder.write_frame(result)
        now_s = time.monotonic()
        if now_s >= self._snapshot_due_s:
            self._snapshot_due_s = now_s + SNAPSHOT_S
            self.folder.write_trajectory(trajectory())
            took_s = time.monotonic() - now_s
            self._snapshot_due_s = now_s + max(SNAPSHOT_S, took_s / SNAPSHOT_SHARE)
        if now_s - self._health_s >= HEALTH_S:
            self._health_s = now_s
            self.folder.write_text(HEALTH, health().as_json())


def rescued(trajectory: Trajectory) -> str:
    """Write a trajectory to the temporary folder; returns a text that says where, or why not."""
    try:
        path = Path(tempfile.mkdtemp(prefix="bmask-slam-")) / "trajectory.txt"
        write_tum(path, trajectory)
    except (OSError, InputError) as error:
        return f"nor could it be written to {tempfile.gettempdir()} ({error})"
    return f"the whole trajectory is in {path}"
