"""The policy of sending keyframes to the dense map's process, with a fake process."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic_view import CAMERA, PLANE_Z_M, add_keyframe, make_features, random_descriptors

from bmask_slam.graph.geometry import make_pose
from bmask_slam.live.messages import Masks
from bmask_slam.live.processes import remote_dense
from bmask_slam.live.processes.dense_messages import (
    Accepted,
    DenseSetup,
    FinishMap,
    KeyframeToMap,
    LateMasks,
    Mapped,
    MapWritten,
    NotMapped,
    Preview,
    RemoveKeyframes,
)
from bmask_slam.live.processes.remote_dense import CROWDED, MAX_WAITING, RemoteDenseMapper
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions
from bmask_slam.sequences.frame import Frame
from bmask_slam.world.frame_history import FrameHistory
from bmask_slam.world.world_map import WorldMap

SETUP = DenseSetup(Path("run"), CAMERA, SegmenterOptions(), ("background",))


class FakeWorker:
    """A fake process that does nothing and crashes on request."""

    def __init__(self, *arguments: Any) -> None:
        self.sent: list[Any] = []
        self.answers: list[Any] = []
        self.crashes, self.given_up, self.crashes_next = 0, False, False

    def send(self, message: Any, begins: bool = False) -> None:
        self.sent.append(message)

    def receive(self) -> list[Any]:
        found, self.answers = self.answers, []
        return found

    def restart_if_needed(self, busy: bool) -> bool:
        has_crashed, self.crashes_next = self.crashes_next, False
        self.crashes += has_crashed
        return has_crashed

    def keyframes(self) -> list[int]:
        return [m.id for m in self.sent if isinstance(m, KeyframeToMap)]


@pytest.fixture
def dense(monkeypatch: pytest.MonkeyPatch) -> RemoteDenseMapper:
    monkeypatch.setattr(remote_dense, "SupervisedWorker", FakeWorker)
    return RemoteDenseMapper(SETUP)


def process(dense: RemoteDenseMapper) -> FakeWorker:
    worker = dense.worker
    assert isinstance(worker, FakeWorker)
    return worker


def a_map(count: int) -> WorldMap:
    """A map of keyframes side by side, each with its own landmarks."""
    world, rng = WorldMap(), np.random.default_rng(1)
    for k in range(count):
        T = make_pose(np.eye(3), np.array([0.1 * k, 0.0, 0.0]))
        points = T[:3, 3] + rng.uniform([-0.5, -0.5, PLANE_Z_M], [0.5, 0.5, PLANE_Z_M], (5, 3))
        features = make_features(T, points, random_descriptors(5, rng))
        world.make_landmarks(add_keyframe(world, T, features), np.arange(5), points)
    return world


def add_keyframes(dense: RemoteDenseMapper, *ids: int) -> Frame:
    frame = Frame(0, 0.0, np.zeros((480, 640, 3), np.uint8), np.ones((480, 640), np.float32))
    for number in ids:
        dense.add_keyframe(number, frame)
    return frame


def no(number: int) -> bool:
    return False


def test_the_newest_keyframe_is_sent_first_and_one_at_a_time(dense) -> None:
    world, worker = a_map(4), process(dense)
    frame = add_keyframes(dense, 0, 1, 2)
    frame.rgb[:] = 7  # the caller's buffer: it may be used again
    dense.update(world, no, no)
    dense.update(world, no, no)
    assert worker.keyframes() == [2]
    assert (worker.sent[0].snapshot.frame.rgb == 0).all()
    add_keyframes(dense, 3)
    for number in (2, 3, 1, 0):
        worker.answers = [Accepted(number)]
        dense.update(world, no, no)
    assert worker.keyframes() == [2, 3, 1, 0]
    assert (dense.waiting, dense.dropped) == (0, 0)
    np.testing.assert_array_equal(worker.sent[1].poses[2], world.keyframes[2].T_world_camera)


def test_too_many_keyframes_drop_the_oldest_that_was_not_sent(dense) -> None:
    world, worker = a_map(MAX_WAITING + 3), process(dense)
    add_keyframes(dense, 0)
    dense.update(world, no, no)
    add_keyframes(dense, *range(1, MAX_WAITING + 1))
    assert dense.full
    assert dense.dropped == 0
    add_keyframes(dense, MAX_WAITING + 1, MAX_WAITING + 2)
    assert list(dense.skipped) == [1, 2]
    assert (dense.dropped, dense.waiting) == (2, MAX_WAITING + 1)
    worker.answers = [Accepted(0), Mapped(0, None)]
    dense.update(world, no, no)
    assert dense.submaps == {0}


def test_keyframes_wait_for_the_map_and_some_time_for_masks(dense, monkeypatch) -> None:
    world, worker = a_map(3), process(dense)
    add_keyframes(dense, 0, 1, 2)
    dense.update(world, lambda k: k > 0, lambda k: k < 1)
    assert worker.keyframes() == []
    dense.add_masks(Masks(0, ["an instance"]), world)
    dense.update(world, lambda k: k > 0, no)
    assert worker.sent[0].instances == ["an instance"]
    monkeypatch.setattr(remote_dense, "MASKS_S", -1.0)
    worker.answers = [Accepted(0)]
    dense.update(world, no, lambda k: True)
    assert worker.keyframes() == [0, 2]
    dense.add_masks(Masks(2, ["late"]), world)
    late = worker.sent[-1]
    assert isinstance(late, LateMasks)
    np.testing.assert_array_equal(late.landmark_ids, world.keyframes[2].landmark_ids)
    np.testing.assert_allclose(late.pixels, world.keyframes[2].features.image_pixels)


def test_crowded_keyframes_do_not_wait_for_masks(dense) -> None:
    world, worker = a_map(CROWDED + 1), process(dense)
    add_keyframes(dense, *range(CROWDED - 1))
    dense.update(world, no, lambda k: True)
    assert worker.keyframes() == []
    add_keyframes(dense, CROWDED - 1, CROWDED)
    dense.update(world, no, lambda k: k != 1)
    worker.answers = [Accepted(1)]
    dense.update(world, lambda k: k == CROWDED, lambda k: True)
    assert worker.keyframes() == [1, CROWDED - 1]


def test_culled_keyframes_are_removed_and_unfinished_ones_kept(dense) -> None:
    world, worker = a_map(4), process(dense)
    add_keyframes(dense, 0, 1)
    dense.update(world, no, no)
    worker.answers = [Accepted(1), Mapped(1, None)]
    dense.update(world, no, no)
    add_keyframes(dense, 2, 3)
    for number in (1, 2, 3):
        del world.keyframes[number]
    dense.remove_culled(world, lambda k: k == 3)
    assert worker.sent[-1] == RemoveKeyframes([1, 2])
    assert dense.submaps == set()
    assert dense.waiting == 2  # 0 is being worked on, 3 is new


def test_sent_keyframes_are_resent_and_skipped_after_two_crashes(dense) -> None:
    world, worker = a_map(3), process(dense)
    add_keyframes(dense, 0)
    dense.update(world, no, no)
    worker.answers = [Accepted(0)]
    add_keyframes(dense, 1)
    dense.update(world, no, no)
    worker.crashes_next = True
    dense.update(world, no, no)
    assert worker.keyframes() == [0, 1, 0]
    worker.answers = [Accepted(0)]
    dense.update(world, no, no)
    worker.crashes_next = True
    dense.update(world, no, no)
    assert worker.keyframes() == [0, 1, 0, 1, 0]
    assert list(dense.skipped) == [1]
    worker.answers = [Accepted(0), Mapped(0, None)]
    dense.update(world, no, no)
    assert (dense.submaps, dense.waiting) == ({0}, 0)


def test_finish_sends_all_waiting_keyframes_despite_a_crash(dense, monkeypatch) -> None:
    world, worker = a_map(3), process(dense)
    add_keyframes(dense, 0, 1)
    preview = Preview(np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8))

    def send(message: Any, begins: bool = False) -> None:
        worker.sent.append(message)
        if isinstance(message, KeyframeToMap):
            worker.answers.append(Accepted(message.id))
        elif isinstance(message, FinishMap) and not worker.crashes:
            worker.crashes_next = True
        elif isinstance(message, FinishMap):
            full = NotMapped(1, "full", disk_full=True)
            worker.answers += [Mapped(0, preview), full, MapWritten(5, [1, 2])]

    monkeypatch.setattr(worker, "send", send)
    assert dense.finish(world, FrameHistory(), 5.0) == MapWritten(5, [1, 2])
    assert worker.keyframes() == [1, 0, 0, 1]
    assert isinstance(worker.sent[-1], FinishMap)
    assert set(worker.sent[-1].poses) == {0, 1, 2}
    assert dense.previews == {0: preview}
    assert dense.unwritten == 1


def test_after_giving_up_all_keyframes_are_reported_as_skipped(dense) -> None:
    world, worker = a_map(3), process(dense)
    add_keyframes(dense, 0, 1)
    dense.update(world, no, no)
    worker.given_up = True
    dense.update(world, no, no)
    add_keyframes(dense, 2)
    assert sorted(dense.skipped) == [0, 1, 2]
    assert not dense.full
    failure = dense.finish(world, FrameHistory(), 0).failure
    assert dense.finish(world, FrameHistory(), 5.0) == replace(MapWritten(), failure=failure)
    assert dense.finish(world, FrameHistory(), 5.0).failure


def test_the_last_process_grows_no_surface_though_the_run_folder_moved(dense) -> None:
    world, worker = a_map(1), process(dense)
    for _ in range(2):
        worker.crashes_next = True
        dense.update(world, no, no)
    dense.follow(Path("moved"))
    (setup,) = worker.arguments
    assert (setup.run, setup.grows) == (Path("moved"), False)
