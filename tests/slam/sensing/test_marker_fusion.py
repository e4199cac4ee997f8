"""Markers in a map: their places, moved ones, loops that they close, known poses, saved states."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from synthetic_view import CAMERA, add_keyframe, make_features, points_before, random_descriptors

from bmask_slam.back_end.config import BackEndConfig
from bmask_slam.back_end.landmark_management import MappingConfig
from bmask_slam.back_end.mapper import Mapper
from bmask_slam.back_end.marker_loops import join_by_markers
from bmask_slam.events import EventKind
from bmask_slam.features.marker_detection import possible_poses
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.factors.graph_update import MARKER, SITE, marker_id, marker_of, site_id
from bmask_slam.graph.geometry import (
    inverse,
    make_pose,
    quaternion_from_rotation,
    se3_exp,
    se3_log,
)
from bmask_slam.graph.sensors.config import SensorsConfig
from bmask_slam.graph.sensors.markers import CORNERS, MarkerPose, MarkersConfig, SeenCorners
from bmask_slam.graph.sensors.streams import Measurements
from bmask_slam.sensing import marker_fusion
from bmask_slam.sensing.marker_sightings import WORDS, MarkerSight, Verdict, drift_path
from bmask_slam.tracking.config import TrackingConfig
from bmask_slam.tracking.tracker import Tracker

SIGMA = 0.15 / 525
SIZE_M, STEP_S = 0.2, 0.25
PLACES = {
    4: make_pose(np.diag([1.0, -1.0, -1.0]), np.array([0.1, 0.0, 1.5]))
    @ se3_exp(np.array([0.2, 0.4, 0.1, 0, 0, 0])),
    9: make_pose(np.diag([1.0, -1.0, -1.0]), np.array([-0.4, 0.1, 2.0]))
    @ se3_exp(np.array([-0.3, 0.5, 0.6, 0, 0, 0])),
}
"""T_world_marker of two markers, before the first camera."""
T_SITE_WORLD = se3_exp(np.array([0.3, -0.2, 1.0, 4.0, 5.0, -1.0]))
KNOWN = MarkersConfig(enabled=True, size_m=SIZE_M)


def sightings(
    stamp_s: float, T_world_camera: Array, places: dict[int, Array], rng: np.random.Generator
) -> Measurements:
    """What a camera sees of markers, with noise of the corners and of their depth."""
    rows = []
    for number, T in sorted(places.items()):
        p = inverse(T_world_camera) @ T @ np.column_stack([SIZE_M * CORNERS, np.ones(4)]).T
        x, y, z, _ = p
        at = np.stack([x / z, y / z], axis=1) + SIGMA * rng.standard_normal((4, 2))
        w = 1 / z + 0.002 * rng.standard_normal(4)
        rows.append([stamp_s, number, *at.ravel(), SIGMA, *w, *np.full(4, 0.002)])
    return Measurements("markers", np.array(rows).reshape(-1, 19))


class Walk:
    """A map that grows by keyframes along x, seen points in common, and markers."""

    def __init__(self, config: MarkersConfig = KNOWN) -> None:
        mapping, sensors = MappingConfig(redundant_share=2.0), SensorsConfig(markers=config)
        self.rng = np.random.default_rng(3)
        rules = BackEndConfig(mapping, sensors=sensors)
        self.mapper = Mapper(CAMERA, Tracker(CAMERA, TrackingConfig()), rules)
        self.points = points_before(np.eye(4), 60, self.rng)
        self.looks = random_descriptors(60, self.rng)
        self.ids: Array | None = None
        self.truth: dict[int, Array] = {}
        self.segment = 0

    def step(self, T: Array, places: dict[int, Array], T_tracked: Array | None = None) -> None:
        """A keyframe at T that sees these markers; tracking has another pose if it drifted."""
        mapper, stamp_s = self.mapper, STEP_S * len(self.truth)
        noise = self.rng.normal(0, [0.3, 0.3, 0.05], (60, 3))
        features = make_features(T, self.points, self.looks, noise)
        keyframe = add_keyframe(
            mapper.world, T if T_tracked is None else T_tracked, features, self.segment
        )
        keyframe.timestamp_s = stamp_s
        if self.ids is None:
            tracked = keyframe.T_world_camera @ inverse(T)
            points = self.points @ tracked[:3, :3].T + tracked[:3, 3]
            self.ids = mapper.world.make_landmarks(keyframe, np.arange(60), points)
        else:
            mapper.world.attach(keyframe, np.arange(60), self.ids)
        mapper.loops.index.add(keyframe.id, features.descriptors)
        mapper.add_measurements(sightings(stamp_s, T, places, self.rng))
        mapper.events.begin_frame(len(self.truth), stamp_s)
        mapper.optimise(keyframe)
        mapper.close_loops(keyframe)
        self.truth[keyframe.id] = T

    def off(self) -> Array:
        """Errors (K, 6) of the keyframes."""
        known = self.mapper.world.keyframes
        return np.array(
            [se3_log(inverse(T) @ known[i].T_world_camera) for i, T in self.truth.items()]
        )

    def said(self) -> list[str]:
        return [event.text for event in self.mapper.events.take()]


def pose(k: int) -> Array:
    return se3_exp(np.array([0, 0.01 * k, 0, 0.03 * k, 0.01 * k, 0]))


@pytest.fixture(scope="module")
def six() -> Walk:
    walk = Walk()
    for k in range(6):
        walk.step(pose(k), PLACES)
    return walk


def test_markers_are_where_they_are(six: Walk) -> None:
    """In the world of the first camera, to a centimetre and a degree; frames and signs matter."""
    found = six.mapper.sensors.marker_map(six.mapper.smoother.tables, 0)
    assert [(m.id, m.seen, m.used, m.size_m) for m in found.markers] == [
        (4, 6, 6, pytest.approx(SIZE_M)),
        (9, 6, 6, pytest.approx(SIZE_M)),
    ]
    for marker in found.markers:
        error = se3_log(inverse(PLACES[marker.id]) @ marker.T_world_marker)
        assert np.abs(error[:3]).max() < 0.02
        assert np.abs(error[3:]).max() < 0.01


def test_the_sightings_fit_as_well_as_their_noise_says(six: Walk) -> None:
    """Mean chi-square of 12 factors, less what the poses take: within its 99 % band."""
    chi2 = six.mapper.smoother.relative_pose_errors(MARKER).chi2
    assert len(chi2) == 12
    assert 34 < chi2.sum() < 93  # 60 degrees: 72 less 12 of two markers


def test_a_marker_that_was_moved_is_refused_and_said() -> None:
    walk = Walk()
    for k in range(4):
        walk.step(pose(k), PLACES)
    moved = {4: PLACES[4] @ make_pose(np.eye(3), np.array([0.15, 0.0, 0.0])), 9: PLACES[9]}
    for k in range(4, 7):
        walk.step(pose(k), moved)
    said = [text for text in walk.said() if "marker 4 in keyframe" in text]
    assert len(said) == 1  # the first time
    assert "is 0.15" in said[0] or "is 0.14" in said[0]
    assert np.abs(walk.off()[:, 3:]).max() < 0.005
    walk.mapper.finish()
    assert "3 are not at the marker's place" in "".join(walk.said())
    counts = walk.mapper.events.counts
    assert (counts["markers: used"], counts["markers: refused"]) == (11, 3)
    (four, nine) = walk.mapper.sensors.marker_map(walk.mapper.smoother.tables, 0).markers
    assert (four.seen, four.used, nine.used) == (7, 4, 7)


AWAY = [
    se3_exp(np.array([0, 0.9 * k, 0, 0.8 * np.sin(0.9 * k), 0, -0.8 + 0.8 * np.cos(0.9 * k)]))
    for k in range(1, 7)
]
ROUND = [pose(0), pose(1), pose(2), *AWAY, pose(2), pose(3), pose(4)]
"""Away from the markers, once around, and back to them."""
DRIFT = se3_exp(np.array([0.002, 0.01, 0, 0.016, 0.002, 0.006]))
"""Of a step of the odometry."""


def walk_around(back: dict[int, Array]) -> Walk:
    """A round by odometry that drifts; what the camera sees when it is back is new to the map."""
    walk, tracked = Walk(), [ROUND[0]]
    for a, b in pairwise(ROUND):
        tracked.append(tracked[-1] @ inverse(a) @ b @ DRIFT)
    poses = np.array(tracked)
    quaternions = quaternion_from_rotation(poses[:, :3, :3])
    rows = np.column_stack([STEP_S * np.arange(len(poses)), poses[:, :3, 3], quaternions])
    walk.mapper.add_measurements(Measurements("odometry", rows))
    for k, T in enumerate(ROUND):
        if 3 <= k <= 9:  # from here on to the next nothing is seen twice
            walk.points, walk.ids = points_before(T, 60, walk.rng), None
            walk.looks = random_descriptors(60, walk.rng)
        before = walk.mapper.world.keyframes.get(k - 1)
        T_tracked = T
        if before is not None:
            step = poses if 3 <= k <= 9 else np.array(ROUND)
            T_tracked = before.T_world_camera @ inverse(step[k - 1]) @ step[k]
        walk.step(T, PLACES if k < 3 else back if k >= 9 else {}, T_tracked)
    return walk


def test_markers_that_are_seen_again_close_a_loop() -> None:
    lost, found = walk_around({}), walk_around(PLACES)
    assert np.linalg.norm(lost.off()[-1, 3:]) > 0.02
    assert np.linalg.norm(lost.off()[-1, :3]) > 0.05
    assert np.linalg.norm(found.off()[-1, 3:]) < 0.015
    assert np.linalg.norm(found.off()[-1, :3]) < 0.01
    assert found.mapper.events.counts["markers: loops"] == 2
    closed = [e.text for e in found.mapper.events.take() if e.kind is EventKind.LOOP_CLOSED]
    assert closed[0].startswith("keyframes 2 and 9 by marker 4, which was 0.0")
    robust = {f.robust for f in found.mapper.smoother.relative_poses(MARKER)}
    assert robust == {"cauchy"}


def test_of_two_markers_the_one_that_was_moved_closes_no_loop() -> None:
    """The other one implies less drift."""
    moved = {4: PLACES[4] @ make_pose(np.eye(3), np.array([0.0, 0.4, 0.0])), 9: PLACES[9]}
    walk = walk_around(moved)
    assert np.linalg.norm(walk.off()[-1, :3]) < 0.03
    assert np.linalg.norm(walk.off()[-1, 3:]) < 0.05
    said = walk.said()
    assert [text for text in said if "marker 4 in keyframe 9 is" in text]
    assert walk.mapper.events.counts["markers: loops"] == 1


def test_a_marker_that_two_segments_see_joins_them() -> None:
    """The second began after the camera was lost, in a world frame of its own."""
    walk, T_own_world = Walk(), se3_exp(np.array([0.5, -0.8, 0.3, 3.0, -1.0, 2.0]))
    for k in range(3):
        walk.step(pose(k), PLACES)
    walk.segment, walk.ids = 1, None
    walk.points, walk.looks = points_before(pose(4), 60, walk.rng), random_descriptors(60, walk.rng)
    walk.step(pose(4), {9: PLACES[9]}, T_own_world @ pose(4))
    assert join_by_markers(walk.mapper, 1) is None  # seen once
    walk.step(pose(5), {9: PLACES[9]}, T_own_world @ pose(5))
    walk.said()
    T = join_by_markers(walk.mapper, 1)
    assert T is not None
    assert np.linalg.norm(se3_log(T @ T_own_world)[3:]) < 0.1  # metres away
    assert walk.said()[0] == "segment 1 into segment 0, by marker 9"
    assert {k.segment for k in walk.mapper.world.keyframes.values()} == {0}
    assert np.abs(walk.off()[:, 3:]).max() < 0.03
    tables = walk.mapper.smoother.tables
    found = walk.mapper.sensors.marker_map(tables, 0).markers
    assert [(m.id, m.used) for m in found] == [(4, 3), (9, 5)]
    assert not walk.mapper.sensors.marker_map(tables, 1).markers


def test_known_poses_give_the_frame_of_a_site() -> None:
    rows = []
    for number, T in PLACES.items():
        T_site = T_SITE_WORLD @ T
        quaternion = quaternion_from_rotation(T_site[None, :3, :3])[0]
        rows.append((number, *T_site[:3, 3].tolist(), *quaternion.tolist()))
    walk = Walk(MarkersConfig(enabled=True, size_m=SIZE_M, poses=tuple(rows)))
    for k in range(4):
        walk.step(pose(k), PLACES)
    tables = walk.mapper.smoother.tables
    assert len(tables.relative_poses(SITE)) == 2
    found = walk.mapper.sensors.marker_map(tables, 0).T_world_site
    assert found is not None
    error = se3_log(found @ T_SITE_WORLD)
    assert np.abs(error[:3]).max() < 0.01
    assert np.abs(error[3:]).max() < 0.06  # five metres away
    assert tables.keyframes.contains(np.array([site_id(0)])).all()


def test_a_marker_too_far_to_tell_its_pose_is_looked_at_once_a_keyframe(monkeypatch) -> None:
    """Those of all keyframes were looked at again with each, 4 ms each."""
    looked: list[SeenCorners] = []

    def possible(seen: SeenCorners, *size: float) -> list[MarkerPose]:
        looked.append(seen)
        return possible_poses(seen, *size)

    monkeypatch.setattr(marker_fusion, "possible_poses", possible)
    far, walk = {7: make_pose(np.diag([1.0, -1.0, -1.0]), np.array([0.1, 0.0, 14.0]))}, Walk()
    for k in range(8):
        walk.step(pose(k / 5), far)
    (counts,) = walk.mapper.sensors.sightings().values()
    assert counts == {WORDS[Verdict.AMBIGUOUS]: 8}
    assert len(looked) == 8
    walk.step(pose(2), PLACES | {7: make_pose(far[7][:3, :3], np.array([0.1, 0.0, 1.2]))})
    assert walk.mapper.sensors.sightings()[marker_id(0, 7)]["used"] == 1


def test_sizes_that_are_not_known_are_measured() -> None:
    walk = Walk(MarkersConfig(enabled=True))
    for k in range(5):
        walk.step(pose(k), PLACES)
    found = walk.mapper.sensors.marker_map(walk.mapper.smoother.tables, 0).markers
    assert [m.id for m in found] == [4, 9]
    np.testing.assert_allclose([m.size_m for m in found], SIZE_M, rtol=0.01)
    assert np.abs(walk.off()[:, 3:]).max() < 0.005


def test_a_state_and_a_graph_that_is_built_anew_keep_the_markers(six: Walk) -> None:
    """Also in the next recording, whose measurements are others."""
    twin = Walk().mapper
    twin.restore(six.mapper.state(), Path("run/checkpoint"))
    before = twin.sensors.marker_map(twin.smoother.tables, 0).markers
    assert [(m.id, m.seen, m.used) for m in before] == [(4, 6, 6), (9, 6, 6)]
    twin.rebuild()
    twin.begin_session()
    twin.rebuild()
    after = twin.sensors.marker_map(twin.smoother.tables, 0).markers
    assert [(m.id, m.used) for m in after] == [(4, 6), (9, 6)]
    for old, new in zip(before, after, strict=True):
        np.testing.assert_allclose(old.T_world_marker, new.T_world_marker, atol=3e-3)


def test_a_refused_sighting_stays_refused_in_the_next_recording() -> None:
    """Also where the graph is built anew."""
    walk = Walk()
    for k in range(4):
        walk.step(pose(k), PLACES)
    walk.step(pose(4), {4: PLACES[4] @ make_pose(np.eye(3), np.array([0.15, 0.0, 0.0]))})
    before = walk.mapper.sensors.sightings()
    assert before[marker_id(0, 4)] == {"used": 4, WORDS[Verdict.MOVED]: 1}
    walk.mapper.begin_session()
    assert walk.mapper.sensors.sightings() == before
    walk.mapper.rebuild()
    assert walk.mapper.sensors.sightings() == before


def test_known_poses_hold_in_the_next_recording_too() -> None:
    """The graph is built anew, and no marker was seen again."""
    row = (4, *PLACES[4][:3, 3].tolist(), *quaternion_from_rotation(PLACES[4][None, :3, :3])[0])
    walk = Walk(MarkersConfig(enabled=True, size_m=SIZE_M, poses=(row,)))
    for k in range(3):
        walk.step(pose(k), PLACES)
    walk.mapper.begin_session()
    walk.mapper.rebuild()
    tables = walk.mapper.smoother.tables
    assert len(tables.relative_poses(SITE)) == 1
    found = walk.mapper.sensors.marker_map(tables, 0).T_world_site
    assert found is not None
    assert np.abs(se3_log(found)).max() < 0.03


def test_the_ids_of_markers_are_those_of_nothing_else() -> None:
    assert marker_of(marker_id(3, 17)) == (3, 17)
    assert marker_of(site_id(0)) is None
    assert marker_of(5) is None


def test_drift_is_that_of_the_way_where_no_landmark_is_left() -> None:
    """Keyframes in a row alone link the map then; it ended in a ValueError."""
    walk = Walk()
    for k in range(4):
        walk.step(pose(k), {})
    mapper = walk.mapper
    mapper.prune_landmarks(np.flatnonzero(mapper.world.landmarks.in_map))
    sight = MarkerSight(mapper.world, mapper.smoother.tables, mapper.loops.noise, {})
    steps = [
        inverse(a) @ b for a, b in pairwise(k.T_world_camera for k in mapper.world.in_segment(0))
    ]
    expected = sum(np.linalg.norm(step[:3, 3]) for step in steps)
    assert drift_path(sight, 3, [0])[1] == pytest.approx(expected)


def test_an_imus_mounting_is_tried_after_so_many_keyframes_in_two_segments_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """By turns, the segments seemed to have grown each time: it was tried twice a keyframe."""
    walk, tried = Walk(), []
    walk.mapper.add_measurements(Measurements("imu", np.column_stack([np.arange(9), np.eye(9, 6)])))
    estimator = walk.mapper.sensors.imu
    monkeypatch.setattr(estimator, "_estimate", lambda keyframes, _: tried.append(len(keyframes)))
    for k in range(12):
        walk.step(pose(k), {})
    walk.segment, walk.ids = 1, None
    for k in range(12, 18):
        walk.step(pose(k), {})
    assert tried == [5, 10, 1, 6]
