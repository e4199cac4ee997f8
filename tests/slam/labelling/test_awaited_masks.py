"""Masks of a network beside the run are used a fixed number of frames after their keyframe."""

from __future__ import annotations

import numpy as np
from synthetic_view import CAMERA
from test_semantic_mapper import FRAMES, Sides

from bmask_slam.config.configuration import resolve
from bmask_slam.graph.arrays import Image
from bmask_slam.graph.errors import InputError
from bmask_slam.labelling.awaited_masks import LAG, MaskRequests
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig

EVERY_FRAME = ("keyframes.min_interval_frames=1", "keyframes.max_shared=2.0")


class Beside(Sides):
    """A segmenter that works beside its caller; it tells what it was asked."""

    def __init__(self) -> None:
        super().__init__(FRAMES)
        self.begun: list[str] = []
        self.asked: list[str] = []

    def begin(self, image: Image, name: str) -> None:
        self.begun.append(name)

    def segment(self, image: Image, name: str) -> list[Instance]:
        self.asked.append(name)
        return super().segment(image, name)


def names(count: int) -> list[str]:
    return [frame.name for frame in FRAMES[:count]]


def system_with(segmenter: Sides) -> SlamSystem:
    return SlamSystem(CAMERA, resolve(SystemConfig, None, EVERY_FRAME), segmenter)


def test_masks_are_asked_for_lag_frames_after_they_were_begun() -> None:
    segmenter = Beside()
    system = system_with(segmenter)
    for done, frame in enumerate(FRAMES[:8], 1):
        system.process(frame)
        assert segmenter.begun == names(done)
        urgent = min(done - 1, 1)  # the first one, which begins the map
        assert segmenter.asked == names(max(done - LAG, urgent))
    system.finish()
    assert segmenter.asked == names(8)


def test_a_segmenter_that_cannot_work_beside_is_asked_at_once() -> None:
    system = system_with(Sides(FRAMES))
    system.process(FRAMES[0])
    assert len(system.semantics.labels.known())


def test_late_masks_tell_what_masks_in_time_tell() -> None:
    early, late = system_with(Sides(FRAMES)), system_with(Beside())
    labelled = []
    for system in (early, late):
        for frame in FRAMES:
            system.process(frame)
        system.finish()
        ids = np.flatnonzero(system.map.world.landmarks.in_map)
        found = system.semantics.labels.estimates(ids)
        labelled.append(np.count_nonzero(found.labels > 0) / len(ids))
    assert min(labelled) > 0.9


def test_a_state_holds_what_all_masks_told_so_far() -> None:
    segmenter = Beside()
    system = system_with(segmenter)
    for frame in FRAMES[:4]:
        system.process(frame)
    state = system.state()
    assert segmenter.asked == names(4)
    other = system_with(Beside())
    other.restore(state, "run/checkpoint")
    known = system.semantics.labels.known()
    np.testing.assert_array_equal(other.semantics.labels.known(), known)
    np.testing.assert_array_equal(
        other.semantics.labels.probabilities(known), system.semantics.labels.probabilities(known)
    )


class BrokenOnce(Beside):
    """One image cannot be segmented."""

    def segment(self, image: Image, name: str) -> list[Instance]:
        found = super().segment(image, name)
        if name == FRAMES[2].name:
            raise InputError(f"{name}: broken")
        return found


def test_a_keyframe_without_masks_does_not_keep_others_from_theirs(caplog) -> None:
    segmenter = BrokenOnce()
    system = system_with(segmenter)
    for frame in FRAMES[:6]:
        system.process(frame)
    system.finish()
    assert segmenter.asked == names(6)
    assert [r.getMessage() for r in caplog.records if "has no masks" in r.getMessage()] == [
        f"keyframe 2 has no masks: {FRAMES[2].name}: broken"
    ]


def test_the_masks_of_a_keyframe_in_a_crowd_are_used_before_the_next_frame(monkeypatch) -> None:
    segmenter, crowded = Beside(), []
    system = system_with(segmenter)
    system.process(FRAMES[0])
    system.process(FRAMES[1])
    asked = system.moving_objects, "is_crowded"
    monkeypatch.setattr(*asked, lambda static: crowded.append(static) or True)
    system.process(FRAMES[2])
    system.process(FRAMES[3])
    assert crowded
    assert segmenter.asked == [FRAMES[0].name, FRAMES[2].name]
    system.finish()
    assert sorted(segmenter.asked) == names(4)


def test_requests_come_in_order_and_once() -> None:
    requests, segmenter = MaskRequests(), Beside()
    requests.add(0, FRAMES[0], segmenter)
    requests.begin_frame()
    requests.add(1, FRAMES[1], segmenter)
    assert not list(requests.take())
    for _ in range(LAG - 1):
        requests.begin_frame()
    assert [r.keyframe_id for r in requests.take()] == [0]
    assert [r.keyframe_id for r in requests.take(everything=True)] == [1]
    assert not list(requests.take(everything=True))
