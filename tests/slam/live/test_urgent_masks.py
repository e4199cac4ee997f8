"""Masks of the keyframes that tracking waits for: those that begin a map, those in a crowd."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from synthetic_view import CAMERA, PlaneViews, sideways_path

from bmask_slam.graph.arrays import Ints
from bmask_slam.labelling.config import SemanticsConfig
from bmask_slam.live import system
from bmask_slam.live.live_slam import LiveSlam
from bmask_slam.live.messages import ImageToSegment, NotSegmented
from bmask_slam.live.processes import segmentation
from bmask_slam.live.processes.segmentation import BEGINNING_S, RemoteSegmenter
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions
from bmask_slam.system_config import SystemConfig

FRAMES = PlaneViews(sideways_path(0.02 * np.arange(4)))
PEOPLE = """
import time

import numpy as np

from bmask_slam.semantics.instances.instances import Instance, certain, mask_box
from bmask_slam.semantics.labels import label_set


class OnTheLeft:
    labels = label_set(["person"])

    def segment(self, image, name):
        time.sleep(0.2)
        mask = np.zeros(image.shape[:2], bool)
        mask[:, : image.shape[1] // 2] = True
        return [Instance(mask, mask_box(mask), 1, certain(1, 2, 0.95), 0.95, 0.95)]
"""
IMAGE = np.zeros((2, 2, 3), np.uint8)


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SystemConfig:
    """With a slow segmenter that finds a person in the left half of every image."""
    (tmp_path / "people.py").write_text(PEOPLE)
    monkeypatch.syspath_prepend(tmp_path)
    semantics = SemanticsConfig(segmenter=SegmenterOptions.named("people:OnTheLeft"))
    return SystemConfig(semantics=semantics)


def observed_left(slam: LiveSlam) -> Ints:
    """Landmarks of the map that the first keyframe observes in the left half of its image."""
    world = slam._system.map.world
    keypoints, ids = world.observed(world.keyframes[0])
    return ids[world.keyframes[0].features.image_pixels[keypoints, 0] < CAMERA.width // 2 - 20]


def test_masks_of_the_first_keyframe_are_used_before_the_next_frame(config, monkeypatch) -> None:
    monkeypatch.setattr(system, "BEGINNING_S", 60.0)  # also on a machine that is busy
    with LiveSlam(CAMERA, config) as slam:
        for frame in FRAMES[:2]:
            result = slam.track(frame.timestamp_s, frame.rgb, frame.depth_m, name=frame.name)
        assert len(observed_left(slam)) == 0
        assert result.inliers > 50
        assert slam.map().points_world[:, 0].min() > -0.1


class SilentWorker(SimpleNamespace):
    """A process that gives no masks, but what it is told to say."""

    def __init__(self, *_: object) -> None:
        super().__init__(said=[], crashes=0, given_up=False, is_away=False, labels=())

    def wait_until_ready(self) -> SimpleNamespace:
        return SimpleNamespace(labels=("background", "person"))

    def send(self, *_: object) -> None: ...

    def close(self) -> None: ...

    def receive(self) -> list[NotSegmented]:
        said, self.said = self.said, []
        return said

    def restart_if_needed(self, busy: bool) -> bool:
        return False


@pytest.fixture
def segmenter(monkeypatch: pytest.MonkeyPatch) -> Iterator[RemoteSegmenter]:
    """That of a silent process, with one keyframe whose masks are urgent; the clock stands."""
    monkeypatch.setattr(segmentation, "SupervisedWorker", SilentWorker)
    clock = SimpleNamespace(monotonic=lambda: 100.0, perf_counter=lambda: 100.0)
    monkeypatch.setattr(segmentation, "time", clock)
    with closing(RemoteSegmenter(SegmenterOptions("light"), Path())) as remote:
        remote.request(ImageToSegment(7, IMAGE, "7.png"))
        remote.hurry(7, BEGINNING_S)
        assert remote.waits_for_masks()
        yield remote


def test_masks_that_do_not_come_are_waited_for_once(segmenter, monkeypatch) -> None:
    monkeypatch.setattr(segmentation.time, "monotonic", lambda: 100.0 + BEGINNING_S)
    assert not segmenter.waits_for_masks()
    assert not segmenter.urgent
    assert segmenter.awaits(7)  # and are used when they come


def test_masks_that_cannot_be_made_are_not_waited_for(segmenter) -> None:
    segmenter.worker.said = [NotSegmented(7, "broken")]
    segmenter.receive_masks()
    assert not segmenter.waits_for_masks()


def test_masks_of_a_process_that_died_too_often_are_not_waited_for(segmenter) -> None:
    segmenter.worker.given_up = True
    segmenter.receive_masks()
    assert not segmenter.waits_for_masks()


def test_masks_of_a_workstation_that_is_away_are_not_waited_for(segmenter) -> None:
    segmenter.urgent.clear()
    segmenter.worker.is_away = True
    segmenter.hurry(8, BEGINNING_S)
    assert not segmenter.waits_for_masks()
