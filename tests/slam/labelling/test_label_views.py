"""Frames that are no keyframes are segmented too, and label the map without changing it."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from synthetic_view import CAMERA, render_plane
from test_awaited_masks import Beside
from test_semantic_mapper import FRAMES, Sides, estimates, named, right_share

from bmask_slam.config.configuration import resolve
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.labelling import label_views
from bmask_slam.labelling.label_views import (
    FIRST_LABEL_VIEW,
    MAX_RESENT,
    LabelView,
    LabelViewConfig,
    LabelViewDecision,
    LabelViews,
    forget_old_views,
)
from bmask_slam.labelling.landmark_visibility import observed_by
from bmask_slam.live.messages import Masks
from bmask_slam.merging.joint_state import Shift
from bmask_slam.run_folder.semantic_files import write_objects
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import TrackingStatus

ALL = "semantics.label_views.min_interval_s=0.03", "semantics.label_views.moved_share=0.0"
FEW_KEYFRAMES = "keyframes.min_interval_frames=6", "keyframes.max_shared=2.0"
KEYFRAMES_ONLY = "semantics.label_views.max_interval_s=0"


def system_with(segmenter: Sides, *settings: str) -> SlamSystem:
    return SlamSystem(CAMERA, resolve(SystemConfig, None, [*FEW_KEYFRAMES, *settings]), segmenter)


def run(segmenter: Sides, *settings: str) -> SlamSystem:
    system = system_with(segmenter, *settings)
    for frame in FRAMES:
        system.process(frame)
    system.semantics.use_masks(everything=True)
    return system


@pytest.fixture(scope="module")
def viewed() -> SlamSystem:
    """A run all of whose frames are segmented."""
    return run(Beside(), *ALL)


def test_every_frame_can_be_segmented_and_the_map_stays_the_same(viewed: SlamSystem) -> None:
    plain = run(Beside(), KEYFRAMES_ONLY)
    segmenters: Any = [system.semantics.segmenter for system in (viewed, plain)]
    made = len(plain.map.world.keyframes)
    assert [len(s.asked) for s in segmenters] == [len(FRAMES), made]
    assert 1 < made <= 3
    cloud, same = viewed.landmarks(), plain.landmarks()
    np.testing.assert_array_equal(cloud.points_world, same.points_world)
    np.testing.assert_array_equal(
        viewed.trajectory().poses_world_camera, plain.trajectory().poses_world_camera
    )
    assert estimates(viewed).views.sum() > 3 * estimates(plain).views.sum()
    assert min(right_share(viewed), right_share(plain)) > 0.98


def test_views_make_objects_whose_file_names_keyframes_alone(
    viewed: SlamSystem, tmp_path: Path
) -> None:
    write_objects(tmp_path / "objects.json", viewed.objects())
    written = json.loads((tmp_path / "objects.json").read_text())["objects"]
    assert {o["label"] for o in written} == {"left", "right"}
    for saved, found in zip(written, viewed.objects().objects, strict=True):
        assert set(saved["keyframes"]) <= viewed.map.world.keyframes.keys()
        assert (found.keyframe_ids >= FIRST_LABEL_VIEW).sum() > 5


def test_masks_of_a_view_are_used_once_and_those_of_an_unknown_one_are_refused(
    viewed: SlamSystem,
) -> None:
    instances = Sides(FRAMES).instances(1)
    number = min(viewed.semantics._label_views)
    assert viewed.semantics.attach(number, instances).refused == "it has its masks already"
    unknown = viewed.semantics.attach(FIRST_LABEL_VIEW + 4711, instances)
    assert unknown.refused == "it is not in the map"


def test_a_view_of_a_culled_keyframe_is_where_it_was() -> None:
    system = run(Beside(), *ALL)
    world, history = system.map.world, system.map.history
    first, last = world.keyframes[min(world.keyframes)], world.keyframes[max(world.keyframes)]
    views = system.semantics._label_views
    (view, *_) = [v for v in views.values() if v.parent_id == last.id]
    T_world_view = last.T_world_camera @ view.T_parent_camera
    history.hand_over(last.id, first.id, np.linalg.inv(first.T_world_camera) @ last.T_world_camera)
    world.remove_keyframe(last, first)
    observed = observed_by(view.number, system.map, views)
    assert observed.anchor is first
    np.testing.assert_allclose(observed.T_world_camera, T_world_view, atol=1e-9)


def test_a_recording_that_continues_a_map_counts_its_views_on(viewed: SlamSystem) -> None:
    other = system_with(Beside(), *ALL)
    other.restore(viewed.state(), Path("run/checkpoint"))
    before = set(other.semantics._label_views)
    other.begin_session()
    assert other.semantics.decision.state()["landmark_ids"].size == 0
    for k, frame in enumerate(FRAMES[:4]):
        later = render_plane(se3_exp(np.array([0, 0, 0, 0.03 * k - 0.2, 0, 0])), 100 + k)
        other.process(named(later, int(Path(frame.name).stem)))
    assert min(set(other.semantics._label_views) - before) > max(before)


def test_the_second_of_two_merged_maps_has_its_views_after_those_of_the_first() -> None:
    shift = Shift(keyframes=30, label_views=7)
    ids = np.array([-1, 0, 12, FIRST_LABEL_VIEW, FIRST_LABEL_VIEW + 3])
    expected = [-1, 30, 42, FIRST_LABEL_VIEW + 7, FIRST_LABEL_VIEW + 10]
    assert shift.keyframe(ids).tolist() == expected


def view(number: int) -> LabelView:
    seen = np.full((2, 2), float(number)), np.array([3, 5]), np.ones((4, 4), np.float32)
    return LabelView(number, float(number), 1, np.eye(4), *seen)


def test_the_last_views_are_kept_without_their_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(label_views, "MAX_VIEWS", 3)
    views, again = LabelViews(), LabelViews()
    for number in (5, 6, 8, 9):
        views.add(view(number))
    again.restore(views.state())
    for kept in (views, again):
        assert list(kept) == [6, 8, 9]
        assert kept[8].depth_m.size == 0
        assert kept[8].image_pixels.tolist() == [[8.0, 8.0], [8.0, 8.0]]


def test_only_the_last_messages_of_views_are_kept_to_be_sent_again() -> None:
    journal: dict[int, Any] = {}
    for k in range(100):
        sent = Masks(k, []), view(FIRST_LABEL_VIEW + k), Masks(FIRST_LABEL_VIEW + k, [])
        for message in sent:
            journal[len(sent) * k + sent.index(message)] = message
            forget_old_views(journal, message)
    of_keyframes = [m for m in journal.values() if isinstance(m, Masks) and m.keyframe_id < 100]
    assert len(of_keyframes) == 100
    assert len(journal) == 100 + MAX_RESENT
    assert list(journal)[-2:] == [298, 299]


def tracked(moved_px: float, count: int = 40, status: str = "OK") -> Any:
    """A frame that shows landmarks (N,), moved to the right of where they were."""
    pixels = np.stack([np.arange(count) + moved_px, np.zeros(count)], axis=1)
    features, every = SimpleNamespace(image_pixels=pixels), np.arange(count)
    status_of = TrackingStatus(status)
    return SimpleNamespace(status=status_of, features=features, keypoints=every, landmark_ids=every)


def shown(count: int = 40) -> Array:
    return np.stack([np.arange(count), np.zeros(count)], axis=1).astype(float)


@pytest.mark.parametrize(
    ("after_s", "frame", "due"),
    [
        (0.1, tracked(100), False),
        (0.3, tracked(100), True),
        (0.3, tracked(20), False),
        (1.1, tracked(0), True),
        (0.3, tracked(0, count=5), True),
        (1.1, tracked(100, status="LOST"), False),
        (1.1, tracked(100, status="DEAD_RECKONING"), False),
    ],
)
def test_a_view_is_due_after_a_move_or_a_while(after_s: float, frame: Any, due: bool) -> None:
    decision = LabelViewDecision(LabelViewConfig(), 640)
    decision.segmented(10.0, np.arange(40), shown())
    assert decision.decide(10.0 + after_s, frame) is due
    assert decision.state()["last_s"] == (10.0 + after_s if due else 10.0)


def test_impossible_values_are_rejected() -> None:
    with pytest.raises(ValueError, match="must not be negative"):
        LabelViewConfig(min_interval_s=-1.0)
