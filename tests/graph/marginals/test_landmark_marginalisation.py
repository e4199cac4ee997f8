"""Marginalised landmarks: their information on keyframes must be kept exactly once."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from graph_checks import assert_isam_matches_tables, pairs_of
from synthetic_room import CAMERA, Room, make_room

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.factors.factor_tables import ValueTable
from bmask_slam.graph.factors.graph_estimate import GraphEstimate, RefusalReason
from bmask_slam.graph.factors.graph_update import GraphUpdate, Observations
from bmask_slam.graph.geometry import adjoint, inverse, se3_exp, se3_log
from bmask_slam.graph.marginals.point_elimination import eliminate_points, linearise
from bmask_slam.graph.smoother.smoother import Smoother, SmootherConfig

ROOM = make_room(keyframes=10, points=150, noise_px=0.5, seed=3)


def filled(room: Room = ROOM, until: int = 99) -> Smoother:
    smoother = Smoother(CAMERA)
    for update in room.updates()[:until]:
        smoother.update(update)
    return smoother


def marginalise_landmarks(smoother: Smoother, ids: Array) -> GraphEstimate:
    return smoother.update(GraphUpdate(marginalise_landmarks=ids))


def pose_differences(a: GraphEstimate, b: GraphEstimate) -> Array:
    return se3_log(inverse(a.poses_world_camera) @ b.poses_world_camera)


def relative_sigmas(smoother: Smoother, a: int, b: int) -> Array:
    """Standard deviations (6,) of T_a^-1 T_b."""
    pair = np.array([a, b])
    Ta, Tb = (smoother.estimate().poses_world_camera[i] for i in (a, b))
    J = np.hstack([-adjoint(inverse(Tb) @ Ta), np.eye(6)])
    return np.sqrt(np.diag(J @ smoother.joint_covariance(pair) @ J.T))


def test_jacobians_are_finite_differences() -> None:
    observations, config = ROOM.observations, SmootherConfig(robust=False)
    poses, points = (
        ROOM.initial_poses[observations.keyframe_ids],
        ROOM.initial_points[observations.landmark_ids],
    )
    r, J_pose, J_point = linearise(observations, poses, points, CAMERA, config)
    for i in range(6):
        moved = poses @ se3_exp(1e-6 * np.eye(6)[i])
        slope = (linearise(observations, moved, points, CAMERA, config)[0] - r) / 1e-6
        np.testing.assert_allclose(slope, J_pose[:, :, i], rtol=1e-3, atol=1e-2)
    for i in range(3):
        moved = points + 1e-6 * np.eye(3)[i]
        slope = (linearise(observations, poses, moved, CAMERA, config)[0] - r) / 1e-6
        np.testing.assert_allclose(slope, J_point[:, :, i], rtol=1e-3, atol=1e-2)


def test_the_schur_complement_is_that_of_the_whole_normal_matrix() -> None:
    """Equal to the dense normal equations, and zero for a motion of the whole world."""
    observations = ROOM.observations.select(np.flatnonzero(ROOM.observations.landmark_ids < 20))
    ids, kinds = np.unique(observations.landmark_ids), np.arange(10)
    config = SmootherConfig()
    poses, points = ROOM.initial_poses, ROOM.initial_points[ids]
    keyframes, landmarks = ValueTable.of(kinds, poses), ValueTable.of(ids, points)
    information, left = eliminate_points(observations, keyframes, landmarks, CAMERA, config)
    column = np.searchsorted(ids, observations.landmark_ids)
    r, J_pose, J_point = linearise(
        observations, poses[observations.keyframe_ids], points[column], CAMERA, config
    )
    J = np.zeros((len(observations), 3, 60 + 3 * len(ids)))
    for m in range(len(observations)):
        k, j = 6 * int(observations.keyframe_ids[m]), 60 + 3 * int(column[m])
        J[m, :, k : k + 6], J[m, :, j : j + 3] = J_pose[m], J_point[m]
    J = J.reshape(-1, J.shape[2])
    N, g = J.T @ J, J.T @ r.ravel()
    solved = np.linalg.solve(N[60:, 60:], np.column_stack([N[60:, :60], g[60:]]))
    scale = np.abs(N).max()
    H = information.H.reshape(60, 60)
    np.testing.assert_allclose(H, N[:60, :60] - N[:60, 60:] @ solved[:, :60], atol=1e-9 * scale)
    np.testing.assert_allclose(information.g.ravel(), g[:60] - N[:60, 60:] @ solved[:, 60])
    np.testing.assert_allclose(left.covariances[3], np.linalg.inv(N[69:72, 69:72]), rtol=1e-6)
    together = adjoint(inverse(poses)).reshape(60, 6)
    assert np.abs(H @ together).max() < 1e-7 * scale


def test_marginalisation_over_two_keyframes_is_exact() -> None:
    """For two poses a relative pose represents all information: it is exact."""
    room = make_room(keyframes=2, points=60, noise_px=0.5)
    full, sparse = filled(room), filled(room)
    before = full.optimise_batch()
    full.update(GraphUpdate())
    sparse.optimise_batch()
    after = marginalise_landmarks(sparse, before.landmark_ids)
    assert len(after.landmark_ids) == 0
    assert after.factors == 2
    assert np.abs(pose_differences(before, after)).max() < 1e-6
    np.testing.assert_allclose(
        sparse.marginal_covariance(1), full.marginal_covariance(1), rtol=0.02, atol=1e-12
    )


def test_marginalisation_keeps_the_estimate_and_its_covariance() -> None:
    """The poses do not move, and their relative covariances hardly change."""
    full, sparse = filled(), filled()
    before = full.optimise_batch()
    full.update(GraphUpdate())
    sparse.optimise_batch()
    after = marginalise_landmarks(sparse, before.landmark_ids[::2])
    assert_isam_matches_tables(sparse)
    assert len(after.landmark_ids) == len(before.landmark_ids) - len(before.landmark_ids[::2])
    sigmas = [np.sqrt(np.diag(full.marginal_covariance(k))) for k in range(10)]
    assert np.abs(pose_differences(before, after) / sigmas).max() < 0.1
    for a, b in ((0, 1), (0, 5), (2, 9), (4, 6)):
        ratio = relative_sigmas(sparse, a, b) / relative_sigmas(full, a, b)
        assert (ratio > 0.5).all()
        assert (ratio < 1.6).all()


def test_a_graph_of_relative_poses_alone_is_consistent() -> None:
    """All landmarks are marginalised in groups: errors agree with the covariance (NEES)."""
    nees = []
    for seed in range(8):
        room = make_room(keyframes=10, points=80, noise_px=0.7, seed=seed)
        smoother = filled(room)
        for group in np.array_split(smoother.optimise_batch().landmark_ids, 3):
            estimate = marginalise_landmarks(smoother, group)
        assert len(estimate.landmark_ids) == 0
        for k in (4, 9):
            xi = se3_log(inverse(estimate.poses_world_camera[k]) @ room.poses_world_camera[k])
            nees.append(xi @ np.linalg.solve(smoother.marginal_covariance(k), xi))
    assert 6 * 0.3 < np.mean(nees) < 6 * 1.7


def test_a_restored_landmark_includes_its_marginal_factor() -> None:
    """Its position is unchanged; its old observations are refused a second time."""
    smoother = filled(until=6)
    before = smoother.optimise_batch()
    ids = before.landmark_ids[:40]
    marginalise_landmarks(smoother, ids)
    new = ROOM.update_of(6)
    old = ROOM.update_of(5).observations
    again = old.select(np.flatnonzero(np.isin(old.landmark_ids, ids)))
    marginalised = np.flatnonzero(~_last_view(again.landmark_ids, 5, until=6))
    repeated = again.select(marginalised)
    observed = Observations(
        *(
            np.concatenate([getattr(new.observations, n), getattr(repeated, n)])
            for n in ("keyframe_ids", "landmark_ids", "measurements", "sigmas_px")
        )
    )
    back = np.union1d(new.landmark_ids, ids)
    estimate = smoother.update(
        replace(
            new, landmark_ids=back, points_world=np.zeros((len(back), 3)), observations=observed
        )
    )
    assert estimate.refused.count(RefusalReason.DUPLICATE) == len(repeated)
    both, at, was = np.intersect1d(estimate.landmark_ids, before.landmark_ids, return_indices=True)
    assert np.isin(ids, both).all()
    moved_m = np.linalg.norm(estimate.points_world[at] - before.points_world[was], axis=1)
    assert np.median(moved_m) < 0.01
    assert_isam_matches_tables(smoother)


def test_a_batch_optimisation_is_that_of_the_full_graph() -> None:
    """Marginalised, restored and marginalised again: every observation is there once."""
    smoother, full = Smoother(CAMERA), Smoother(CAMERA)
    estimate = None
    for k, update in enumerate(ROOM.updates()):
        full.update(update)
        known = np.zeros(0, np.int64) if estimate is None else estimate.landmark_ids
        away = known[known % 5 == k % 5]
        observed = _without(update.observations, away)
        back = np.setdiff1d(observed.landmark_ids, known)
        estimate = smoother.update(
            replace(
                update,
                landmark_ids=back,
                points_world=ROOM.initial_points[back],
                observations=observed,
                marginalise_landmarks=away,
            )
        )
        assert len(estimate.refused) == 0
        assert_isam_matches_tables(smoother)
    assert len(estimate.landmark_ids) < 150
    assert set(smoother._tables.marginalised.returned) & set(estimate.landmark_ids.tolist())
    kept = pairs_of(full) - pairs_of(smoother) - _marginalised(smoother)
    assert all(j % 5 == k % 5 for k, j in kept)
    sparse, expected = smoother.optimise_batch(), full.optimise_batch()
    assert smoother._tables.marginalised.chunks == {}
    assert pairs_of(smoother) == pairs_of(full) - kept
    assert sparse.landmark_ids.tolist() == expected.landmark_ids.tolist()


def test_a_removed_observation_is_removed_from_its_group() -> None:
    """A marginalised outlier is removed afterwards: the result equals that without it."""
    room = make_room(keyframes=2, points=80, noise_px=0.3)
    observed = room.observations
    bad = int(np.flatnonzero(observed.keyframe_ids == 1)[5])
    measurements = observed.measurements.copy()
    measurements[bad] += [9.0, -7.0, 9.0]
    pair = np.array([[1, observed.landmark_ids[bad]]])
    without = observed.select(np.delete(np.arange(len(observed)), bad))
    with_outlier = filled(replace(room, observations=replace(observed, measurements=measurements)))
    clean = filled(replace(room, observations=without))
    everything = np.arange(80)
    for smoother in (with_outlier, clean):
        smoother.optimise_batch()
        marginalise_landmarks(smoother, everything)
    before = with_outlier.update(GraphUpdate())
    after = with_outlier.update(GraphUpdate(remove_observations=pair))
    assert_isam_matches_tables(with_outlier)
    expected = clean.update(GraphUpdate())
    assert (1, int(pair[0, 1])) not in _marginalised(with_outlier)
    off = np.abs(pose_differences(before, expected)).max()
    assert np.abs(pose_differences(after, expected)).max() < 0.3 * off


def test_a_group_that_is_renewed_away_from_its_optimum_leads_back() -> None:
    """A graph that has not come to rest must not be carried farther by each removal."""
    smoother = filled(make_room(keyframes=10, points=150, noise_px=0.5, seed=4))
    smoother.optimise_batch()
    ids = smoother.tables.landmarks.ids
    at_rest = marginalise_landmarks(smoother, ids)
    moved = at_rest.poses_world_camera @ se3_exp(
        0.003 * np.random.default_rng(0).normal(size=(10, 6))
    )
    smoother.tables.keyframes.values = np.concatenate([at_rest.poses_world_camera[:1], moved[1:]])
    offs_m = [np.abs(pose_differences(at_rest, smoother.estimate()))[:, 3:].max()]
    for landmark in ids[:8]:
        smoother.restart()
        after = smoother.update(GraphUpdate(remove_landmarks=np.array([landmark])))
        offs_m.append(np.abs(pose_differences(at_rest, after))[:, 3:].max())
    assert max(offs_m[1:]) < 0.5 * offs_m[0]


def test_a_culled_leaf_leaves_what_is_known_of_the_others() -> None:
    """All that its observations say of other keyframes stays, in theirs and in the tree."""
    smoother = filled()
    smoother.optimise_batch()
    before = marginalise_landmarks(smoother, smoother.tables.landmarks.ids)
    links = [factor.link for factor in smoother.tables.pose_factors.values()]
    ends = [k for link in links for k in link]
    leaf = next(k for k in before.keyframe_ids[::-1].tolist() if ends.count(k) == 1)
    other = next(k for k in before.keyframe_ids[::-1].tolist() if k != leaf)
    known = smoother.marginal_covariance(other)
    after = smoother.update(GraphUpdate(remove_keyframes=np.array([leaf])))
    assert after.factors == before.factors - 1
    left = before.keyframe_ids != leaf
    np.testing.assert_allclose(after.poses_world_camera, before.poses_world_camera[left], atol=1e-9)
    np.testing.assert_allclose(smoother.marginal_covariance(other), known, rtol=1e-6, atol=1e-15)
    marginalised = smoother.tables.marginalised
    assert not marginalised.chunks_with([leaf], [])
    assert all(s.keyframe_id != leaf for s in marginalised.summaries.values())


@pytest.mark.parametrize("what", ["landmark", "keyframe"])
def test_removals_apply_to_marginalised_observations_too(what: str) -> None:
    smoother = filled()
    estimate = smoother.optimise_batch()
    marginalise_landmarks(smoother, estimate.landmark_ids[:100])
    removed = estimate.landmark_ids[:30] if what == "landmark" else np.array([4, 9])
    after = smoother.update(
        GraphUpdate(remove_landmarks=removed)
        if what == "landmark"
        else GraphUpdate(remove_keyframes=removed)
    )
    assert_isam_matches_tables(smoother)
    column = 1 if what == "landmark" else 0
    assert not {pair[column] for pair in _marginalised(smoother)} & set(removed.tolist())
    assert len(after.anchored_keyframes) == 0
    assert not after.rebuilt
    full = smoother.optimise_batch()
    left = np.setdiff1d(estimate.landmark_ids, removed if what == "landmark" else [])
    assert full.landmark_ids.tolist() == left.tolist()


def test_a_saved_graph_keeps_its_marginalised_landmarks(tmp_path: Path) -> None:
    """Saving, loading and continuing equals a restart of the smoother."""
    smoother = filled(until=7)
    ids = smoother.optimise_batch().landmark_ids
    marginalise_landmarks(smoother, ids[::2])
    smoother.update(GraphUpdate(landmark_ids=ids[:10:2], points_world=np.zeros((5, 3))))
    smoother.restart()
    smoother.save(tmp_path / "graph")
    loaded = Smoother.load(tmp_path / "graph")
    assert _marginalised(loaded) == _marginalised(smoother)
    for k in (7, 8, 9):
        update = ROOM.update_of(k)
        back = np.setdiff1d(update.observations.landmark_ids, smoother.estimate().landmark_ids)
        update = replace(update, landmark_ids=back, points_world=ROOM.initial_points[back])
        a, b = smoother.update(update), loaded.update(update)
        assert np.array_equal(a.poses_world_camera, b.poses_world_camera)
    a, b = smoother.optimise_batch(), loaded.optimise_batch()
    assert a.factors == b.factors
    np.testing.assert_allclose(a.poses_world_camera, b.poses_world_camera, atol=1e-9)


def _without(observations: Observations, landmarks: Array) -> Observations:
    return observations.select(np.flatnonzero(~np.isin(observations.landmark_ids, landmarks)))


def _marginalised(smoother: Smoother) -> set[tuple[int, int]]:
    return {
        (int(k), int(j))
        for chunk in smoother._tables.marginalised.chunks.values()
        for k, j, again in zip(
            chunk.observations.keyframe_ids,
            chunk.observations.landmark_ids,
            chunk.is_summary,
            strict=True,
        )
        if not again
    }


def _last_view(landmarks: Array, keyframe: int, until: int) -> Array:
    """The landmarks without an observation after this keyframe and before ``until``."""
    observations = ROOM.observations
    later = observations.landmark_ids[
        (observations.keyframe_ids > keyframe) & (observations.keyframe_ids < until)
    ]
    return ~np.isin(landmarks, later)


def test_a_run_that_lost_its_newest_group_goes_on_as_one_that_is_loaded(tmp_path: Path) -> None:
    """The next group gets the same number, which is in the file."""
    smoother = filled()
    marginalise_landmarks(smoother, np.arange(10))
    marginalise_landmarks(smoother, np.arange(10, 14))
    smoother.update(GraphUpdate(remove_landmarks=np.arange(10, 14)))
    smoother.save(tmp_path / "graph")
    smoother.restart()
    loaded = Smoother.load(tmp_path / "graph")
    for one in (smoother, loaded):
        marginalise_landmarks(one, np.arange(20, 30))
    after, again = smoother.state(), loaded.state()
    assert after.keys() == again.keys()
    for name, array in after.items():
        np.testing.assert_array_equal(array, again[name], name)
