"""Masks in time or late: covered observations are removed from map and graph."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_view import (
    CAMERA,
    add_keyframe,
    make_features,
    points_before,
    random_descriptors,
    render_plane,
)

from bmask_slam.back_end.factor_selection import FactorSelectionConfig, FactorSelector, read_back
from bmask_slam.back_end.pruning import MapPruner, PruneReport
from bmask_slam.config.configuration import resolve
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.factors.graph_update import GraphUpdate, RelativePose
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.graph.smoother.smoother import Smoother
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import TrackingStatus
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.map_state import world_of, world_state
from bmask_slam.world.masked_keypoints import keypoints_under
from bmask_slam.world.world_map import WorldMap

COUNT = 60


class Session:
    """Keyframes on a path along points, with the real graph; keypoint i observes point i."""

    def __init__(self, keyframes: int = 0, seed: int = 3) -> None:
        self.rng = np.random.default_rng(seed)
        self.points = points_before(np.eye(4), COUNT, self.rng)
        self.world, self.smoother = WorldMap(), Smoother(CAMERA)
        self.factor_selection = FactorSelector(FactorSelectionConfig(max_observations=1000))
        for _ in range(keyframes):
            self.add_keyframe(np.arange(COUNT))

    def add_keyframe(self, seen: Array, anew: Array | None = None) -> Keyframe:
        """Add a keyframe that observes some points; those in ``anew`` become new landmarks."""
        k = self.world.next_keyframe_id
        T = se3_exp(np.array([0.01 * k, -0.02 * k, 0.0, 0.05 * k, 0.01 * k, 0.02 * k]))
        noise_px = self.rng.normal(0, [0.3, 0.3, 0.05], (COUNT, 3))
        descriptors = random_descriptors(COUNT, self.rng)
        keyframe = add_keyframe(self.world, T, make_features(T, self.points, descriptors, noise_px))
        known = self.landmark_of_points()
        old = np.setdiff1d(seen[known[seen] >= 0], [] if anew is None else anew)
        self.world.attach(keyframe, old, known[old])
        new = np.setdiff1d(seen, old)
        self.world.make_landmarks(keyframe, new, self.points[new])
        read_back(
            self.world,
            self.smoother.update(self.factor_selection.keyframe_update(self.world, keyframe)),
        )
        return keyframe

    def landmark_of_points(self) -> Array:
        """The newest landmark (COUNT,) of each point, -1 for none."""
        known = np.full(COUNT, -1, np.int64)
        for keyframe in self.world.keyframes.values():
            keypoints, ids = self.world.observed(keyframe)
            known[keypoints] = ids
        return known

    def pruner(self) -> MapPruner:
        return MapPruner(self.world, self.smoother, CAMERA, border_px=-3)

    def prune_landmarks(self, ids: Array) -> PruneReport:
        """Remove landmarks from the map, and from the graph by an update."""
        report = self.pruner().prune_landmarks(ids)
        self.factor_selection.remove_landmarks(report.landmark_ids)
        update = self.factor_selection.map_update(self.world)
        read_back(self.world, self.smoother.update(update))
        return report

    def fuse(self) -> None:
        """Fuse the landmarks of each point into its oldest."""
        point = np.full(len(self.world.landmarks), -1, np.int64)
        for keyframe in self.world.keyframes.values():
            keypoints, ids = self.world.observed(keyframe)
            point[ids] = keypoints
        ids = np.flatnonzero(point >= 0)
        _, first, which = np.unique(point[ids], return_index=True, return_inverse=True)
        old, new = ids, ids[first][which]
        self.factor_selection.remove_landmarks(
            self.world.replace_landmarks(old[old != new], new[old != new])
        )

    def cull_keyframe(self, keyframe_id: int, parent_id: int) -> None:
        keyframes = self.world.keyframes
        self.world.remove_keyframe(keyframes[keyframe_id], keyframes[parent_id])
        self.factor_selection.remove_keyframe(keyframe_id)


def mask_of(session: Session, keyframe_id: int, keypoints: Array) -> Array:
    """A mask of only the pixels of these keypoints of a keyframe, which may be culled."""
    world = session.world
    views = {k: v.features.image_pixels for k, v in world.keyframes.items()}
    views |= {k: v.image_pixels for k, v in world.culled.items()}
    mask = np.zeros((CAMERA.height, CAMERA.width), bool)
    columns, rows = np.rint(views[keyframe_id][keypoints]).astype(int).T
    mask[rows, columns] = True
    return mask


def in_graph(smoother: Smoother) -> set[tuple[int, int]]:
    errors = smoother.observation_errors()
    return set(zip(errors.keyframe_ids.tolist(), errors.landmark_ids.tolist(), strict=True))


def in_map(world: WorldMap) -> set[tuple[int, int]]:
    """(keyframe, landmark) of observations that the map marks as in the graph."""
    pairs = set()
    for keyframe in world.keyframes.values():
        rows, ids = world.observed(keyframe)
        sent = world.landmarks.in_graph[ids] & (keyframe.sent_ids[rows] == ids)
        pairs |= {(keyframe.id, i) for i in ids[sent].tolist()}
    return pairs


def assert_consistent(world: WorldMap, smoother: Smoother) -> None:
    """Check that map and graph agree, counters are right, and masked keypoints observe nothing."""
    assert in_map(world) == in_graph(smoother)
    landmarks = world.landmarks
    graph_ids = smoother.estimate().landmark_ids
    np.testing.assert_array_equal(np.flatnonzero(landmarks.in_graph), graph_ids)
    views = np.zeros(len(landmarks), int)
    for keyframe in world.keyframes.values():
        assert (keyframe.landmark_ids[keyframe.masked] == -1).all()
        assert (keyframe.sent_ids[keyframe.masked] == -1).all()
        np.add.at(views, world.observed(keyframe)[1], 1)
    existing = landmarks.in_map
    np.testing.assert_array_equal(landmarks.observations[existing], views[existing])


def test_a_mask_covers_raw_pixels_without_its_border() -> None:
    mask = np.zeros((480, 640), bool)
    mask[100:200, 300:400] = True
    mask[400:, 600:] = True
    pixels = np.array(
        [[350, 150], [301.4, 150], [303, 150], [150, 350], [639.4, 479.4], [297, 150]]
    )
    assert keypoints_under(mask, pixels, 2).tolist() == [0, 2, 4]  # the image's edge is no border
    assert keypoints_under(mask, pixels, 0).tolist() == [0, 1, 2, 4]
    assert keypoints_under(mask, pixels, -4).tolist() == [0, 1, 2, 4, 5]


def test_masks_are_looked_up_in_the_distorted_image() -> None:
    session = Session(3)
    keyframe = session.world.keyframes[1]
    recorded = keyframe.features.image_pixels + np.array([7.0, -9.0])
    keyframe.features = replace(keyframe.features, image_pixels=recorded)
    chosen = np.array([4, 20])
    report = session.pruner().prune_mask(1, mask_of(session, 1, chosen))
    assert set(chosen) <= set(report.observations[:, 1].tolist())
    assert keyframe.masked[chosen].all()


def test_observations_are_removed_and_landmarks_kept() -> None:
    session = Session(4)
    newest, chosen = session.world.keyframes[3], np.array([5, 17, 30])
    before = in_graph(session.smoother)
    report = session.pruner().prune_mask(3, mask_of(session, 3, chosen))
    covered_ids = report.observations[:, 1]
    assert set(chosen) <= set(covered_ids.tolist())
    assert before - in_graph(session.smoother) == {(3, i) for i in covered_ids.tolist()}
    assert session.world.landmarks.in_map.all()
    assert len(report.landmark_ids) == 0
    assert newest.masked.sum() == len(covered_ids)
    assert_consistent(session.world, session.smoother)
    older = session.world.keyframes[2]  # the landmarks look as there again
    np.testing.assert_array_equal(
        session.world.landmarks.descriptors[covered_ids], older.features.descriptors[covered_ids]
    )
    assert (session.world.landmarks.last_keyframe[covered_ids] == 2).all()


def test_landmarks_are_removed_with_all_their_observations() -> None:
    session = Session(4)
    requested = np.array([5, 17])
    removed = session.prune_landmarks(np.array([17, 5, -1, 10**6])).landmark_ids
    assert removed.tolist() == requested.tolist()
    assert not session.world.landmarks.in_map[removed].any()
    assert all(k.masked[removed].all() for k in session.world.keyframes.values())
    assert not {i for _, i in in_graph(session.smoother)} & set(removed.tolist())
    assert_consistent(session.world, session.smoother)
    again = session.pruner().prune_landmarks(removed)
    assert len(again.landmark_ids) == 0
    assert str(again) == "nothing removed"


def test_a_landmark_with_one_observation_is_removed_with_it() -> None:
    session = Session(3)
    alone = session.add_keyframe(np.arange(40), anew=np.arange(5))
    ids = alone.landmark_ids[:5].copy()
    report = session.pruner().prune_mask(alone.id, mask_of(session, alone.id, np.arange(5)))
    assert set(ids.tolist()) <= set(report.landmark_ids.tolist())
    assert_consistent(session.world, session.smoother)


def test_a_late_mask_applies_after_fusing_and_culling() -> None:
    session = Session(3)
    first = session.add_keyframe(np.arange(COUNT), anew=np.arange(20))
    mask = mask_of(session, first.id, np.array([3, 8, 12]))
    old = first.landmark_ids[[3, 8]].copy()
    session.factor_selection.remove_landmarks(
        session.world.replace_landmarks(old, np.array([3, 8]))
    )
    session.world.landmarks.remove(first.landmark_ids[[12]])
    session.factor_selection.remove_landmarks(first.landmark_ids[[12]])
    culled = first.landmark_ids[12]
    session.add_keyframe(np.arange(20, COUNT))
    report = session.pruner().prune_mask(first.id, mask)
    assert {(first.id, 3), (first.id, 8)} <= set(map(tuple, report.observations.tolist()))
    assert culled not in {*report.landmark_ids.tolist(), *report.observations[:, 1].tolist()}
    assert_consistent(session.world, session.smoother)
    by_old_id = session.prune_landmarks(old)
    assert by_old_id.landmark_ids.tolist() == [3, 8]  # what they were fused into


def test_a_late_mask_of_a_culled_keyframe_finds_nothing_to_remove() -> None:
    session = Session(5)
    session.cull_keyframe(1, parent_id=2)
    session.add_keyframe(np.arange(10, COUNT))
    before = in_graph(session.smoother)
    report = session.pruner().prune_mask(1, mask_of(session, 1, np.array([7, 9])))
    assert not report.refused
    assert len(report.landmark_ids) == len(report.observations) == 0
    assert in_graph(session.smoother) == before


def test_a_repeated_mask_has_no_effect() -> None:
    session = Session(4)
    mask = mask_of(session, 2, np.array([5, 17]))
    session.pruner().prune_mask(2, mask)
    before = in_graph(session.smoother)
    again = session.pruner().prune_mask(2, mask)
    assert not again.refused
    assert len(again.observations) == len(again.landmark_ids) == 0
    assert in_graph(session.smoother) == before


@pytest.mark.parametrize(
    ("keyframe_id", "mask", "text"),
    [
        (77, np.zeros((480, 640), bool), "keyframe 77 is not in the map"),
        (1, np.zeros((240, 320), bool), "(240, 320)"),
        (1, np.zeros((480, 640), np.uint8), "uint8"),
    ],
)
def test_an_unusable_mask_is_rejected_with_the_reason(
    keyframe_id: int, mask: Array, text: str
) -> None:
    session = Session(3)
    before = in_graph(session.smoother)
    report = session.pruner().prune_mask(keyframe_id, mask)
    assert text in report.refused
    assert in_graph(session.smoother) == before


def test_a_keyframe_without_observations_is_anchored() -> None:
    session = Session(4)
    mask = np.ones((CAMERA.height, CAMERA.width), bool)
    report = session.pruner().prune_mask(2, mask)
    assert report.anchored_keyframes.tolist() == [2]
    assert str(report) == f"{COUNT} observations removed; keyframes anchored: [2]"
    assert session.world.keyframes[2].masked.all()
    assert_consistent(session.world, session.smoother)


EVENT = st.sampled_from(["keyframe", "fuse", "cull landmark", "cull keyframe", "mask", "mask"])


@settings(max_examples=15, deadline=None, derandomize=True)
@given(st.lists(EVENT, min_size=4, max_size=12), st.integers(0, 1000), st.booleans())
def test_map_and_graph_agree_in_any_order_of_events(
    events: list[str], seed: int, entirely: bool
) -> None:
    session = Session(3, seed)
    world, rng = session.world, session.rng
    for event in events:
        keyframes = list(world.keyframes)
        anew = rng.permutation(COUNT)[:10]
        if event == "keyframe":
            session.add_keyframe(np.sort(rng.permutation(COUNT)[:45]), anew)
        if event == "fuse":
            session.fuse()
        if event == "cull landmark":
            removed_ids = rng.permutation(np.flatnonzero(world.landmarks.in_map))[:3]
            world.landmarks.remove(removed_ids)
            session.factor_selection.remove_landmarks(removed_ids)
        if event == "cull keyframe" and len(keyframes) > 3:
            session.cull_keyframe(int(rng.choice(keyframes[1:-1])), parent_id=keyframes[-1])
        if event == "mask":
            keyframe_id = int(rng.choice([*world.keyframes, *world.culled]))
            mask = mask_of(session, keyframe_id, rng.permutation(COUNT)[:6])
            session.add_keyframe(np.arange(COUNT))  # what is pending goes first
            report = session.pruner().prune_mask(keyframe_id, mask)
            assert not report.refused
            if entirely:
                ids = np.flatnonzero(rng.random(len(world.landmarks)) < 0.05)
                report = session.prune_landmarks(ids)
            assert not world.landmarks.in_map[report.landmark_ids].any()
            assert_consistent(world, session.smoother)
    session.add_keyframe(np.arange(COUNT))
    assert_consistent(world, session.smoother)


def test_masked_keypoints_stay_out_of_the_running_system() -> None:
    """A late mask of half a picture, at every third frame; later keyframes fuse landmarks."""
    every_frame = ["keyframes.max_shared=9.0", "keyframes.min_interval_frames=1"]
    all_kept = [*every_frame, "mapping.redundant_share=1.1"]
    system = SlamSystem(CAMERA, resolve(SystemConfig, None, all_kept))
    poses = [
        se3_exp(np.array([0, 0.01 * i, 0, -0.6 + 0.03 * i, 0.02 * np.sin(i), 0])) for i in range(14)
    ]
    mask = np.zeros((480, 640), bool)
    mask[:, :320] = True
    pruned: set[tuple[int, int]] = set()
    for i, pose in enumerate(poses):
        result = system.process(render_plane(pose, i))
        assert result.status is TrackingStatus.OK
        late = max(system.mapper.world.next_keyframe_id - 2, 0)
        if i % 3 == 2 and late in system.mapper.world.keyframes:
            report = system.mapper.pruner().prune_mask(late, mask)
            pruned |= set(map(tuple, report.observations.tolist()))
    world = system.mapper.world
    masked = [k for k in world.keyframes.values() if k.masked.any()]
    assert len(masked) >= 2 and len(pruned) > 200
    for keyframe in masked:
        under = keypoints_under(mask, keyframe.features.image_pixels, 2)
        assert (keyframe.landmark_ids[under] == -1).all()
    assert not pruned & in_graph(system.mapper.smoother)
    assert in_graph(system.mapper.smoother) <= in_map(world)
    moving = np.flatnonzero(world.landmarks.in_graph)[:20]
    system.mapper.prune_landmarks(moving)  # after the last keyframe: no update follows
    system.finish()
    assert not np.isin(moving, system.mapper.smoother.estimate().landmark_ids).any()
    ends = system.trajectory().positions_world[[0, -1]]
    truth = np.array([poses[0][:3, 3], poses[-1][:3, 3]])
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(
        np.linalg.norm(truth[1] - truth[0]), abs=0.005
    )


def test_masked_keypoints_and_culled_keyframes_are_in_the_state_of_the_map() -> None:
    session = Session(5)
    session.pruner().prune_mask(2, mask_of(session, 2, np.array([5, 17])))
    session.cull_keyframe(1, parent_id=3)
    session.cull_keyframe(4, parent_id=3)
    world = world_of(world_state(session.world))
    for k, keyframe in session.world.keyframes.items():
        np.testing.assert_array_equal(world.keyframes[k].masked, keyframe.masked)
    assert world.keyframes[2].masked[[5, 17]].all()
    assert list(world.culled) == [1, 4]
    for k, view in session.world.culled.items():
        np.testing.assert_array_equal(world.culled[k].image_pixels, view.image_pixels)
        np.testing.assert_array_equal(world.culled[k].landmark_ids, view.landmark_ids)


def test_a_wrong_loop_is_removed_with_its_fusions() -> None:
    """The last keyframes observe other points, 1 m aside; a wrong loop fused both."""
    session = Session(4)
    first, T_wrong = session.points.copy(), np.array([1.0, 0.0, 0.0])
    for _ in range(4):  # on the way, half of the first points are still in view
        session.add_keyframe(np.arange(30, COUNT))
    session.points = np.where(np.arange(COUNT)[:, None] < 30, first + T_wrong, first)
    ends = [session.add_keyframe(np.arange(COUNT), anew=np.arange(30)) for _ in range(2)]
    session.add_keyframe(np.arange(COUNT))
    before = [k.T_world_camera for k in session.world.keyframes.values()]
    new_ids = ends[1].landmark_ids[:30].copy()
    T_a_b = np.eye(4)
    T_a_b[0, 3] = -0.5
    session.factor_selection.remove_landmarks(
        session.world.replace_landmarks(new_ids[:10], np.arange(10))
    )
    session.add_keyframe(np.arange(COUNT))
    loop = RelativePose(0, ends[1].id, T_a_b, np.eye(6) * 1e-4, "cauchy", "loop")
    session.smoother.update(GraphUpdate(relative_poses=(loop,)))
    report = session.pruner().prune_loop(ends[1].id, 0)
    assert report.loops == ((0, ends[1].id, "loop"),)
    assert set(report.observations[:, 1].tolist()) >= set(range(10))
    assert (report.observations[:, 0] >= ends[0].id).all()
    session.add_keyframe(np.arange(COUNT))
    read_back(session.world, session.smoother.optimise_batch())
    assert_consistent(session.world, session.smoother)
    after = [session.world.keyframes[k].T_world_camera for k in range(len(before))]
    np.testing.assert_allclose(after, before, atol=0.03)
    now = session.world.landmarks.points_world[ends[1].landmark_ids[:10]]
    np.testing.assert_allclose(now, session.points[:10], atol=0.1)
    np.testing.assert_allclose(session.world.landmarks.points_world[:10], first[:10], atol=0.1)
    absent = session.pruner().prune_loop(0, 99)
    assert absent.refused == "keyframe 99 is not in the map"
