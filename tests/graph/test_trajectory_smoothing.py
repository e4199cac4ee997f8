"""Smoothed poses are nearer to the truth, whatever the noise, and likelihoods are exact."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import block_diag

from bmask_slam.graph.geometry import inverse, make_pose, se3_exp, se3_log, so3_exp
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.graph.trajectory_smoothing import (
    MIN_FRAMES,
    OVERLAP,
    STRETCH,
    Frames,
    MotionNoise,
    smooth,
)

STEP_S = 1 / 30


def walk(count: int, seed: int = 0, lost: slice = slice(0, 0)) -> Trajectory:
    """A camera on a smooth path, turning; frames in ``lost`` have no pose."""
    stamps_s = np.arange(count) * STEP_S
    draw = np.random.default_rng(seed)
    phase, rate = draw.uniform(0, 6, 6), draw.uniform(0.5, 2.5, 6)
    waves = np.sin(rate * stamps_s[:, None] + phase)
    poses = make_pose(so3_exp(0.4 * waves[:, :3]), 0.3 * waves[:, 3:])
    return Trajectory(np.delete(stamps_s, lost), np.delete(poses, lost, axis=0))


def measured(truth: Trajectory, sigmas: np.ndarray, seed: int = 1) -> Trajectory:
    """Poses with noise of standard deviations (N, 6) ``[rad, m]`` in the camera's frame."""
    noise = np.random.default_rng(seed).normal(size=(len(truth), 6)) * sigmas
    return Trajectory(truth.timestamps_s, truth.poses_world_camera @ se3_exp(noise))


def errors(found: Trajectory, truth: Trajectory) -> np.ndarray:
    """RMS (6,) in the camera's frame."""
    apart = se3_log(inverse(truth.poses_world_camera) @ found.poses_world_camera)
    return np.sqrt((apart**2).mean(axis=0))


def information(sigmas: np.ndarray) -> np.ndarray:
    return np.eye(6) / sigmas[:, None, :] ** 2


def test_noise_is_halved_and_what_is_seen_badly_follows_its_neighbours() -> None:
    truth = walk(240)
    sigmas = np.tile([2e-3, 2e-3, 2e-3, 5e-3, 5e-3, 5e-3], (240, 1))
    sigmas[100:104] *= 20
    raw = measured(truth, sigmas)
    found = smooth(raw, information(sigmas))
    assert (errors(found, truth) < 0.5 * errors(raw, truth)).all()
    there = slice(100, 104)
    apart = found.poses_world_camera[there, :3, 3] - truth.poses_world_camera[there, :3, 3]
    assert np.linalg.norm(apart, axis=1).max() < 0.02  # sigma is 0.1 m an axis


def test_a_frame_that_is_far_off_moves_neither_itself_nor_its_neighbours() -> None:
    """Its covariance does not tell; by least squares it would be off by 17 mm."""
    truth = walk(240)
    sigmas = np.tile([1e-3, 1e-3, 1e-3, 2e-3, 2e-3, 2e-3], (240, 1))
    raw = measured(truth, sigmas)
    raw.poses_world_camera[120, 0, 3] += 0.05
    found = smooth(raw, information(sigmas))
    apart = (found.poses_world_camera - truth.poses_world_camera)[110:131, :3, 3]
    assert np.linalg.norm(apart, axis=1).max() < 0.005


def test_a_camera_that_begins_to_turn_at_once_is_followed() -> None:
    """Least squares with motion of one accuracy are late by 4.3 mrad, more than the noise is."""
    path, sigmas = walk(240), np.tile([1e-3, 1e-3, 1e-3, 2e-3, 2e-3, 2e-3], (240, 1))
    turns = np.outer(np.clip(path.timestamps_s - 4.0, 0.0, None), [0.0, 0.5, 0.0])
    turned = path.poses_world_camera @ make_pose(so3_exp(turns), np.zeros((240, 3)))
    truth = Trajectory(path.timestamps_s, turned)
    found = smooth(measured(truth, sigmas), information(sigmas))
    apart = se3_log(inverse(truth.poses_world_camera) @ found.poses_world_camera)[110:131, :3]
    assert np.linalg.norm(apart, axis=1).max() < 0.004


def test_the_noise_is_of_the_cameras_frame() -> None:
    """Depth is bad along the optical axis only; covariances of another frame would be worse."""
    truth = walk(240, seed=3)
    turned = so3_exp(np.array([0.0, 2.0, 0.0]))
    truth = Trajectory(
        truth.timestamps_s, truth.poses_world_camera @ make_pose(turned, np.zeros(3))
    )
    sigmas = np.tile([1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 2e-2], (240, 1))
    raw = measured(truth, sigmas)
    right = errors(smooth(raw, information(sigmas)), truth)
    other = errors(smooth(raw, information(sigmas[:, [0, 1, 2, 5, 4, 3]])), truth)
    assert (right[3:5] < 1.2 * errors(raw, truth)[3:5]).all()
    assert right[5] < 0.5 * errors(raw, truth)[5]
    assert np.linalg.norm(right[3:]) < 0.9 * np.linalg.norm(other[3:])


def test_covariances_that_are_too_small_are_noticed() -> None:
    truth = walk(300, seed=5)
    sigmas = np.tile([3e-3] * 3 + [6e-3] * 3, (300, 1))
    raw = measured(truth, sigmas)
    stated = information(sigmas / 5)
    found = Frames(raw.timestamps_s, raw.poses_world_camera, np.linalg.inv(stated)).noise()
    estimated = np.sqrt(np.diagonal(found.covariances(np.linalg.inv(stated[:1]))[0]))
    np.testing.assert_allclose(estimated, sigmas[0], rtol=0.25)
    assert (errors(smooth(raw, stated), truth) < 0.6 * errors(raw, truth)).all()


def test_the_likelihood_is_that_of_the_dense_problem() -> None:
    """Differences of -2 log likelihood between two noises, without turns, by dense matrices."""
    count = 8
    stamps_s = np.cumsum(np.random.default_rng(2).uniform(0.02, 0.1, count))
    places = np.cumsum(np.random.default_rng(3).normal(size=(count, 3)) * 0.01, axis=0)
    poses = make_pose(np.tile(np.eye(3), (count, 1, 1)), places)
    frames = Frames(stamps_s, poses, np.tile(np.eye(6) * 1e-6, (count, 1, 1)))
    noises = MotionNoise(1.0, 1.0, 0.5, 1e-3, 2e-3), MotionNoise(3.0, 1.0, 0.1, 1e-3, 1e-3)
    sparse = [frames._solve(poses[:, :3, :3], noise)[1] for noise in noises]
    dense = [_dense_cost(stamps_s, places, noise) for noise in noises]
    turns = 3 * (_dense_cost(stamps_s, 0 * places[:, :1], noises[1], turn=True)
                 - _dense_cost(stamps_s, 0 * places[:, :1], noises[0], turn=True))  # fmt: skip
    assert sparse[1] - sparse[0] == pytest.approx(dense[1] - dense[0] + turns, rel=1e-6)


def _dense_cost(stamps_s, places, noise: MotionNoise, turn: bool = False) -> float:
    """-2 log of the density of places (N, D), whose first place and velocity are unknown."""
    least, density = (noise.least_rad, noise.turn) if turn else (noise.least_m, noise.shift)
    steps = np.diff(stamps_s)
    count = len(stamps_s)
    transition = np.zeros((2 * (count - 1), 2 * count))
    parts = []
    for k, t in enumerate(steps):
        rows = slice(2 * k, 2 * k + 2)
        transition[rows, 2 * k : 2 * k + 2] = [[-1, -t], [0, -1]]
        transition[rows, 2 * k + 2 : 2 * k + 4] = np.eye(2)
        parts.append(density * np.array([[t**3 / 3, t**2 / 2], [t**2 / 2, t]]))
    Q, R = block_diag(*parts), (noise.share * 1e-6 + least**2) * np.eye(count)
    seen = np.zeros((count, 2 * count))
    seen[np.arange(count), 2 * np.arange(count)] = 1
    precision = transition.T @ np.linalg.solve(Q, transition) + seen.T @ np.linalg.solve(R, seen)
    cost = 0.0
    for column in places.T:
        state = np.linalg.solve(precision, seen.T @ np.linalg.solve(R, column))
        apart, moved = column - seen @ state, transition @ state
        cost += apart @ np.linalg.solve(R, apart) + moved @ np.linalg.solve(Q, moved)
        cost += sum(np.linalg.slogdet(M)[1] for M in (Q, R, precision))
    return float(cost)


def test_frames_that_were_lost_leave_a_gap() -> None:
    truth = walk(200, lost=slice(80, 110))
    sigmas = np.tile([2e-3] * 3 + [5e-3] * 3, (len(truth), 1))
    raw = measured(truth, sigmas)
    found = smooth(raw, information(sigmas))
    assert len(found) == len(truth)
    assert (errors(found, truth) < 0.7 * errors(raw, truth)).all()


def test_stretches_join_without_a_step(monkeypatch) -> None:
    monkeypatch.setattr("bmask_slam.graph.trajectory_smoothing.LIKELIHOOD_FRAMES", 100)
    truth = walk(STRETCH + 2 * OVERLAP)
    sigmas = np.tile([2e-3] * 3 + [5e-3] * 3, (len(truth), 1))
    raw = measured(truth, sigmas)
    frames = Frames(raw.timestamps_s, raw.poses_world_camera, np.linalg.inv(information(sigmas)))
    middle = (len(truth) - 100) // 2
    whole = frames.smoothed(frames.part(middle, middle + 100).noise())
    found = smooth(raw, information(sigmas)).poses_world_camera
    near = slice(STRETCH - 5, STRETCH + 5)
    np.testing.assert_allclose(found[near], whole[near], atol=1e-6)


@pytest.mark.parametrize("unknown", [np.nan, 0.0])
def test_frames_of_unknown_accuracy(unknown: float) -> None:
    truth = walk(120)
    sigmas = np.tile([2e-3] * 3 + [5e-3] * 3, (120, 1))
    raw, stated = measured(truth, sigmas), information(sigmas)
    stated[0] = unknown
    assert (errors(smooth(raw, stated), truth) < 0.6 * errors(raw, truth)).all()
    assert smooth(raw, np.full_like(stated, unknown)) is raw
    short = Trajectory(raw.timestamps_s[: MIN_FRAMES - 1], raw.poses_world_camera[: MIN_FRAMES - 1])
    assert smooth(short, stated[: MIN_FRAMES - 1]) is short


def test_a_frame_that_rounding_makes_indefinite_is_unknown_and_the_others_are_smoothed() -> None:
    truth, turned = walk(120), np.linalg.qr(np.random.default_rng(0).normal(size=(6, 6)))[0]
    sigmas = np.tile([2e-3, 2e-3, 2e-3, 5e-3, 5e-3, 5e-3], (120, 1))
    raw, given = measured(truth, sigmas), information(sigmas)
    given[60] = turned @ np.diag([1e-6, 1e5, 1e6, 1e7, 1e8, 1e9]) @ turned.T
    assert np.linalg.eigvalsh(given[60])[0] > 0
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(np.linalg.inv(MotionNoise().covariances(np.linalg.inv(given[60]))))
    found = smooth(raw, given)
    assert (errors(found, truth) < 0.6 * errors(raw, truth)).all()
    given[60] = np.nan
    np.testing.assert_array_equal(found.poses_world_camera, smooth(raw, given).poses_world_camera)
