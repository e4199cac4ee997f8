"""Covariances on exact synthetic scenes: they must agree with the errors."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.stats import chi2
from synthetic_room import CAMERA, Room, make_room

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.factors.graph_update import GraphUpdate, PosePrior
from bmask_slam.graph.geometry import adjoint, inverse, se3_exp, se3_log
from bmask_slam.graph.smoother.smoother import Smoother, SmootherConfig

GAUSSIAN = SmootherConfig(robust=False, gate_sigmas=1e3)
RUNS = 25


def solved(seed: int, mono_share: float = 0.0, config: SmootherConfig = GAUSSIAN) -> Smoother:
    """A room at its optimum; the first pose is drawn from its prior, so that it has an error."""
    room = room_of(seed, mono_share)
    sigmas = [0.01] * 3 + [0.02] * 3
    error = np.random.default_rng(seed).normal(0, sigmas)
    prior = PosePrior(0, room.poses_world_camera[0] @ se3_exp(error), np.diag(np.square(sigmas)))
    smoother = Smoother(CAMERA, config)
    observations = np.unique(room.observations.landmark_ids)
    smoother.update(
        GraphUpdate(
            np.arange(len(room.poses_world_camera)),
            room.initial_poses,
            observations,
            room.initial_points[observations],
            room.observations,
            priors=(prior,),
        )
    )
    smoother.optimise_batch()
    return smoother


def room_of(seed: int, mono_share: float) -> Room:
    return make_room(6, 60, 0.7, mono_share, seed, disparity_noise_px=0.15)


def pose_errors(smoother: Smoother, room: Room) -> Array:
    """xi (K, 6) with T_true = T_estimated @ exp(xi)."""
    estimate = smoother.estimate()
    return se3_log(inverse(estimate.poses_world_camera) @ room.poses_world_camera)


def nees(errors: Array, covariances: Array) -> Array:
    """Squared errors (N,) in units of their covariances (N, D, D)."""
    return np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[..., None])[..., 0])


def assert_consistent(values: list[float], dof: int) -> None:
    """The sum of independent values lies within the 95 % bounds of chi-square."""
    low, high = chi2.ppf([0.025, 0.975], dof * len(values))
    assert low < sum(values) < high


@pytest.mark.parametrize("mono_share", [0.0, 0.4])
def test_nees_of_poses_landmarks_and_pairs_is_one(mono_share: float) -> None:
    """One pose, landmark and pair per run, so that the values are independent."""
    pose, point, pair, step = [], [], [], []
    for seed in range(RUNS):
        smoother, room = solved(seed, mono_share), room_of(seed, mono_share)
        xi, estimate = pose_errors(smoother, room), smoother.estimate()
        row = seed % len(estimate.landmark_ids)
        chosen = estimate.landmark_ids[[row]]
        marginals = smoother.marginals(chosen)
        k = seed % 6
        pose += nees(xi[[k]], marginals.keyframes[[k]]).tolist()
        off = room.points_world[chosen] - estimate.points_world[[row]]
        point += nees(off, marginals.landmarks).tolist()
        ids = np.array([k, (k + 3) % 6])
        joint = smoother.joint_covariance(ids)
        pair += nees(xi[ids].reshape(1, 12), joint[None]).tolist()
        step += nees(*relative(smoother, room, ids, joint)).tolist()
    assert_consistent(pose, 6)
    assert_consistent(point, 3)
    assert_consistent(pair, 12)
    assert_consistent(step, 6)


def relative(smoother: Smoother, room: Room, ids: Array, joint: Array) -> tuple[Array, Array]:
    """Error (1, 6) and covariance (1, 6, 6) of T_a_b, from the joint of a and b."""
    T_a, T_b = smoother.estimate().poses_world_camera[ids]
    true_a, true_b = room.poses_world_camera[ids]
    T_a_b = inverse(T_a) @ T_b
    error = se3_log(inverse(T_a_b) @ inverse(true_a) @ true_b)
    J = np.hstack([-adjoint(inverse(T_a_b)), np.eye(6)])
    return error[None], (J @ joint @ J.T)[None]


def test_covariances_of_all_keyframes_equal_those_of_each() -> None:
    smoother = solved(0)
    marginals = smoother.marginals()
    assert marginals.keyframe_ids.tolist() == list(range(6))
    joint = smoother.joint_covariance(np.arange(6))
    blocks = joint.reshape(6, 6, 6, 6)[np.arange(6), :, np.arange(6)]
    np.testing.assert_allclose(marginals.keyframes, blocks, rtol=1e-6, atol=1e-12)
    with pytest.raises(KeyError, match="99999"):
        smoother.marginals(np.array([99999]))


def test_covariances_are_relative_to_the_first_keyframe() -> None:
    """If the world moves, covariances of poses stay and those of points rotate."""
    room, T_new_old = make_room(5, 60, 0.5), se3_exp(np.array([0.4, -1.1, 0.7, 3.0, -5.0, 2.0]))
    found = []
    for made in (room, room.moved(T_new_old)):
        smoother = Smoother(CAMERA, GAUSSIAN)
        for update in made.updates():
            smoother.update(update)
        smoother.optimise_batch()
        found.append(smoother.marginals(smoother.estimate().landmark_ids))
    here, there = found
    np.testing.assert_allclose(there.keyframes, here.keyframes, rtol=1e-3, atol=1e-9)
    R = T_new_old[:3, :3]
    np.testing.assert_allclose(there.landmarks, R @ here.landmarks @ R.T, rtol=1e-2, atol=1e-8)
    np.testing.assert_allclose(here.keyframes[0], np.eye(6) * 1e-8, rtol=0.05, atol=1e-11)


def test_an_outlier_has_the_weight_of_its_robust_kernel() -> None:
    """A far outlier has no weight with a robust kernel, and full weight without."""
    room = room_of(3, 0.0)
    observed = room.observations
    wrong = np.flatnonzero(observed.keyframe_ids == 5)[::6]
    clean = dataclasses.replace(
        room, observations=observed.select(~np.isin(np.arange(len(observed)), wrong))
    )
    observed.measurements[wrong, 1] += 300.0

    def sigma_m(room: Room, robust: bool) -> float:
        smoother = Smoother(CAMERA, SmootherConfig(robust=robust, gate_sigmas=1e3))
        for update in room.updates():
            smoother.update(update)
        smoother.optimise_batch()
        return float(np.sqrt(np.trace(smoother.marginals().keyframes[5, 3:, 3:])))

    assert sigma_m(room, True) == pytest.approx(sigma_m(clean, True), rel=0.02)
    assert sigma_m(room, False) < 0.99 * sigma_m(clean, True)
