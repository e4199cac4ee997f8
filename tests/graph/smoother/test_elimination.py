"""Long maps: their last poses are known to each other much better than in the world."""

from __future__ import annotations

import numpy as np
import pytest
from graph_checks import assert_isam_matches_tables, filled, from_scratch
from synthetic_room import CAMERA, make_room

from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_update import GraphUpdate, PosePrior, RelativePose
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.geometry import inverse, se3_exp
from bmask_slam.graph.smoother import elimination
from bmask_slam.graph.smoother.isam2 import Solver, SolverError

DRIFT_M, KNOWN_M = 2.0, 1e-4


def drifted_chain(keyframes: int = 8) -> FactorTables:
    """A keyframe that drift has moved from the first, and others that know it and each other."""
    rng, tables = np.random.default_rng(0), FactorTables()
    poses = se3_exp(rng.normal(0, 0.3, (keyframes, 6)))
    tables.keyframes.insert(np.arange(keyframes), poses)

    def relative(a: int, b: int, sigma: float) -> RelativePose:
        return RelativePose(a, b, inverse(poses[a]) @ poses[b], sigma**2 * np.eye(6))

    last = [(a, b) for a in range(1, keyframes) for b in range(a + 1, keyframes)]
    tables.add_pose_factors([PosePrior(0, poses[0], 1e-8 * np.eye(6)), relative(0, 1, DRIFT_M)])
    tables.add_pose_factors([relative(a, b, KNOWN_M) for a, b in last])
    return tables


def test_gtsam_refuses_the_last_pose_of_a_long_way_without_root_points() -> None:
    with pytest.raises(SolverError, match="Indeterminate"):
        Solver(CAMERA, SmootherConfig()).rebuild(drifted_chain())


def test_root_points_let_it_be_solved(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(elimination, "MANY_KEYFRAMES", 8)
    tables = drifted_chain()
    poses, solver = tables.keyframes.values.copy(), Solver(CAMERA, SmootherConfig())
    solver.rebuild(tables)
    np.testing.assert_allclose(tables.keyframes.values, poses, atol=1e-9)
    first = solver.marginal_covariance(tables, np.array([1]), np.zeros(0, np.int64))
    np.testing.assert_allclose(np.sqrt(np.diagonal(first)), DRIFT_M, rtol=1e-3)
    both = solver.marginal_covariance(tables, np.array([6, 7]), np.zeros(0, np.int64))
    assert np.isfinite(both).all()


def test_the_whole_graph_is_optimised_undamped_and_its_covariances_are_found(monkeypatch) -> None:
    """Without root points GTSAM refuses covariances, and damps each step until it can solve it."""
    moved, truth = drifted_chain(), drifted_chain().keyframes.values
    moved.keyframes.values = truth @ se3_exp(np.random.default_rng(1).normal(0, 1e-3, (8, 6)))
    moved.keyframes.values[0] = truth[0]
    solver = Solver(CAMERA, SmootherConfig(least_decrease=1e-12))
    with pytest.raises(SolverError, match="Indeterminate"):
        solver.marginals(drifted_chain(), np.zeros(0, np.int64))
    monkeypatch.setattr(elimination, "MANY_KEYFRAMES", 8)
    solver.optimise_batch(moved, 3)
    np.testing.assert_allclose(moved.keyframes.values, truth, atol=1e-8)
    found = solver.marginals(moved, np.zeros(0, np.int64)).keyframes
    np.testing.assert_allclose(np.sqrt(np.diagonal(found[1])), DRIFT_M, rtol=1e-3)


def test_they_follow_the_newest_keyframe_and_change_nothing(monkeypatch) -> None:
    monkeypatch.setattr(elimination, "MANY_KEYFRAMES", 5)
    room = make_room(keyframes=9, points=60, noise_px=0.4)
    smoother = filled(room, SmootherConfig(relinearize_threshold=1e-6))
    root = smoother._solver._root
    assert root.keys[0] == elimination.ROOT_BASE + 8 * elimination.POINTS
    assert_isam_matches_tables(smoother)
    smoother.update(GraphUpdate(remove_keyframes=np.array([8])))
    assert root.keys[0] == elimination.ROOT_BASE + 7 * elimination.POINTS
    assert_isam_matches_tables(smoother)
    for _ in range(3):
        found = smoother.update(GraphUpdate(max_iterations=10))
    assert not found.rebuilt
    best = from_scratch(smoother, room)
    np.testing.assert_allclose(found.poses_world_camera, best.poses_world_camera, atol=1e-4)
    again = GraphUpdate(
        keyframe_ids=np.array([7]),
        poses_world_camera=best.poses_world_camera[-1:],
        observations=room.observations.select(room.observations.keyframe_ids == 7),
        remove_keyframes=np.array([7]),
    )
    assert not smoother.update(again).rebuilt
    assert_isam_matches_tables(smoother)
    smoother.update(GraphUpdate(remove_keyframes=np.arange(4, 8)))  # few are left
    assert root.keys == []
    assert_isam_matches_tables(smoother)
