"""Removal by id: nothing else may change, and nothing may become underconstrained."""

from dataclasses import replace

import numpy as np
import pytest
from graph_checks import assert_isam_matches_tables, assert_same_optimum, filled
from synthetic_room import CAMERA, Room, make_room

from bmask_slam.graph.factors.graph_estimate import RefusalReason
from bmask_slam.graph.factors.graph_update import GraphUpdate, Observations, RelativePose
from bmask_slam.graph.geometry import inverse, se3_exp, se3_log, transform
from bmask_slam.graph.smoother.smoother import Smoother

ROOM = make_room(keyframes=8, points=80, noise_px=0.3)


def test_a_landmark_is_removed_with_all_its_factors() -> None:
    smoother = filled(ROOM)
    before = smoother.estimate()
    removed_ids = before.landmark_ids[[3, 10]]
    views = np.isin(ROOM.observations.landmark_ids, removed_ids).sum()
    after = smoother.update(GraphUpdate(remove_landmarks=removed_ids))
    assert after.factors == before.factors - views
    np.testing.assert_array_equal(
        after.landmark_ids, np.setdiff1d(before.landmark_ids, removed_ids)
    )
    assert not after.rebuilt
    assert_isam_matches_tables(smoother)
    assert_same_optimum(smoother, ROOM)


def test_a_keyframe_is_removed_with_all_its_factors() -> None:
    smoother = filled(ROOM)
    before = smoother.estimate()
    after = smoother.update(GraphUpdate(remove_keyframes=np.array([4])))
    assert after.keyframe_ids.tolist() == [0, 1, 2, 3, 5, 6, 7]
    assert after.factors == before.factors - (ROOM.observations.keyframe_ids == 4).sum()
    assert not after.rebuilt
    assert_isam_matches_tables(smoother)
    assert_same_optimum(smoother, ROOM)


def test_an_observation_is_removed_and_added_again() -> None:
    smoother = filled(ROOM)
    before = smoother.estimate()
    row = int(np.flatnonzero(observed_often(ROOM))[40])
    observed = ROOM.observations.select(np.array([row]))
    pair = observed.pairs
    after = smoother.update(GraphUpdate(remove_observations=pair))
    assert after.factors == before.factors - 1
    assert_isam_matches_tables(smoother)
    again = smoother.update(GraphUpdate(observations=observed))
    assert again.factors == before.factors
    assert len(again.refused) == 0
    twice = smoother.update(GraphUpdate(observations=observed))
    assert twice.refused.count(RefusalReason.DUPLICATE) == 1
    assert_isam_matches_tables(smoother)
    assert_same_optimum(smoother, ROOM)


@pytest.mark.parametrize("in_one_update", [False, True])
def test_a_removed_id_can_be_added_again(in_one_update: bool) -> None:
    """Landmark 5 becomes another point, keyframe 7 another keyframe."""
    smoother = filled(ROOM)
    observations = ROOM.observations
    rows = (observations.landmark_ids == 5) | (observations.keyframe_ids == 7)
    assert rows.sum() > 20
    removal = {"remove_landmarks": np.array([5]), "remove_keyframes": np.array([7])}
    if not in_one_update:
        smoother.update(GraphUpdate(**removal))
        removal = {}
    estimate = smoother.update(
        GraphUpdate(
            np.array([7]),
            ROOM.initial_poses[[7]],
            np.array([5]),
            ROOM.points_world[[5]] + 0.05,
            observations.select(rows),
            **removal,
        )
    )
    assert not estimate.rebuilt
    assert len(estimate.refused) == 0
    assert {5} <= set(estimate.landmark_ids.tolist())
    assert_isam_matches_tables(smoother)
    assert_same_optimum(smoother, ROOM)


def test_many_random_removals_and_additions() -> None:
    """Slots are reused and always hold the factors of the factor tables."""
    rng = np.random.default_rng(5)
    smoother = filled(ROOM)
    observations = ROOM.observations
    pairs = observations.pairs
    for _ in range(15):
        estimate = smoother.update(
            GraphUpdate(
                remove_landmarks=rng.choice(80, 3, replace=False),
                remove_keyframes=rng.choice(np.arange(1, 8), rng.integers(0, 2)),
                remove_observations=rng.permutation(pairs)[:20],
            )
        )
        assert not estimate.rebuilt
        assert_isam_matches_tables(smoother)
        keyframes = np.setdiff1d(np.arange(8), estimate.keyframe_ids)
        landmarks = rng.permutation(np.setdiff1d(np.arange(80), estimate.landmark_ids))[:6]
        estimate = smoother.update(
            GraphUpdate(
                keyframes,
                ROOM.poses_world_camera[keyframes],
                landmarks,
                ROOM.points_world[landmarks],
                rng_select(rng, observations),
            )
        )
        assert not estimate.rebuilt
        assert_isam_matches_tables(smoother)
    assert_same_optimum(smoother, ROOM)


def rng_select(rng: np.random.Generator, observations: Observations) -> Observations:
    return observations.select(
        np.sort(rng.permutation(len(observations))[: len(observations) // 2])
    )


def observed_often(room: Room) -> np.ndarray:
    """Mask of the observations whose landmark has four views or more."""
    ids, views = np.unique(room.observations.landmark_ids, return_counts=True)
    return np.isin(room.observations.landmark_ids, ids[views >= 4])


def test_unknown_ids_are_ignored_in_removals() -> None:
    nothing = GraphUpdate(
        remove_landmarks=np.array([99999]),
        remove_keyframes=np.array([77]),
        remove_observations=np.array([[0, 99999], [77, 1]]),
        remove_relative_poses=((0, 1, "loop"),),
    )
    empty = Smoother(CAMERA).update(nothing)
    assert len(empty.keyframe_ids) == 0
    smoother = filled(ROOM)
    before = smoother.estimate()
    assert smoother.update(nothing).factors == before.factors


def test_a_landmark_with_one_remaining_monocular_view_is_removed() -> None:
    room = make_room(keyframes=8, points=80, noise_px=0.3, mono_share=1.0)
    stereo = make_room(keyframes=8, points=80, noise_px=0.3)
    smoother = filled(stereo)
    new = np.arange(1000, 1080)
    observed = room.observations
    observed = Observations(
        observed.keyframe_ids,
        1000 + observed.landmark_ids,
        observed.measurements,
        observed.sigmas_px,
    )
    smoother.update(
        GraphUpdate(landmark_ids=new, points_world=room.points_world, observations=observed)
    )
    before = smoother.estimate()
    landmark_id = int(before.landmark_ids[before.landmark_ids >= 1000][0])
    views = observed.keyframe_ids[observed.landmark_ids == landmark_id]
    assert len(views) >= 3
    all_but_two = np.stack([views[:-2], np.full(len(views) - 2, landmark_id)], axis=1)
    kept = smoother.update(GraphUpdate(remove_observations=all_but_two))
    assert landmark_id in kept.landmark_ids
    report = smoother.update(GraphUpdate(remove_observations=np.array([[views[-2], landmark_id]])))
    assert report.dropped_landmarks.tolist() == [landmark_id]
    assert not report.rebuilt
    assert_isam_matches_tables(smoother)


def test_a_keyframe_without_landmarks_is_anchored_at_its_pose() -> None:
    smoother = filled(ROOM)
    before = smoother.estimate()
    observations = ROOM.observations
    own_ids = observations.landmark_ids[observations.keyframe_ids == 7]
    pairs = np.stack([np.full(len(own_ids) - 2, 7), own_ids[:-2]], axis=1)
    after = smoother.update(GraphUpdate(remove_observations=pairs))
    assert not after.rebuilt
    assert after.anchored_keyframes.tolist() == [7]
    np.testing.assert_allclose(after.poses_world_camera[7], before.poses_world_camera[7], atol=0.1)
    assert_isam_matches_tables(smoother)
    sigma_m = np.sqrt(np.diag(smoother.marginal_covariance(7))[3:])
    assert (sigma_m > 0.01).any()  # and it says how badly it is known


def test_a_keyframe_left_with_landmarks_in_one_spot_is_anchored() -> None:
    """Ten are more than the unknowns, but it could turn about them."""
    smoother, observed = filled(ROOM), ROOM.observations
    before = smoother.estimate()
    own = observed.select(observed.keyframe_ids == 7)
    apart = np.linalg.norm(own.measurements[:, :2] - own.measurements[0, :2], axis=1)
    leaving = own.select(np.argsort(apart)[10:])
    after = smoother.update(GraphUpdate(remove_observations=leaving.pairs))
    assert after.anchored_keyframes.tolist() == [7]
    np.testing.assert_allclose(after.poses_world_camera[7], before.poses_world_camera[7], atol=0.05)
    again = smoother.update(GraphUpdate(observations=leaving))
    assert again.factors == before.factors
    assert_isam_matches_tables(smoother)


def test_a_disconnected_pair_of_keyframes_is_anchored() -> None:
    """Each has enough common landmarks with the other, but both can rotate against the rest."""
    room = make_room(keyframes=8, points=240, noise_px=0.3)
    smoother, observed = filled(room), room.observations
    last_two = np.isin(observed.keyframe_ids, [6, 7])
    inside = np.isin(observed.landmark_ids, observed.landmark_ids[~last_two])
    both = np.intersect1d(*(observed.landmark_ids[observed.keyframe_ids == k] for k in (6, 7)))
    shared = np.intersect1d(both, observed.landmark_ids[~last_two])
    rest = ~last_two & np.isin(observed.landmark_ids, shared[2:])
    others = last_two & inside & ~np.isin(observed.landmark_ids, shared)
    leaving = observed.select(rest | others)
    pairs = leaving.pairs
    after = smoother.update(GraphUpdate(remove_observations=pairs))
    assert not after.rebuilt
    assert len(after.anchored_keyframes) == 1  # it carries the other
    assert after.keyframe_ids.tolist() == list(range(8))
    again = smoother.update(GraphUpdate(observations=leaving))
    assert again.factors == len(observed) + 1  # without the anchor: the observations and the prior
    assert_isam_matches_tables(smoother)


def test_the_gauge_is_kept_when_the_first_keyframe_is_removed() -> None:
    smoother = filled(ROOM)
    before = smoother.optimise_batch()
    after = smoother.update(GraphUpdate(remove_keyframes=np.array([0])))
    assert not after.rebuilt
    assert after.anchored_keyframes.tolist() == [1]
    difference = se3_log(inverse(after.poses_world_camera) @ before.poses_world_camera[1:])
    assert np.abs(difference).max() < 0.01
    np.testing.assert_allclose(after.poses_world_camera[0], before.poses_world_camera[1], atol=1e-3)


def test_after_removing_everything_a_new_graph_starts() -> None:
    smoother = filled(ROOM)
    empty = smoother.update(GraphUpdate(remove_keyframes=np.arange(8)))
    assert empty.factors == 0
    assert len(empty.landmark_ids) == 0
    for update in ROOM.updates():
        estimate = smoother.update(update)
    assert not estimate.rebuilt
    assert estimate.keyframe_ids.tolist() == list(range(8))
    assert_same_optimum(smoother, ROOM)


@pytest.mark.parametrize(("robust", "wrong_by"), [(None, 0.03), ("cauchy", 0.5), ("dcs", 0.5)])
def test_a_wrong_loop_is_removed_by_name(robust: str | None, wrong_by: float) -> None:
    smoother = filled(ROOM)
    right = smoother.optimise_batch()
    covariance = 1e-6 * np.eye(6)
    T_a_b = inverse(right.poses_world_camera[0]) @ right.poses_world_camera[7]
    odometry = RelativePose(0, 7, T_a_b, covariance)
    wrong = RelativePose(
        0, 7, T_a_b @ se3_exp(np.full(6, wrong_by)), covariance, robust, kind="loop"
    )
    smoother.update(GraphUpdate(relative_poses=(wrong, odometry)))
    bent = smoother.update(GraphUpdate())
    bend_m = np.linalg.norm(bent.poses_world_camera[7] - right.poses_world_camera[7])
    assert bend_m > 0.01 if robust is None else bend_m < 0.005
    removed = smoother.update(GraphUpdate(remove_relative_poses=((0, 7, "loop"),)))
    assert removed.factors == bent.factors - 1
    found = smoother.optimise_batch()
    np.testing.assert_allclose(found.poses_world_camera, right.poses_world_camera, atol=2e-3)


def test_removal_in_the_first_update_after_a_restart() -> None:
    """ISAM2 rejects a removal in its first update; the smoother starts with a smaller graph."""
    smoother = filled(ROOM)
    smoother.restart()
    estimate = smoother.update(
        GraphUpdate(remove_landmarks=np.array([5]), remove_keyframes=np.array([3]))
    )
    assert not estimate.rebuilt
    assert 3 not in estimate.keyframe_ids
    assert_isam_matches_tables(smoother)


def test_a_landmark_that_a_step_carries_through_its_cameras_is_dropped() -> None:
    """It holds nothing there, and GTSAM would fail at the next linearisation."""
    smoother = filled(ROOM)
    poses = smoother.estimate().poses_world_camera
    point = transform(poses[4], np.array([[0.1, 0.1, 4.0]]))
    seen = [CAMERA.project_stereo(transform(inverse(T), point))[0] for T in poses[3:5]]
    measured = np.array(seen) * [1, 1, np.nan]
    measured[:, 0] += np.sign(seen[1][0] - seen[0][0]) * np.array([49.0, -49.0])
    views = Observations(np.array([3, 4]), np.array([900, 900]), measured, np.ones((2, 3)))
    passed = smoother.update(
        GraphUpdate(landmark_ids=np.array([900]), points_world=point, observations=views)
    )
    at = passed.points_world[passed.landmark_ids == 900]
    assert transform(inverse(poses[4]), at)[0, 2] < 0
    after = smoother.update(GraphUpdate())
    assert not after.rebuilt
    assert after.dropped_landmarks.tolist() == [900]
    smoother.restart()
    assert not smoother.update(GraphUpdate()).rebuilt
    assert_isam_matches_tables(smoother)
    assert_same_optimum(smoother, ROOM)


def test_a_landmark_that_is_carried_too_far_away_for_any_parallax_is_dropped() -> None:
    """Of no depth, by measurements of another camera; GTSAM would fail at the next update."""
    smoother = filled(ROOM)
    poses = smoother.estimate().poses_world_camera
    point = transform(poses[4], np.array([[0.1, 0.1, 4.0]]))
    far = transform(poses[4], np.array([[25.0, 25.0, 1000.0]]))
    near, measured = (
        np.array([CAMERA.project_stereo(transform(inverse(T), p))[0] for T in poses[3:5]])
        * [1, 1, np.nan]
        for p in (point, far)
    )
    views = Observations(np.array([3, 4]), np.array([900, 900]), near, np.ones((2, 3)))
    smoother.update(
        GraphUpdate(landmark_ids=np.array([900]), points_world=point, observations=views)
    )
    found = smoother.remeasure(CAMERA, replace(views, measurements=measured))
    assert found.dropped_landmarks.tolist() == [900]
    assert not smoother.update(GraphUpdate()).rebuilt
    assert_isam_matches_tables(smoother)
    assert_same_optimum(smoother, ROOM)


@pytest.mark.parametrize("far_m", [1e3, 1e6])
def test_a_landmark_that_updates_carry_ever_farther_is_dropped(far_m: float) -> None:
    """Each step doubles its distance, until GTSAM fails at the next linearisation."""
    smoother = filled(ROOM)
    poses = smoother.estimate().poses_world_camera
    point, far = (transform(poses[4], np.array([[0.02, 0.02, 1.0]]) * z) for z in (4.0, far_m))
    seen = [CAMERA.project_stereo(transform(inverse(T), far))[0] for T in poses[3:5]]
    ids, measured = np.array([900]), np.array(seen) * [1, 1, np.nan]
    views = Observations(np.array([3, 4]), np.repeat(ids, 2), measured, np.ones((2, 3)))
    new = GraphUpdate(landmark_ids=ids, points_world=point, observations=views)
    estimates = [smoother.update(new), *(smoother.update(GraphUpdate()) for _ in range(14))]
    assert not any(e.rebuilt for e in estimates)
    assert np.concatenate([e.dropped_landmarks for e in estimates]).tolist() == [900]
    assert_isam_matches_tables(smoother)
    assert_same_optimum(smoother, ROOM)
