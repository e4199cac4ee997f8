"""Bundle adjustment on a synthetic room with exact truth: optimum, wrong views, wrong loops."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_room import CAMERA, Room, make_room

from bmask_slam.graph.batch.bundle_adjustment import AdjustmentConfig, adjust, loop_edges
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.checks import reprojection
from bmask_slam.graph.factors.factor_tables import Shadow
from bmask_slam.graph.factors.graph_update import PosePrior, RelativePose
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.geometry import Array, inverse, make_pose, se3_exp, se3_log

TIGHT = np.diag([1e-3] * 3 + [1e-2] * 3) ** 2
LOOSE = np.diag([0.2] * 3 + [0.5] * 3) ** 2


def shadow_of(room: Room) -> Shadow:
    """The room as a graph at its spoiled initial values, the first pose held."""
    shadow = Shadow()
    seen = np.unique(room.observations.landmark_ids)
    shadow.keyframes.insert(np.arange(len(room.initial_poses)), room.initial_poses)
    shadow.landmarks.insert(seen, room.initial_points[seen])
    shadow.observations.add(room.observations)
    shadow.add_pose_factors([PosePrior(0, room.initial_poses[0], 1e-8 * np.eye(6))])
    return shadow


def errors(shadow: Shadow, room: Room) -> Array:
    return np.abs(se3_log(inverse(shadow.keyframes.values) @ room.poses_world_camera)).max(axis=1)


def chi_squares(shadow: Shadow) -> Array:
    seen = shadow.observations.select(shadow.observations.all_rows())
    poses, points = shadow.keyframes.get(seen.keyframe_ids), shadow.landmarks.get(seen.landmark_ids)
    return reprojection(seen, poses, points, CAMERA)[1]


def loop(room: Room, a: int, b: int, error: Array | None = None) -> RelativePose:
    T_a_b = inverse(room.poses_world_camera[a]) @ room.poses_world_camera[b]
    T_a_b = T_a_b @ se3_exp(np.zeros(6) if error is None else error)
    return RelativePose(a, b, T_a_b, TIGHT, "cauchy", "loop")


def test_exact_measurements_give_the_truth() -> None:
    room = make_room()
    shadow = shadow_of(room)
    steps: list[tuple[int, float]] = []
    done = adjust(shadow, CAMERA, progress=lambda k, cost: steps.append((k, cost)))
    assert errors(shadow, room).max() < 1e-6
    seen = shadow.landmarks.ids
    np.testing.assert_allclose(shadow.landmarks.values, room.points_world[seen], atol=1e-5)
    assert done.final_cost < 1e-6 < done.initial_cost
    assert [k for k, _ in steps] == list(range(1, done.iterations + 1))
    assert len(done.wrong_observations) == len(done.wrong_loops) == len(done.dropped_landmarks) == 0


def test_the_cost_is_half_the_chi_squares_of_observations() -> None:
    room = make_room(noise_px=0.5, mono_share=0.3)
    shadow, config = shadow_of(room), SmootherConfig(robust=False)
    before = chi_squares(shadow)
    done = adjust(shadow, CAMERA, config, AdjustmentConfig(drop_observations=False))
    assert done.initial_cost == pytest.approx(before.sum() / 2, rel=1e-9)
    assert done.final_cost == pytest.approx(chi_squares(shadow).sum() / 2, rel=1e-3)  # the prior
    assert done.final_cost < 0.7 * done.initial_cost
    # measured at sigma: chi-square of as many degrees of freedom as measurements beyond unknowns
    seen = room.observations.measurements
    degrees = np.isfinite(seen).sum() - 6 * 11 - 3 * len(shadow.landmarks.ids)
    assert 2 * done.final_cost == pytest.approx(degrees, rel=5 / np.sqrt(degrees))


def test_wrong_observations_leave_and_the_rest_finds_the_truth() -> None:
    room = make_room(mono_share=0.2)
    rng = np.random.default_rng(5)
    seen, measurements = room.observations, room.observations.measurements.copy()
    _, first, views = np.unique(seen.landmark_ids, return_index=True, return_counts=True)
    wrong = rng.choice(first[views >= 6], 40, replace=False)  # one view of many
    measurements[wrong, 1] += rng.choice([-1, 1], 40) * rng.uniform(15, 60, 40)
    shadow = shadow_of(replace(room, observations=replace(seen, measurements=measurements)))
    done = adjust(shadow, CAMERA)
    planted = {(int(seen.keyframe_ids[k]), int(seen.landmark_ids[k])) for k in wrong}
    assert {(a, b) for a, b in done.wrong_observations.tolist()} == planted
    assert done.observations == len(seen)
    assert [stage.name for stage in done.stages] == ["robust", "inliers"]
    assert errors(shadow, room).max() < 1e-6


def test_without_the_last_stage_the_graph_keeps_its_observations() -> None:
    room = make_room(noise_px=2.0)
    shadow = shadow_of(replace(room))
    done = adjust(shadow, CAMERA, config=AdjustmentConfig(drop_observations=False))
    assert len(shadow.observations) == len(room.observations)
    assert len(done.stages) == 1


def two_rooms() -> tuple[Room, Shadow]:
    """Cameras 0 to 5 and 6 to 11 see no landmark in common; odometry between is 0.4 m off."""
    room = make_room()
    seen = room.observations
    late = seen.keyframe_ids >= 6
    landmarks = np.where(late, seen.landmark_ids + len(room.points_world), seen.landmark_ids)
    room = replace(
        room,
        points_world=np.tile(room.points_world, (2, 1)),
        initial_points=np.tile(room.initial_points, (2, 1)),
        observations=replace(seen, landmark_ids=landmarks),
    )
    off = np.array([0.0, 0.1, 0, 0.3, 0, 0.2])
    odometry = replace(loop(room, 5, 6, off), covariance=LOOSE, robust=None, kind="odometry")
    shadow = shadow_of(room)
    T_wrong_right = (
        room.poses_world_camera[5] @ odometry.T_a_b @ inverse(room.poses_world_camera[6])
    )
    shadow.keyframes.values[6:] = T_wrong_right @ shadow.keyframes.values[6:]
    far = shadow.landmarks.ids >= len(room.points_world) // 2
    moved = shadow.landmarks.values[far] @ T_wrong_right[:3, :3].T + T_wrong_right[:3, 3]
    shadow.landmarks.values[far] = moved
    shadow.add_pose_factors([odometry])
    return room, shadow


def test_wrong_loops_are_found_and_right_ones_close_the_gap() -> None:
    room, shadow = two_rooms()
    right = [loop(room, 0, 11), loop(room, 2, 9), loop(room, 4, 7)]
    wrong = [
        loop(room, 1, 10, np.array([0.1, 0, 0.4, 1.0, -0.5, 0.2])),
        loop(room, 3, 8, np.array([-0.6, 0.2, 0, 0.2, 0.9, 0.0])),
    ]
    shadow.add_pose_factors([*right, *wrong])
    assert errors(shadow, room)[6:].min() > 0.1
    done = adjust(shadow, CAMERA)
    assert done.wrong_loops.tolist() == [[1, 10], [3, 8]]
    assert done.loops == 5
    assert loop_edges(shadow).tolist() == [[0, 11], [2, 9], [4, 7]]
    assert errors(shadow, room).max() < 2e-3  # odometry still pulls a little
    assert "loops" in [stage.name for stage in done.stages]


def test_loops_that_agree_all_stay() -> None:
    room, shadow = two_rooms()
    shadow.add_pose_factors([loop(room, 0, 11), loop(room, 2, 9)])
    done = adjust(shadow, CAMERA)
    assert len(done.wrong_loops) == 0
    assert errors(shadow, room).max() < 2e-3


def test_results_move_with_the_world() -> None:
    T_new_old = make_pose(se3_exp(np.array([0.4, -1, 2, 0, 0, 0]))[:3, :3], np.array([3.0, -5, 2]))
    rooms = [room := make_room(noise_px=1.0, mono_share=0.2), room.moved(T_new_old)]
    shadows = [shadow_of(room) for room in rooms]
    here, there = (adjust(shadow, CAMERA) for shadow in shadows)
    np.testing.assert_array_equal(here.wrong_observations, there.wrong_observations)
    moved = T_new_old @ shadows[0].keyframes.values
    np.testing.assert_allclose(shadows[1].keyframes.values, moved, atol=1e-5)
    assert there.final_cost == pytest.approx(here.final_cost, rel=1e-6)


def test_an_empty_graph_and_a_spoiled_one_are_refused() -> None:
    with pytest.raises(InputError, match="no keyframe"):
        adjust(Shadow(), CAMERA)
    room = make_room()
    room.observations.measurements[3, 0] = np.nan
    with pytest.raises(InputError, match="cannot be solved: the cost is nan"):
        adjust(shadow_of(room), CAMERA)
