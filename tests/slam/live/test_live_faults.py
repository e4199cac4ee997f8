"""Real faults around the live loop: the trajectory is saved and no process remains."""

from __future__ import annotations

import logging
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from faults import LONG_S, Clock, fill, running, wait_until
from feeding import track_frames
from synthetic_view import CAMERA, PlaneViews, sideways_path

from bmask_slam.config.configuration import resolve
from bmask_slam.graph.arrays import Image
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.trajectory import read_tum
from bmask_slam.live.channel import Channel
from bmask_slam.live.live_slam import LiveOptions, LiveSlam
from bmask_slam.live.messages import ImageToSegment, Started
from bmask_slam.live.play import PlayOptions, play
from bmask_slam.live.processes import segmentation, supervision
from bmask_slam.live.processes.segmentation import RemoteSegmenter
from bmask_slam.live.processes.supervision import RestartPolicy, SupervisedWorker
from bmask_slam.live.recorder import HEALTH_S
from bmask_slam.live.sources.source import MeasuredSource, SourceCounts
from bmask_slam.run_folder.reader import Run
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions
from bmask_slam.sequences.frame import Frame
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import TrackingStatus

SETTINGS = ["keyframes.min_interval_frames=2", "keyframes.max_shared=0.9"]
CONFIG = resolve(SystemConfig, None, SETTINGS)
FRAMES = PlaneViews(sideways_path(0.02 * np.arange(20)))


def test_tracking_continues_while_the_disk_is_full(small_disk, caplog) -> None:
    with LiveSlam(CAMERA, CONFIG, LiveOptions(small_disk / "run")) as slam:
        track_frames(slam, FRAMES[:4])
        ballast = fill(small_disk)
        time.sleep(HEALTH_S)
        assert set(track_frames(slam, FRAMES[4:16])) == {TrackingStatus.OK}
        assert slam.health().unwritten > 0
        assert "DISK FULL" in slam.health().line()
        ballast.unlink()
        assert set(track_frames(slam, FRAMES[16:])) == {TrackingStatus.OK}
        assert sum("tracking goes on" in r.message for r in caplog.records) == 1
        rows = (small_disk / "run" / "frames.csv").read_text().splitlines()
        assert len(rows) == 1 + len(FRAMES)
        fill(small_disk)
        pids = list(slam.processes().values())
        with pytest.raises(InputError, match="the whole trajectory is in") as caught:
            slam.close()
    path = Path(str(caught.value).rsplit(" ", 1)[1])
    assert len(read_tum(path)) == len(FRAMES)
    shutil.rmtree(path.parent)
    assert not running(pids)


class Camera(MeasuredSource):
    """A camera that is unplugged after some frames."""

    name = "camera"
    camera = CAMERA
    waits = False
    groundtruth = None

    def __init__(self, frames: int) -> None:
        self.counts = SourceCounts()
        self._frames = frames

    def frames(self) -> Iterator[Frame]:
        for frame in FRAMES[: self._frames]:
            time.sleep(0.1)
            yield frame
        raise InputError("camera: gone; plug it in again")

    def close(self) -> None:
        """Nothing to close."""


def test_an_unplugged_camera_ends_the_run_with_everything_saved(tmp_path) -> None:
    slam = LiveSlam(CAMERA, CONFIG, LiveOptions(tmp_path / "run"))
    pids = list(slam.processes().values())
    with pytest.raises(InputError, match="plug it in again"), slam:
        play(slam, Camera(10), PlayOptions(quiet=True))
    assert len(read_tum(tmp_path / "run" / "trajectory.txt")) + slam.frames_dropped == 10
    assert (tmp_path / "run" / "map").is_file()
    assert not running(pids)


def test_five_seconds_without_a_frame_are_tolerated() -> None:
    with LiveSlam(CAMERA, CONFIG) as slam:
        track_frames(slam, FRAMES[:10])
        for k, frame in enumerate(FRAMES[10:14]):
            stamp_s = FRAMES[9].timestamp_s + 5.0 + 0.03 * k
            result = slam.track(stamp_s, frame.rgb, frame.depth_m)
            assert result.status is TrackingStatus.OK
            with pytest.raises(InputError, match=r"set sensors.accelerometer.enabled to true"):
                slam.add_accelerometer(stamp_s, [0.0, 0.0, 9.81])  # and the next frame is tracked
        assert slam.health().map_deaths == 0


def label_image(folder: Path) -> SegmenterOptions:
    import cv2

    values = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    values[100:300, 200:400] = 3
    cv2.imwrite(str(folder / "a.png"), values)
    return SegmenterOptions("precomputed", masks=folder)


def test_a_killed_segmenter_loses_only_masks(tmp_path) -> None:
    semantics = {"semantics": CONFIG.semantics.__class__(segmenter=label_image(tmp_path))}
    config = CONFIG.__class__(**{**vars(CONFIG), **semantics})
    with LiveSlam(CAMERA, config, LiveOptions(tmp_path / "run")) as slam:
        track_frames(slam, FRAMES[:6])
        os.kill(slam.processes()["segmenter"], signal.SIGKILL)
        assert set(track_frames(slam, FRAMES[6:])) == {TrackingStatus.OK}
        wait_until(lambda: slam.catch_up() or not slam.health().masks_waiting)
        health, pids = slam.health(), list(slam.processes().values())
        assert (health.segmenter_deaths, health.map_deaths, health.masks_waiting) == (1, 0, 0)
    assert len(read_tum(tmp_path / "run" / "trajectory.txt")) == len(FRAMES)
    assert len((tmp_path / "run" / "labels.csv").read_text().splitlines()) > 20
    assert not running(pids)


def test_the_last_objects_and_keyframes_are_those_that_are_saved(tmp_path) -> None:
    semantics = {"semantics": CONFIG.semantics.__class__(segmenter=label_image(tmp_path))}
    config = CONFIG.__class__(**{**vars(CONFIG), **semantics})
    with LiveSlam(CAMERA, config, LiveOptions(tmp_path / "run")) as slam:
        track_frames(slam, FRAMES)
    run, found, poses = Run(tmp_path / "run"), slam.objects(), slam.keyframe_poses()
    assert found is not None
    assert [one.id for one in found.objects] == [one.id for one in run.objects]
    assert list(poses) == run.keyframes.ids.tolist()
    saved = run.keyframes.poses_world_camera
    np.testing.assert_allclose(np.array(list(poses.values())), saved, atol=1e-6)


def test_a_hanging_segmenter_is_restarted(tmp_path, monkeypatch) -> None:
    clock = Clock()
    monkeypatch.setattr(supervision, "time", clock)
    segmenter = RemoteSegmenter(label_image(tmp_path), tmp_path)
    first, found = segmenter.worker.pid, []
    try:
        os.kill(first, signal.SIGSTOP)
        segmenter.request(ImageToSegment(7, FRAMES[0].rgb, "a.png"))
        clock.pass_s(RestartPolicy.answer_s + 1)
        wait_until(lambda: found.extend(segmenter.receive_masks()) or found)
        assert [masks.keyframe_id for masks in found] == [7]
        assert (segmenter.worker.crashes, segmenter.waiting) == (1, 0)
        assert segmenter.worker.pid != first
    finally:
        segmenter.close()
    assert not running([first, segmenter.worker.pid])


class Deadly:
    """A segmenter that ends its process at one of the images."""

    labels = LabelSet(("background",))

    def segment(self, image: Image, name: str) -> list[Instance]:
        if name == "deadly":
            time.sleep(0.2)  # as a network that works
            os.kill(os.getpid(), signal.SIGKILL)
        return []


def serve_deadly(channel: Channel, *arguments: Any) -> None:
    """``serve_segmenter`` with such a segmenter."""
    segmentation.make_segmenter = lambda *_: Deadly()  # type: ignore[assignment]
    segmentation.serve_segmenter(channel, *arguments)


def test_an_image_that_kills_two_segmenters_is_left_out(tmp_path, monkeypatch, caplog) -> None:
    def start(name: str, target: str, *rest: Any) -> SupervisedWorker:
        return SupervisedWorker(name, f"{__name__}:serve_deadly", *rest)

    caplog.set_level(logging.INFO)
    monkeypatch.setattr(segmentation, "SupervisedWorker", start)
    found: list[int] = []
    with closing(RemoteSegmenter(label_image(tmp_path), tmp_path)) as segmenter:
        for number, name in enumerate(("a", "deadly", "b")):
            segmenter.request(ImageToSegment(number, FRAMES[0].rgb, name))

        def step() -> bool:
            found.extend(masks.keyframe_id for masks in segmenter.receive_masks())
            return not segmenter.waiting

        wait_until(step)
        assert (sorted(found), segmenter.worker.crashes) == ([0, 2], 2)
        assert (segmenter.dropped, segmenter.worker.given_up) == (1, False)
    assert "keyframe 1 has no masks: the process crashed on it twice" in caplog.text


def test_a_process_that_dies_before_it_begins_blames_no_image(tmp_path, monkeypatch) -> None:
    worker = SimpleNamespace(crashes=0, given_up=False, labels=(), answers=[Started(7)])
    worker.receive = lambda: [worker.answers.pop()] if worker.answers else []
    worker.send = lambda *_: None

    def crash(busy: bool) -> bool:
        worker.crashes += 1
        return True

    monkeypatch.setattr(segmentation, "SupervisedWorker", lambda *_: worker)
    monkeypatch.setattr(RemoteSegmenter, "_known_labels", lambda *_: LabelSet(("cup",)))
    worker.restart_if_needed = crash
    segmenter = RemoteSegmenter(label_image(tmp_path), tmp_path)
    segmenter.request(ImageToSegment(7, FRAMES[0].rgb, "a.png"))
    for _ in range(3):  # at the image, and twice while the network is loaded
        assert segmenter.receive_masks() == []
    assert (segmenter.waiting, segmenter.dropped) == (1, 0)
    worker.answers = [Started(7)]
    segmenter.receive_masks()
    assert (segmenter.waiting, segmenter.dropped) == (0, 1)


def test_a_viewer_that_is_closed_changes_nothing(tmp_path, monkeypatch) -> None:
    rerun = pytest.importorskip("rerun", reason="needs Rerun: pip install 'bmask-slam[view]'")
    from bmask_slam.viewer.scene import ViewOptions

    viewers: list[subprocess.Popen[bytes]] = []
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]

    def spawn(stream: rerun.RecordingStream) -> None:
        """Start a viewer without a window, since tests have no display."""
        command = [sys.executable, "-m", "rerun", "--serve-grpc", "--port", str(port)]
        viewers.append(subprocess.Popen(command, stdout=-3, stderr=-3, process_group=0))
        stream.connect_grpc(f"rerun+http://127.0.0.1:{port}/proxy")

    monkeypatch.setattr(rerun.RecordingStream, "spawn", spawn)
    options = LiveOptions(tmp_path / "run", view=ViewOptions(window=True))
    with LiveSlam(CAMERA, CONFIG, options) as slam:
        track_frames(slam, FRAMES[:8])
        os.killpg(viewers[0].pid, signal.SIGKILL)  # the program is a child of Python's
        viewers[0].wait()
        assert set(track_frames(slam, FRAMES[8:])) == {TrackingStatus.OK}
        started_s = time.monotonic()
    assert time.monotonic() - started_s < LONG_S
    assert len(read_tum(tmp_path / "run" / "trajectory.txt")) == len(FRAMES)
