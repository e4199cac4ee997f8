"""Bundle adjustment on a synthetic room with exact truth: optimum, outliers, wrong loops."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_room import CAMERA, Room, make_room

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.batch.bundle_adjustment import AdjustmentConfig, adjust, loop_edges
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.checks import reprojection
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_update import PosePrior, RelativePose
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.geometry import inverse, make_pose, se3_exp, se3_log

TIGHT = np.diag([1e-3] * 3 + [1e-2] * 3) ** 2
LOOSE = np.diag([0.2] * 3 + [0.5] * 3) ** 2


def factor_tables_of(room: Room) -> FactorTables:
    """The room as a graph at its noisy initial values with the first pose fixed."""
    tables = FactorTables()
    observations = np.unique(room.observations.landmark_ids)
    tables.keyframes.insert(np.arange(len(room.initial_poses)), room.initial_poses)
    tables.landmarks.insert(observations, room.initial_points[observations])
    tables.observations.add(room.observations)
    tables.add_pose_factors([PosePrior(0, room.initial_poses[0], 1e-8 * np.eye(6))])
    return tables


def errors(tables: FactorTables, room: Room) -> Array:
    return np.abs(se3_log(inverse(tables.keyframes.values) @ room.poses_world_camera)).max(axis=1)


def chi_squares(tables: FactorTables) -> Array:
    observations = tables.observations.all()
    return reprojection(observations, *tables.values_of(observations), CAMERA)[1]


def loop(room: Room, a: int, b: int, error: Array | None = None) -> RelativePose:
    T_a_b = inverse(room.poses_world_camera[a]) @ room.poses_world_camera[b]
    T_a_b = T_a_b @ se3_exp(np.zeros(6) if error is None else error)
    return RelativePose(a, b, T_a_b, TIGHT, "cauchy", "loop")


def test_exact_measurements_give_the_truth() -> None:
    room = make_room()
    tables = factor_tables_of(room)
    steps: list[tuple[int, float]] = []
    done = adjust(tables, CAMERA, progress=lambda k, cost: steps.append((k, cost)))
    assert errors(tables, room).max() < 1e-6
    observations = tables.landmarks.ids
    np.testing.assert_allclose(tables.landmarks.values, room.points_world[observations], atol=1e-5)
    assert done.final_cost < 1e-6 < done.initial_cost
    assert [k for k, _ in steps] == list(range(1, done.iterations + 1))
    assert len(done.wrong_observations) == len(done.wrong_loops) == len(done.dropped_landmarks) == 0


def test_the_cost_is_half_the_chi_squares_of_observations() -> None:
    room = make_room(noise_px=0.5, mono_share=0.3)
    tables, config = factor_tables_of(room), SmootherConfig(robust=False)
    before = chi_squares(tables)
    done = adjust(tables, CAMERA, config, AdjustmentConfig(drop_observations=False))
    assert done.initial_cost == pytest.approx(before.sum() / 2, rel=1e-9)
    assert done.final_cost == pytest.approx(chi_squares(tables).sum() / 2, rel=1e-3)  # the prior
    assert done.final_cost < 0.7 * done.initial_cost
    # measured at sigma: chi-square of as many degrees of freedom as measurements beyond unknowns
    observations = room.observations.measurements
    degrees = np.isfinite(observations).sum() - 6 * 11 - 3 * len(tables.landmarks.ids)
    assert 2 * done.final_cost == pytest.approx(degrees, rel=5 / np.sqrt(degrees))


def test_wrong_observations_are_removed_and_the_truth_is_found() -> None:
    room = make_room(mono_share=0.2)
    rng = np.random.default_rng(5)
    observed, measurements = room.observations, room.observations.measurements.copy()
    _, first, views = np.unique(observed.landmark_ids, return_index=True, return_counts=True)
    wrong = rng.choice(first[views >= 6], 40, replace=False)  # one view of many
    measurements[wrong, 1] += rng.choice([-1, 1], 40) * rng.uniform(15, 60, 40)
    tables = factor_tables_of(
        replace(room, observations=replace(observed, measurements=measurements))
    )
    done = adjust(tables, CAMERA)
    planted = {(int(observed.keyframe_ids[k]), int(observed.landmark_ids[k])) for k in wrong}
    assert {(a, b) for a, b in done.wrong_observations.tolist()} == planted
    assert done.observations == len(observed)
    assert [stage.name for stage in done.stages] == ["robust", "inliers"]
    assert errors(tables, room).max() < 1e-6


def test_without_the_last_stage_no_observation_is_removed() -> None:
    room = make_room(noise_px=2.0)
    tables = factor_tables_of(replace(room))
    done = adjust(tables, CAMERA, config=AdjustmentConfig(drop_observations=False))
    assert len(tables.observations) == len(room.observations)
    assert len(done.stages) == 1


def two_rooms() -> tuple[Room, FactorTables]:
    """Cameras 0 to 5 and 6 to 11 have no common landmark; odometry between is 0.4 m off."""
    room = make_room()
    observed = room.observations
    late = observed.keyframe_ids >= 6
    landmarks = np.where(
        late, observed.landmark_ids + len(room.points_world), observed.landmark_ids
    )
    room = replace(
        room,
        points_world=np.tile(room.points_world, (2, 1)),
        initial_points=np.tile(room.initial_points, (2, 1)),
        observations=replace(observed, landmark_ids=landmarks),
    )
    off = np.array([0.0, 0.1, 0, 0.3, 0, 0.2])
    odometry = replace(loop(room, 5, 6, off), covariance=LOOSE, robust=None, kind="odometry")
    tables = factor_tables_of(room)
    T_wrong_right = (
        room.poses_world_camera[5] @ odometry.T_a_b @ inverse(room.poses_world_camera[6])
    )
    tables.keyframes.values[6:] = T_wrong_right @ tables.keyframes.values[6:]
    far = tables.landmarks.ids >= len(room.points_world) // 2
    moved = tables.landmarks.values[far] @ T_wrong_right[:3, :3].T + T_wrong_right[:3, 3]
    tables.landmarks.values[far] = moved
    tables.add_pose_factors([odometry])
    return room, tables


def test_wrong_loops_are_found_and_right_ones_close_the_gap() -> None:
    room, tables = two_rooms()
    right = [loop(room, 0, 11), loop(room, 2, 9), loop(room, 4, 7)]
    wrong = [
        loop(room, 1, 10, np.array([0.1, 0, 0.4, 1.0, -0.5, 0.2])),
        loop(room, 3, 8, np.array([-0.6, 0.2, 0, 0.2, 0.9, 0.0])),
    ]
    tables.add_pose_factors([*right, *wrong])
    assert errors(tables, room)[6:].min() > 0.1
    done = adjust(tables, CAMERA)
    assert done.wrong_loops.tolist() == [[1, 10], [3, 8]]
    assert done.loops == 5
    assert loop_edges(tables).tolist() == [[0, 11], [2, 9], [4, 7]]
    assert errors(tables, room).max() < 2e-3  # odometry still pulls a little
    assert "loops" in [stage.name for stage in done.stages]


def test_consistent_loops_are_all_kept() -> None:
    room, tables = two_rooms()
    tables.add_pose_factors([loop(room, 0, 11), loop(room, 2, 9)])
    done = adjust(tables, CAMERA)
    assert len(done.wrong_loops) == 0
    assert errors(tables, room).max() < 2e-3


def test_results_move_with_the_world() -> None:
    T_new_old = make_pose(se3_exp(np.array([0.4, -1, 2, 0, 0, 0]))[:3, :3], np.array([3.0, -5, 2]))
    rooms = [room := make_room(noise_px=1.0, mono_share=0.2), room.moved(T_new_old)]
    graphs = [factor_tables_of(room) for room in rooms]
    here, there = (adjust(tables, CAMERA) for tables in graphs)
    np.testing.assert_array_equal(here.wrong_observations, there.wrong_observations)
    moved = T_new_old @ graphs[0].keyframes.values
    np.testing.assert_allclose(graphs[1].keyframes.values, moved, atol=1e-5)
    assert there.final_cost == pytest.approx(here.final_cost, rel=1e-6)


def test_an_empty_graph_and_one_with_nan_are_rejected() -> None:
    with pytest.raises(InputError, match="no keyframe"):
        adjust(FactorTables(), CAMERA)
    room = make_room()
    room.observations.measurements[3, 0] = np.nan
    with pytest.raises(InputError, match="cannot be solved: the cost is nan"):
        adjust(factor_tables_of(room), CAMERA)
