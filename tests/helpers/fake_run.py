"""A tiny sequence on disk and a fake system with known poses, for the tests of the runner."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bmask_slam.events import EventLog
from bmask_slam.graph.arrays import Arrays
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.files.array_file import nested, part
from bmask_slam.graph.trajectory import Trajectory, write_tum
from bmask_slam.labelling.results import LandmarkCloud
from bmask_slam.sequences.frame import Frame
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import FrameResult, TrackingStatus

CAMERA = "{width: 32, height: 24, fx: 30, fy: 31, cx: 15, cy: 12, depth_scale: 1000, fps: 10}\n"
FPS_HZ = 10.0


def make_sequence(folder: Path, count: int = 20, truth: bool = True) -> Path:
    """Frame k is stamped k / 10 s, its red is k, and its true pose is ``true_pose(k)``."""
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
        lines = [f"{k / FPS_HZ:.6f} {kind}/{k}.png" for k in range(count)]
        (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n")
    for k in range(count):
        cv2.imwrite(str(folder / f"rgb/{k}.png"), np.full((24, 32, 3), (9, 9, k), np.uint8))
        cv2.imwrite(str(folder / f"depth/{k}.png"), np.full((24, 32), 1500, np.uint16))
    (folder / "camera.yaml").write_text(CAMERA)
    if truth:
        write_tum(folder / "groundtruth.txt", true_trajectory(count))
    return folder


def true_pose(k: int) -> np.ndarray:
    """T_world_camera of frame k: on a parabola, so that the alignment is unique."""
    T = np.eye(4)
    T[:3, 3] = 0.1 * k, 0.01 * k * k, 0.0
    return T


def true_trajectory(count: int) -> Trajectory:
    return Trajectory(np.arange(count) / FPS_HZ, np.stack([true_pose(k) for k in range(count)]))


class FakeSystem:
    """A system that reads the frame number from the red channel; every seventh frame is lost.

    ``trajectory()`` is true but for ``z_error_m`` at each odd frame. ``on_frame(k)`` is called
    while frame k is processed.
    """

    def __init__(
        self,
        camera: Camera,
        config: SystemConfig,
        on_frame: Callable[[int], None] | None = None,
        z_error_m: float = 0.0,
    ) -> None:
        self.camera = camera
        self.on_frame = on_frame or (lambda k: None)
        self.z_error_m = z_error_m
        self.events = EventLog()
        self.numbers: list[int] = []
        self.finished = False
        self.restarts = 0

    def number(self, frame: Frame) -> int:
        return int(frame.rgb[0, 0, 0])

    def process(self, frame: Frame) -> FrameResult:
        k = self.number(frame)
        self.on_frame(k)
        lost = k % 7 == 6
        self.events.begin_frame(frame.index, frame.timestamp_s)
        if lost:
            self.events.lost(100 + k)
        else:
            self.events.tracked(90 + k)
            self.numbers.append(k)
        return FrameResult(
            index=frame.index,
            timestamp_s=frame.timestamp_s,
            status=TrackingStatus.LOST if lost else TrackingStatus.OK,
            T_world_camera=None if lost else true_pose(k),
            matches=100 + k,
            inliers=90 + k,
            keyframe_id=k // 5 if k % 5 == 0 else None,
            keyframe_reason="new view" if k % 5 == 0 else "",
            stage_ms={"tracking": 1000.0 + k, "keyframe": 5e6, "graph": 7e6},
            events=self.events.take(),
        )

    def finish(self) -> None:
        self.finished = True
        self.events.loop_removed((1, 2))

    def segments(self) -> dict[int, Trajectory]:
        return {0: self.trajectory()} if len(self.trajectory()) else {}

    def trajectory(self) -> Trajectory:
        poses = np.array([true_pose(k) for k in self.numbers]).reshape(-1, 4, 4)
        poses[1::2, 2, 3] += self.z_error_m
        return Trajectory(np.array(self.numbers) / FPS_HZ, poses)

    def keyframe_trajectory(self) -> Trajectory:
        keep = np.array(self.numbers, int) % 5 == 0
        return self.trajectory().select(np.flatnonzero(keep))

    def landmarks(self) -> LandmarkCloud:
        points = np.array([[1.0, 2.0, 3.0], [-4.5, 5.25, 6.0]])
        colours = np.array([[255, 1, 2], [3, 4, 250]], np.uint8)
        return LandmarkCloud(np.array([3, 8]), points, colours, np.array([2, 300]))

    def files(self) -> dict[str, Callable[[Path], None]]:
        assert self.finished
        return {name: lambda path, name=name: self.save(path, name) for name in ("graph", "map")}

    def save(self, path: Path, name: str) -> None:
        path.write_bytes(name.encode())

    def state(self) -> Arrays:
        return {
            "numbers": np.array(self.numbers, np.int64),
            **nested(events=self.events.state()),
        }

    def restore(self, state: Arrays, path: Path) -> None:
        self.numbers = state["numbers"].tolist()
        self.events.restore(part(state, "events"))

    def restart(self) -> None:
        self.restarts += 1

    def begin_session(self) -> None:
        raise NotImplementedError

    def statistics(self) -> dict[str, Any]:
        return {
            "keyframes": 4,
            "landmarks": 2,
            "loops_closed": 1,
            "isam2_update_ms": [1.0, 2.0, 9.0],
            "graph": {"factors refused": 3, "factors refused: loop, not finite": 2},
        }


def signal_at(frame: int, number: signal.Signals) -> Callable[[int], None]:
    """Sends this process a signal while the frame is processed."""
    return lambda k: os.kill(os.getpid(), number) if k == frame else None
