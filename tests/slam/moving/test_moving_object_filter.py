"""A textured card that slides before a textured plane, and a camera that moves a little."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from synthetic_view import CAMERA, plane_texture, render_plane

from bmask_slam.config.configuration import resolve
from bmask_slam.features.brisk import Features
from bmask_slam.graph.arrays import Array, Image
from bmask_slam.graph.geometry import inverse, se3_exp, transform
from bmask_slam.moving.keyframe_masks import KeyframeMasks
from bmask_slam.moving.static_features import StaticFeatures
from bmask_slam.semantics.instances.instances import Instance, certain, mask_box
from bmask_slam.semantics.labels import label_set
from bmask_slam.semantics.tracks.instance_track import Sighting
from bmask_slam.sequences.frame import Frame
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import TrackingStatus

CARD_Z_M = 1.3
FRAMES = 36
SETTINGS = [
    *("keyframes.min_interval_frames=6", "keyframes.max_shared=2.0"),
    "features.max_keypoints=500",
]
NAMES = label_set(("person", "picture", "dog"))


def pose(index: int) -> Array:
    return se3_exp(np.array([0, 0.002 * index, 0, 0.004 * index, 0, 0]))


def card(index: int) -> tuple[slice, slice]:
    """Rows and columns that the card covers; it is static until frame 8."""
    x_world = -0.55 + 0.04 * max(index - 8, 0)
    corner = transform(inverse(pose(index)), np.array([[x_world, 0.0, CARD_Z_M]]))
    left = round(float(CAMERA.project(corner)[0, 0]))
    return slice(120, 360), slice(left, left + 240)


def view(index: int, with_card: bool = True) -> Frame:
    frame = render_plane(pose(index), index)
    if not with_card:
        return frame
    rgb, depth_m = frame.rgb.copy(), frame.depth_m.copy()
    rows, columns = card(index)
    width = rgb[rows, columns].shape[1]
    rgb[rows, columns] = plane_texture()[100:340, 100 : 100 + width, None].astype(np.uint8)
    depth_m[rows, columns] = CARD_Z_M
    return replace(frame, rgb=rgb, depth_m=depth_m, name=str(index))


class CardSegmenter:
    """The card, as a person or as a picture."""

    labels = NAMES

    def __init__(self, label: int) -> None:
        self._label = label

    def segment(self, image: Image, name: str) -> list[Instance]:
        mask = np.zeros(image.shape[:2], bool)
        mask[card(int(name))] = True
        found = certain(self._label, len(NAMES), 0.95)
        return [Instance(mask, mask_box(mask), self._label, found, 0.95, 0.95)]


class CountingSystem(SlamSystem):
    """Counts keypoints on and off the card, and the excluded ones of both, for every frame."""

    counts: list[tuple[int, int, int, int]]

    def _without_moving(self, frame: Frame, features: Features) -> StaticFeatures:
        static = super()._without_moving(frame, features)
        u, v = features.image_pixels.T
        _, columns = card(frame.index)
        right = min(columns.stop, 640)
        inside = (abs(u - (columns.start + right) / 2) < (right - columns.start) / 2 - 8) & (
            abs(v - 240) < 112
        )
        outside = (u < columns.start - 12) | (u > right + 12) | (abs(v - 240) > 132)
        excluded = static.moving
        both = (inside, inside & excluded, outside, outside & excluded)
        self.counts.append(tuple(int(n.sum()) for n in both))  # type: ignore[arg-type]
        return static


def run(frames: Sequence[Frame], label: int = 0, settings: Sequence[str] = ()) -> CountingSystem:
    config = resolve(SystemConfig, None, [*SETTINGS, *settings])
    system = CountingSystem(CAMERA, config, CardSegmenter(label) if label else None)
    system.counts = []
    for frame in frames:
        system.process(frame)
    return system


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return [view(k) for k in range(FRAMES)]


def landmarks_on_card(system: SlamSystem) -> int:
    """Landmarks nearer than halfway between the card and the plane."""
    table = system.mapper.world.landmarks
    return int((table.points_world[table.in_map, 2] < 1.65).sum())


def position_error_m(system: SlamSystem) -> float:
    found = system.trajectory().poses_world_camera
    true = np.array([inverse(pose(0)) @ pose(k) for k in range(FRAMES)])
    return float(np.linalg.norm(found[:, :3, 3] - true[:, :3, 3], axis=1).max())


def test_without_labels_the_card_is_found_when_it_moves(frames: list[Frame]) -> None:
    system = run(frames)
    inside, found, outside, wrong = np.array(system.counts[25:]).sum(axis=0)
    assert inside > 500
    assert found > 0.9 * inside
    assert wrong < 0.01 * outside
    assert landmarks_on_card(system) < 10
    assert position_error_m(system) < 0.01


def test_without_the_filter_the_card_is_in_the_map(frames: list[Frame]) -> None:
    system = run(frames, settings=["moving_objects.geometry=false"])
    assert np.array(system.counts)[:, 1].sum() == 0
    assert landmarks_on_card(system) > 50


def test_a_person_is_excluded_before_moving_and_between_keyframes(frames: list[Frame]) -> None:
    system = run(frames[:8], label=1, settings=["moving_objects.geometry=false"])
    inside, found, _, wrong = np.array(system.counts[1:]).sum(axis=0)
    assert found > 0.95 * inside > 0
    assert wrong == 0
    assert landmarks_on_card(system) < 5
    track = system.moving_objects.tracks.tracks[0]
    assert track.moving
    np.testing.assert_allclose(track.half_size[:2], 120 * CARD_Z_M / CAMERA.fx, rtol=0.1)


def standing(frames: int) -> list[Frame]:
    """The card does not move, and the camera little."""
    still = [view(0)] * frames
    return [replace(f, index=k, timestamp_s=k / 30, name="0") for k, f in enumerate(still)]


def test_a_person_label_that_is_static_for_long_is_reinstated() -> None:
    system = run(standing(60), label=1, settings=["moving_objects.check.views=12"])
    counts = np.array(system.counts)
    assert counts[1:10, 1].sum() > 0.9 * counts[1:10, 0].sum()
    assert counts[-5:, 1].sum() == 0
    assert landmarks_on_card(system) > 50


def test_a_static_person_label_is_reinstated_within_half_a_second() -> None:
    frames = standing(20)
    system = run(frames, label=1, settings=["moving_objects.static_verification.stands_s=0.3"])
    counts = np.array(system.counts)
    assert counts[1:9, 1].sum() > 0.9 * counts[1:9, 0].sum()
    assert counts[12:, 1].sum() == 0
    keyframes = system.mapper.world.keyframes.values()
    assert len(keyframes) > 2
    assert not any(k.masked.any() for k in keyframes)
    assert system.moving_objects.tracks.tracks[0].stood
    table = system.mapper.world.landmarks
    on_card = table.in_map & (table.points_world[:, 2] < 1.65)
    assert (table.observations[on_card] > 1).mean() > 0.5  # keyframes find each other's again
    assert np.isfinite(table.patch_views[on_card]).any(axis=(1, 2)).all()
    unmasked = run(frames, settings=["moving_objects.static_verification.stands_s=0.3"])
    assert landmarks_on_card(system) > 0.7 * landmarks_on_card(unmasked) > 50


def test_a_label_on_verified_static_points_is_not_excluded() -> None:
    late = CardSegmenter(1)
    segment = late.segment
    late.segment = lambda image, name: segment(image, "0") if int(name) > 20 else []  # type: ignore
    system = CountingSystem(CAMERA, resolve(SystemConfig, None, SETTINGS), late)
    system.counts = []
    for frame in standing(30):
        system.process(replace(frame, name=str(frame.index)))
    assert np.array(system.counts)[:, 1].sum() == 0
    assert max(k.timestamp_s for k in system.mapper.world.keyframes.values()) > 21 / 30
    assert system.moving_objects.tracks.tracks == []  # its class does not count
    assert landmarks_on_card(system) > 50
    assert not any(k.masked.any() for k in system.mapper.world.keyframes.values())


def test_a_walking_person_is_excluded_all_the_time(frames: list[Frame]) -> None:
    system = run(frames[8:], label=1, settings=["moving_objects.static_verification.stands_s=0.3"])
    inside, found, _, _ = np.array(system.counts[1:]).sum(axis=0)
    assert found > 0.95 * inside > 0
    assert landmarks_on_card(system) < 5


def test_a_person_in_one_keyframe_only_is_dropped() -> None:
    once = CardSegmenter(1)
    segment = once.segment
    once.segment = lambda image, name: segment(image, name) if not calls else []  # type: ignore
    calls: list[str] = []
    config = resolve(SystemConfig, None, [*SETTINGS, "moving_objects.geometry=false"])
    system = SlamSystem(CAMERA, config, once)
    excluded = []
    for frame in standing(30):
        static = system.moving_objects.filter(frame, system.prepare(frame))
        excluded.append(static.ignored)
        if system.process(frame).keyframe_id is not None:
            calls.append(frame.name)
    assert len(calls) > 3
    assert min(excluded[1:6]) > 50
    assert max(excluded[-6:]) == 0


def test_landmarks_are_kept_until_their_object_moves(frames: list[Frame]) -> None:
    late = CardSegmenter(1)
    segment, late.segment = late.segment, lambda image, name: []  # type: ignore[method-assign]
    system = SlamSystem(CAMERA, resolve(SystemConfig, None, SETTINGS), late)
    for frame in standing(20):
        system.process(frame)
    before = landmarks_on_card(system)
    late.segment = segment  # type: ignore[method-assign]
    for frame in standing(27)[20:]:
        system.process(frame)
    assert landmarks_on_card(system) > 0.8 * before > 50
    for frame in frames:
        system.process(replace(frame, index=frame.index + 27, timestamp_s=frame.timestamp_s + 0.9))
    assert landmarks_on_card(system) < 0.1 * before


def test_static_points_in_a_moving_box_are_used(frames: list[Frame]) -> None:
    system = run(frames[:8])
    wall = np.array([0.5, 0.0, 2.0])
    someone = Sighting(wall, np.full(3, 0.5), certain(1, len(NAMES), 0.95), 3.0)
    system.moving_objects.tracks.update(frames[7].timestamp_s, [someone])
    features = system.prepare(frames[8])
    excluded = {
        geometry: replaced(system, geometry).moving_objects.filter(frames[8], features).moving.sum()
        for geometry in (True, False)
    }
    assert excluded[False] > 50
    assert excluded[True] < 0.1 * excluded[False]


def replaced(system: SlamSystem, geometry: bool) -> SlamSystem:
    """The system with geometry switched on or off."""
    system.moving_objects.config = replace(system.moving_objects.config, geometry=geometry)
    return system


def test_a_person_on_a_picture_is_static(frames: list[Frame]) -> None:
    system = run(frames[:8], label=2)
    assert np.array(system.counts)[:, 1].sum() == 0
    assert landmarks_on_card(system) > 50


def test_a_late_mask_removes_added_observations(frames: list[Frame]) -> None:
    late = CardSegmenter(1)
    system = SlamSystem(CAMERA, resolve(SystemConfig, None, SETTINGS), late)
    late.segment = lambda image, name: []  # type: ignore[method-assign]
    waiting = {}
    attach, system.semantics.attach = system.semantics.attach, lambda *_: None  # type: ignore
    for frame in frames[:8]:
        result = system.process(frame)
        if result.keyframe_id is not None:
            waiting[result.keyframe_id] = frame
    before = landmarks_on_card(system)
    in_graph = len(system.mapper.smoother.estimate().landmark_ids)
    for keyframe_id, frame in waiting.items():
        attach(keyframe_id, CardSegmenter(1).segment(frame.rgb, frame.name))
    assert before > 50
    assert landmarks_on_card(system) < 0.05 * before
    assert len(system.mapper.smoother.estimate().landmark_ids) < in_graph


@pytest.mark.parametrize("longest_s", [1.0, 0.0])
def test_a_person_who_enters_a_known_view_is_found_by_masks(longest_s: float) -> None:
    """By those of frames that are no keyframes, since none is made any more."""
    settings = [
        *("keyframes.min_interval_frames=100", "keyframes.urgent_shared=0.0"),
        *(f"semantics.label_views.max_interval_s={longest_s}", "moving_objects.geometry=false"),
    ]
    segmenter = CardSegmenter(1)
    person, segmenter.segment = segmenter.segment, lambda *_: []  # type: ignore[method-assign]
    config = resolve(SystemConfig, None, [*SETTINGS, *settings])
    system = SlamSystem(CAMERA, config, segmenter)
    results = []
    for k in range(24):
        if k == 8:
            segmenter.segment = person  # type: ignore[method-assign]
        results.append(system.process(view(k, with_card=k >= 8)))
    assert [r.keyframe_id for r in results] == [0] + 23 * [None]
    assert (results[-1].ignored > 50) is (longest_s > 0)


def test_masks_that_come_again_after_newer_ones_are_used(frames: list[Frame]) -> None:
    """A segmentation process that was started again repeats what it had not confirmed."""
    system = SlamSystem(CAMERA, resolve(SystemConfig, None, SETTINGS), CardSegmenter(1))
    seen: list[KeyframeMasks] = []
    observe = system.moving_objects.observe_masks
    system.semantics._on_masks = lambda masks: (seen.append(masks), observe(masks))[1]
    for frame in frames[:8]:
        system.process(frame)
    tracks = system.moving_objects.tracks.tracks
    assert len(seen) > 1
    observe(seen[0])
    assert system.moving_objects.tracks.tracks == tracks
    assert landmarks_on_card(system) < 5


def test_a_static_scene_is_used_completely() -> None:
    system = run([view(k, with_card=False) for k in range(20)])
    _, found, _, wrong = np.array(system.counts).sum(axis=0)
    assert found + wrong == 0


def test_if_nearly_everything_moves_all_is_used_and_reported(frames: list[Frame]) -> None:
    settings = resolve(SystemConfig, None, [*SETTINGS, "moving_objects.min_static=100000"])
    system = SlamSystem(CAMERA, settings)
    results = [system.process(frame) for frame in frames[:24]]
    assert results[-1].mostly_moving
    assert results[-1].ignored == 0
    assert not results[3].mostly_moving


@pytest.mark.parametrize("settled_share", [0.2, 1.0])
def test_many_static_points_override_the_mostly_moving_case(
    frames: list[Frame], settled_share: float
) -> None:
    settings = ["moving_objects.doubt_share=0.0", f"moving_objects.settled_share={settled_share}"]
    system = SlamSystem(CAMERA, resolve(SystemConfig, None, [*SETTINGS, *settings]))
    for frame in frames[:22]:
        system.process(frame)
    calls = []
    system.camera_tracker.preview = lambda *a: calls.append(1)  # type: ignore
    features = system.prepare(frames[22])
    static = system.moving_objects.filter(frames[22], features)
    assert static.moving.sum() > 20
    assert bool(calls) is (settled_share == 1.0)


def test_a_bad_prediction_does_not_make_the_room_move() -> None:
    system = SlamSystem(CAMERA, resolve(SystemConfig, None, SETTINGS))
    for k in range(4):
        system.process(view(k, with_card=False))
    jumped = pose(4) @ se3_exp(np.array([0, 0, 0, 0, 0, 0.35]))
    frame = render_plane(jumped, 4)
    features = system.prepare(frame)
    views = system.moving_objects.keyframe_views.posed(0, system.map)
    static = system.moving_objects.static_features_at(
        frame, features, system.camera_tracker.prediction(), views
    )
    assert static.moving.mean() > 0.5
    result = system.process(frame, features)
    assert result.status is TrackingStatus.OK
    assert result.T_world_camera is not None
    expected = inverse(pose(0)) @ jumped
    np.testing.assert_allclose(result.T_world_camera[:3, 3], expected[:3, 3], atol=0.02)
