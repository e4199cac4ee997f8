"""The items of a source that the live loop consumes and drops."""

from __future__ import annotations

import itertools
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from faults import Clock, wait_until
from synthetic_view import CAMERA, PlaneViews, render_plane

from bmask_slam.config.configuration import resolve
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.live.live_slam import LiveSlam
from bmask_slam.live.play import WAITING, PlayOptions, play
from bmask_slam.live.sources.source import MeasuredSource, Newest, paced
from bmask_slam.sequences.frame import Frame
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import FrameResult

POSES = [se3_exp(np.array([0, 0, 0, 0.02 * k, 0, 0])) for k in range(10)]
FRAMES = PlaneViews(POSES)


class FakeSource(MeasuredSource):
    """A source that gives these frames."""

    name, camera, groundtruth = "given", CAMERA, None

    def __init__(self, frames: list[Frame]) -> None:
        self._frames = frames

    def frames(self) -> Iterator[Frame]:
        yield from self._frames


def consume_all(newest: Newest[int]) -> list[int]:
    found = []
    while not newest.ended:
        item = newest.get(0.05)
        if item is not None:
            found.append(item)
    return found


def filled(count: int, keep: int) -> Newest:
    """The queue after a source gave this many items at once, before any is consumed."""
    all_there = threading.Event()

    def at_once() -> Iterator[int]:
        yield from range(count)
        all_there.set()

    newest = Newest(at_once(), keep)
    assert all_there.wait(5)
    return newest


def test_items_consumed_in_time_are_all_delivered_in_order() -> None:
    def slowly() -> Iterator[int]:
        for k in range(5):
            time.sleep(0.02)
            yield k

    newest = Newest(slowly(), keep=1)
    assert consume_all(newest) == [0, 1, 2, 3, 4]
    assert newest.dropped == 0


@pytest.mark.parametrize(
    ("items", "keep", "given"),
    [
        (3, 3, [0, 1, 2]),
        (4, 3, [1, 3]),
        (5, 3, [1, 4]),
        (6, 3, [1, 3, 5]),
        (8, 3, [1, 4, 7]),
        (2, 1, [1]),
        (13, 3, [3, 7, 12]),
        (18, 2, [8, 17]),  # of 17 every second had stayed
    ],
)
def test_a_slow_consumer_gets_items_spread_evenly_up_to_the_newest(
    items: int, keep: int, given: list[int]
) -> None:
    newest = filled(items, keep)
    assert consume_all(newest) == given
    assert newest.dropped == items - len(given)


def test_a_long_stall_leaves_few_items_in_memory() -> None:
    newest = filled(1000, keep=3)
    given = consume_all(newest)
    assert given[-1] == 999
    assert len(given) == 3


def test_an_error_of_the_source_is_raised_after_its_frames() -> None:
    def broken() -> Iterator[int]:
        yield 1
        raise InputError("camera: unplugged; plug it in")

    newest = Newest(broken(), keep=1)
    assert newest.get(5) == 1
    with pytest.raises(InputError, match="unplugged"):
        consume_all(newest)


def test_an_endless_source_stops_on_request() -> None:
    newest = Newest(itertools.count(), keep=1)
    assert newest.get(5) is not None
    newest.stop()
    deadline_s = time.monotonic() + 60
    while not newest.ended and time.monotonic() < deadline_s:
        newest.get(0.01)
    assert newest.ended


BLOCKED = """
import time
from bmask_slam.live.sources.source import Newest

def frames():
    yield 1
    time.sleep(600)

newest = Newest(frames(), 3)
print(newest.get(60))
newest.stop()
"""


def test_a_driver_that_does_not_return_does_not_keep_the_program() -> None:
    command = [sys.executable, "-c", BLOCKED]
    done = subprocess.run(command, check=True, capture_output=True, timeout=60)
    assert (done.stdout, done.stderr) == (b"1\n", b"")


@pytest.fixture(scope="module")
def slam() -> Iterator[LiveSlam]:
    with LiveSlam(CAMERA) as slam:
        yield slam


def test_a_waiting_source_is_tracked_completely_without_refused_frames(slam) -> None:
    small = Frame(3, FRAMES[3].timestamp_s, FRAMES[3].rgb[::2], FRAMES[3].depth_m)
    frames = [*FRAMES[:3], small, FRAMES[2], *FRAMES[4:6]]
    assert play(slam, FakeSource(frames), PlayOptions(realtime=False, quiet=True)) is None
    health = slam.health()
    assert (health.frames, health.frames_refused, health.frames_dropped) == (5, 2, 0)


@pytest.mark.parametrize("realtime", [False, True])
def test_a_broken_large_frame_is_skipped(realtime: bool) -> None:
    """Its images are reduced ahead of tracking."""
    source = FakeSource([_twice_as_large(frame) for frame in FRAMES[:5]])
    source.camera = CAMERA.of_size(2 * CAMERA.width, 2 * CAMERA.height)
    source._frames[2] = replace(source._frames[2], depth_m=-source._frames[2].depth_m)
    with LiveSlam(source.camera) as slam:
        assert slam.camera.reduced_by == 2
        assert play(slam, source, PlayOptions(realtime=realtime, quiet=True)) is None
        health = slam.health()
    assert health.frames_refused == 1 and health.frames + health.frames_dropped == 4


def _twice_as_large(frame: Frame) -> Frame:
    rgb, depth_m = (a.repeat(2, axis=0).repeat(2, axis=1) for a in (frame.rgb, frame.depth_m))
    return replace(frame, rgb=rgb, depth_m=depth_m)


def test_a_waiting_source_does_not_outrun_the_map(monkeypatch) -> None:
    settings = ["keyframes.min_interval_frames=1", "keyframes.max_shared=1.1"]
    to_and_fro = [*POSES, *POSES[::-1]] * 2  # keyframes are made when the map has time for them
    frames = [render_plane(pose, index) for index, pose in enumerate(to_and_fro)]
    with LiveSlam(CAMERA, resolve(SystemConfig, None, settings)) as slam:
        waiting, made, track = [], [], slam.track

        def watched(*arguments: object) -> FrameResult:
            waiting.append(slam.health().keyframes_waiting)
            result = track(*arguments)
            made.append(result.keyframe_id is not None)
            return result

        monkeypatch.setattr(slam, "track", watched)
        play(slam, FakeSource(frames), PlayOptions(realtime=False, quiet=True))
    assert sum(made) > 3  # the map itself may have culled some by now
    assert len(waiting) == len(frames)
    assert max(waiting) <= WAITING


def test_silence_is_reported_once_and_frames_after_it_are_tracked(
    slam, caplog, monkeypatch
) -> None:
    clock, before = Clock(), slam.health().frames
    monkeypatch.setattr("bmask_slam.live.play.time", clock)

    class Silent(FakeSource):
        def frames(self) -> Iterator[Frame]:
            yield FRAMES[6]
            wait_until(lambda: slam.health().frames == before + 1)
            for _ in range(3):
                clock.pass_s(1001.0)
                wait_until(lambda: "no frame for" in caplog.text)
                time.sleep(0.2)  # it looks every 0.1 s
            yield FRAMES[7]

    play(slam, Silent([]), PlayOptions(silence_s=1000.0, quiet=True))
    assert slam.health().frames == before + 2
    assert caplog.text.count("no frame for") == 1


def played(stamps_s: Array, monkeypatch: pytest.MonkeyPatch) -> tuple[list[float], list[float]]:
    """When frames with these stamps are read, and when they are delivered."""
    now_s = 100.0

    def sleep(seconds: float) -> None:
        nonlocal now_s
        now_s += seconds

    clock = SimpleNamespace(monotonic=lambda: now_s, sleep=sleep)
    monkeypatch.setattr("bmask_slam.live.sources.source.time", clock)
    read_s, delivered_s = [], []

    def reading() -> Iterator[Frame]:
        for stamp_s in stamps_s.tolist():
            read_s.append(now_s)
            yield replace(FRAMES[0], timestamp_s=stamp_s)

    for _ in paced(reading()):
        delivered_s.append(now_s)
    return read_s, delivered_s


def test_a_wrong_stamp_does_not_hurry_the_frames_after_it(monkeypatch) -> None:
    stamps_s = 5.0 + 0.1 * np.arange(9)
    stamps_s[4] += 3600.0
    delivered_s = played(stamps_s, monkeypatch)[1]
    np.testing.assert_allclose(np.diff(delivered_s)[[0, 1, 2, 5, 6, 7]], 0.1)


def test_a_recording_is_delivered_at_its_stamps(monkeypatch) -> None:
    read_s, delivered_s = played(5.0 + 0.1 * np.arange(5), monkeypatch)
    due_s = delivered_s[0] + 0.1 * np.arange(5)
    np.testing.assert_allclose(delivered_s, due_s)
    np.testing.assert_allclose(read_s[2:], due_s[2:] - 0.05)  # then it knows the interval
