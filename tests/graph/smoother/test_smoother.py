"""The smoother on a synthetic room with exact truth."""

import dataclasses

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2
from synthetic_room import CAMERA, Room, make_room

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.factors.graph_estimate import GraphEstimate, RefusalReason
from bmask_slam.graph.factors.graph_update import GraphUpdate, Observations, PosePrior, RelativePose
from bmask_slam.graph.factors.keys import keyframe_keys, landmark_keys
from bmask_slam.graph.geometry import inverse, se3_exp, se3_log, transform
from bmask_slam.graph.smoother.elimination import poses_last
from bmask_slam.graph.smoother.smoother import Smoother, SmootherConfig

T_NEW_OLD = se3_exp(np.array([0.4, -1.1, 0.7, 3.0, -5.0, 2.0]))


def run(room: Room, config: SmootherConfig | None = None) -> tuple[Smoother, GraphEstimate]:
    smoother = Smoother(CAMERA, config)
    for update in room.updates():
        estimate = smoother.update(update)
        assert not estimate.rebuilt
        assert not estimate.refused.count(RefusalReason.REPROJECTION)
    return smoother, estimate


def pose_errors(estimate: GraphEstimate, room: Room) -> Array:
    """Tangents (K, 6) of the true poses relative to the estimated ones."""
    truth = room.poses_world_camera[estimate.keyframe_ids]
    return se3_log(inverse(estimate.poses_world_camera) @ truth)


@pytest.mark.parametrize("mono_share", [0.0, 0.4])
def test_exact_measurements_give_the_truth(mono_share: float) -> None:
    room = make_room(mono_share=mono_share)
    smoother, estimate = run(room, SmootherConfig(extra_iterations=2))
    if mono_share:  # a monocular view that came too early is refused; give it again
        estimate = smoother.update(again(room, estimate))
    estimate = smoother.optimise_batch()
    assert len(estimate.keyframe_ids) == 12
    assert len(estimate.landmark_ids) > 0.95 * len(np.unique(room.observations.landmark_ids))
    assert np.abs(pose_errors(estimate, room)).max() < 1e-5
    np.testing.assert_allclose(
        estimate.points_world, room.points_world[estimate.landmark_ids], atol=1e-4
    )


def again(room: Room, estimate: GraphEstimate) -> GraphUpdate:
    """All observations and all landmarks that are not in the graph yet (delayed insertion)."""
    new = np.setdiff1d(np.unique(room.observations.landmark_ids), estimate.landmark_ids)
    return GraphUpdate(
        landmark_ids=new, points_world=room.initial_points[new], observations=room.observations
    )


def test_the_incremental_result_equals_the_batch_optimum() -> None:
    room = make_room(noise_px=0.5, mono_share=0.2)
    smoother, incremental = run(room, SmootherConfig(extra_iterations=3))
    batch = smoother.optimise_batch()
    assert batch.cost_after <= batch.cost_before
    assert batch.cost_before < 1.02 * batch.cost_after
    difference = se3_log(inverse(batch.poses_world_camera) @ incremental.poses_world_camera)
    assert np.abs(difference).max() < 5e-3


def test_results_move_with_the_world() -> None:
    room = make_room(noise_px=0.5, mono_share=0.2)
    results = [run(room), run(room.moved(T_NEW_OLD))]
    incremental = [estimate for _, estimate in results]
    batch = [smoother.optimise_batch() for smoother, _ in results]
    for (here, there), tolerance_m in ((incremental, 2e-3), (batch, 2e-5)):
        np.testing.assert_array_equal(here.landmark_ids, there.landmark_ids)
        moved = T_NEW_OLD @ here.poses_world_camera
        np.testing.assert_allclose(there.poses_world_camera, moved, atol=tolerance_m)
        points = transform(T_NEW_OLD, here.points_world)
        np.testing.assert_allclose(there.points_world, points, atol=5 * tolerance_m)


def test_two_runs_are_identical() -> None:
    room = make_room(noise_px=0.5, mono_share=0.2)
    (_, first), (_, second) = run(room), run(room)
    np.testing.assert_array_equal(first.poses_world_camera, second.poses_world_camera)
    np.testing.assert_array_equal(first.points_world, second.points_world)


def test_huber_bounds_the_effect_of_outliers() -> None:
    room = make_room(noise_px=0.5)
    observed = room.observations
    measurements = observed.measurements.copy()
    measurements[::25, ::2] += 20.0
    disturbed = dataclasses.replace(
        room, observations=dataclasses.replace(observed, measurements=measurements)
    )
    smoother, _ = run(room)
    clean = smoother.optimise_batch()
    harm_m = {}
    for robust in (True, False):
        smoother, _ = run(disturbed, SmootherConfig(robust=robust, gate_sigmas=1e3))
        moved = smoother.optimise_batch().poses_world_camera - clean.poses_world_camera
        harm_m[robust] = np.linalg.norm(moved[:, :3, 3], axis=1).mean()
    assert harm_m[True] < 0.2 * harm_m[False]
    assert harm_m[False] > 0.005


@pytest.mark.parametrize(("noise_px", "disparity_noise_px"), [(1.0, 1.0), (0.7, 0.15), (0.2, 1.0)])
def test_pose_covariance_is_consistent(noise_px: float, disparity_noise_px: float) -> None:
    """NEES: the squared error in units of the covariance is chi-square, 6 a pose."""
    nees = []
    for seed in range(20):
        room = make_room(6, 60, noise_px, seed=seed, disparity_noise_px=disparity_noise_px)
        smoother, _ = run(room, SmootherConfig(robust=False, gate_sigmas=1e3))
        xi = pose_errors(smoother.optimise_batch(), room)[5]
        nees.append(xi @ np.linalg.solve(smoother.marginal_covariance(5), xi))
    low, high = chi2.ppf([0.025, 0.975], 6 * len(nees))
    assert low < sum(nees) < high


def test_covariances_of_isam_and_of_all_factors_agree() -> None:
    room = make_room(keyframes=5, points=60, noise_px=0.5)
    smoother, _ = run(room, SmootherConfig(robust=False, extra_iterations=3))
    ids, landmarks = np.array([4, 2]), np.array([7])
    from_isam = smoother.joint_covariance(ids, landmarks)
    smoother.restart()
    from_tables = smoother.joint_covariance(ids, landmarks)
    assert from_isam.shape == (15, 15)
    np.testing.assert_allclose(from_isam, from_tables, atol=0.02 * np.abs(from_tables).max())
    np.testing.assert_allclose(
        from_tables[6:12, 6:12], smoother.marginal_covariance(2), rtol=1e-6, atol=1e-12
    )
    with pytest.raises(KeyError, match="77"):
        smoother.marginal_covariance(77)


def test_a_relative_pose_constrains_a_keyframe_without_observations() -> None:
    room = make_room()
    smoother, _ = run(room)
    T_a_b = se3_exp(np.array([0.1, 0.2, -0.1, 0.5, 0.1, -0.4]))
    edge = RelativePose(11, 12, T_a_b, np.diag([1e-6] * 3 + [1e-4] * 3))
    estimate = smoother.update(
        GraphUpdate(np.array([12]), room.poses_world_camera[[11]], relative_poses=(edge,))
    )
    smoother.update(GraphUpdate())
    expected = estimate.poses_world_camera[11] @ T_a_b
    np.testing.assert_allclose(smoother.estimate().poses_world_camera[12], expected, atol=1e-5)


def test_a_second_segment_has_its_own_prior() -> None:
    room = make_room(keyframes=4)
    smoother, _ = run(room)
    moved = room.moved(T_NEW_OLD)
    observations = moved.observations
    prior = PosePrior(100, moved.poses_world_camera[0], 1e-8 * np.eye(6))
    new = np.unique(observations.landmark_ids)
    estimate = smoother.update(
        GraphUpdate(
            100 + np.arange(4),
            moved.initial_poses,
            1000 + new,
            moved.initial_points[new],
            Observations(
                100 + observations.keyframe_ids,
                1000 + observations.landmark_ids,
                observations.measurements,
                observations.sigmas_px,
            ),
            priors=(prior,),
        )
    )
    assert len(estimate.keyframe_ids) == 8
    estimate = smoother.optimise_batch()
    np.testing.assert_allclose(estimate.poses_world_camera[4:], moved.poses_world_camera, atol=1e-4)


def test_observation_errors_find_a_planted_outlier() -> None:
    room = make_room(noise_px=0.5)
    observed = room.observations
    wrong = 200
    measurements = observed.measurements.copy()
    measurements[wrong, 1] += 6.0
    room = dataclasses.replace(
        room, observations=dataclasses.replace(observed, measurements=measurements)
    )
    smoother, _ = run(room)
    smoother.optimise_batch()
    errors = smoother.observation_errors()
    worst = int(np.argmax(errors.chi2))
    assert errors.keyframe_ids[worst] == observed.keyframe_ids[wrong]
    assert errors.landmark_ids[worst] == observed.landmark_ids[wrong]
    assert np.mean(errors.chi2 < 7.815) > 0.93
    assert errors.is_stereo.all()
    assert (errors.depth_m > 0.5).all()


def test_only_poses_are_eliminated_last() -> None:
    x1, x2 = keyframe_keys(np.array([1, 2]))
    graph = gtsam.NonlinearFactorGraph()
    noise = gtsam.noiseModel.Unit.Create(6)
    graph.add(gtsam.BetweenFactorPose3(x1, x2, gtsam.Pose3(), noise))
    calibration = gtsam.Cal3_S2(500.0, 500.0, 0.0, 320.0, 240.0)
    pixel_noise = gtsam.noiseModel.Unit.Create(2)
    (landmark,) = landmark_keys(np.array([7]))
    graph.add(gtsam.GenericProjectionFactorCal3_S2([1, 1], pixel_noise, x2, landmark, calibration))
    groups = poses_last(graph)
    assert groups.size() == 2
    assert groups.at(x1) == groups.at(x2) == 1


def test_relative_poses_of_a_kind_are_listed_with_their_covariances() -> None:
    """A new smoother with these relative poses has the same loops."""
    room = make_room(noise_px=0.3)
    smoother, _ = run(room)
    T_world_a, T_world_b = room.poses_world_camera[[0, 3]]
    loop = RelativePose(0, 3, inverse(T_world_a) @ T_world_b, 1e-4 * np.eye(6), "dcs", "loop")
    smoother.update(GraphUpdate(relative_poses=(loop,)))
    assert smoother.relative_poses("odometry") == ()
    (listed,) = smoother.relative_poses("loop")
    assert listed is loop
    other, _ = run(room)
    other.update(GraphUpdate(relative_poses=(listed,)))
    assert other.relative_pose_errors("loop").keyframe_b.tolist() == [3]


def test_notes_list_refused_factors_with_reasons() -> None:
    room, smoother = make_room(noise_px=0.3), Smoother(CAMERA)
    first, second = room.update_of(0), room.update_of(1)
    assert smoother.update(first).notes() == []
    observed = second.observations
    measurements = observed.measurements.copy()
    measurements[:2, 0] = np.inf
    loop = RelativePose(0, 77, np.eye(4), np.eye(6), kind="loop")
    estimate = smoother.update(
        dataclasses.replace(
            second,
            observations=dataclasses.replace(observed, measurements=measurements),
            relative_poses=(loop,),
        )
    )
    assert "2 observations refused: not finite" in estimate.notes()
    assert "1 factors refused: loop, unknown keyframe" in estimate.notes()
