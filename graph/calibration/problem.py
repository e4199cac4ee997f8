"""The inputs of self-calibration, and the equations of its priors and anchors."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.calibration.model import PARAMETERS, CalibrationViews
from bmask_slam.graph.geometry import inverse, se3_log, skew

N = len(PARAMETERS)


@dataclass(frozen=True)
class Anchors:
    """External measurements of the camera's positions in metres.

    Attributes:
        positions_world: (K, 3) of the keyframes, NaN where unknown.
        position_sigma_m: their standard deviation.
        on_body: they are those of a body fixed to the camera, such as markers, whose position in
            the camera's frame is estimated too.
        ends: (D, 2) pairs of keyframes between which a distance was measured,
        arms_m: (D, 2, 3) the points in those keyframes' frames at which it was,
        distances_m: (D,) the distances, and
        distance_sigma_m: their standard deviation.
    """

    positions_world: Array
    position_sigma_m: float = 0.01
    on_body: bool = False
    ends: Ints = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    arms_m: Array = field(default_factory=lambda: np.zeros((0, 2, 3)))
    distances_m: Array = field(default_factory=lambda: np.zeros(0))
    distance_sigma_m: float = 0.005


@dataclass(frozen=True)
class CalibrationProblem:
    """Measurements, initial values and priors.

    Attributes:
        views: the measurements.
        poses_world_camera: (K, 4, 4); points_world: (L, 3); calibration: (18,), see PARAMETERS.
        prior_sigmas: (18,) around ``calibration``; 0 holds a parameter fixed.
        pose_sigmas: (6,) of the prior on the first pose ``[rad, m]``, which fixes the frame.
        anchors: if None, only the prior determines the scale.
    """

    views: CalibrationViews
    poses_world_camera: Array
    points_world: Array
    calibration: Array
    prior_sigmas: Array
    pose_sigmas: Array
    anchors: Anchors | None = None


@dataclass(frozen=True)
class CalibrationState:
    """Current values: poses (K, 4, 4), points (L, 3) and the vector (18,) of PARAMETERS."""

    poses: Array
    points: Array
    calibration: Array

    @property
    def values(self) -> tuple[Array, Array, Array]:
        """All three, as ``linearise`` takes them."""
        return self.poses, self.points, self.calibration


def prior_residuals(problem: CalibrationProblem, state: CalibrationState) -> tuple[Array, Array]:
    """Of the first pose (6,) and of the calibration (18,), zero for what is held fixed."""
    pose = se3_log(inverse(problem.poses_world_camera[0]) @ state.poses[0]) / problem.pose_sigmas
    sigmas = problem.prior_sigmas
    moved = state.calibration - problem.calibration
    return pose, np.divide(moved, sigmas, out=np.zeros(N), where=sigmas > 0)


def prior_information(problem: CalibrationProblem, state: CalibrationState) -> Array:
    """What priors and anchors add to the reduced normal equations, (6K + 18) square."""
    information = np.zeros((6 * len(state.poses) + N,) * 2)
    _, J = anchor_terms(problem, state)
    information[:-N, :-N] = J.T @ J
    information[range(6), range(6)] += problem.pose_sigmas**-2
    sigmas = problem.prior_sigmas
    at = len(information) - N + np.flatnonzero(sigmas > 0)
    information[at, at] += sigmas[sigmas > 0] ** -2
    return information


def add_priors(problem: CalibrationProblem, state: CalibrationState, S: Array, b: Array) -> None:
    """Priors and anchors into the reduced equations; fixed parameters are taken out of them."""
    held = len(b) - N + np.flatnonzero(problem.prior_sigmas == 0)
    S[held], S[:, held], b[held] = 0.0, 0.0, 0.0
    S[held, held] = 1.0
    S += prior_information(problem, state)
    pose, calibration = prior_residuals(problem, state)
    r, J = anchor_terms(problem, state)
    sigmas = problem.prior_sigmas
    b[:6] += pose / problem.pose_sigmas
    b[:-N] += J.T @ r
    b[-N:] += np.divide(calibration, sigmas, out=np.zeros(N), where=sigmas > 0)


def anchor_terms(problem: CalibrationProblem, state: CalibrationState) -> tuple[Array, Array]:
    """Whitened residuals (A,) of the anchors and derivatives (A, 6K) by the poses' tangents."""
    K, anchors = len(state.poses), problem.anchors
    if anchors is None:
        return np.zeros(0), np.zeros((0, 6 * K))
    r, J = _position_terms(anchors, state.poses)
    ends = transform_each(state.poses[anchors.ends], anchors.arms_m)
    between = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(between, axis=1)
    unit = between / np.maximum(length, 1e-9)[:, None] / anchors.distance_sigma_m
    J_d = np.zeros((len(length), K, 6))
    rows = np.arange(len(length))
    for end, sign in ((0, -1.0), (1, 1.0)):
        k = anchors.ends[:, end]
        by_tangent = np.concatenate(
            [-skew(anchors.arms_m[:, end]), np.broadcast_to(np.eye(3), (len(k), 3, 3))], axis=2
        )
        turned = state.poses[k, :3, :3] @ by_tangent
        J_d[rows, k] += sign * np.einsum("di,dij->dj", unit, turned)
    r_d = (length - anchors.distances_m) / anchors.distance_sigma_m
    return np.r_[r, r_d], np.concatenate([J, J_d.reshape(-1, 6 * K)])


def _position_terms(anchors: Anchors, poses: Array) -> tuple[Array, Array]:
    """Whitened residuals (A,) of the positions and their derivatives (A, 6K).

    A body's position is eliminated: residuals and derivatives are those at its best position,
    without the part that a change of it would absorb (variable projection, Kaufman, BIT 1975).
    """
    known = np.flatnonzero(np.isfinite(anchors.positions_world).all(axis=1))
    R, sigma = poses[known, :3, :3], anchors.position_sigma_m
    r = ((poses[known, :3, 3] - anchors.positions_world[known]) / sigma).ravel()
    J = np.zeros((len(known), 3, len(poses), 6))
    J[np.arange(len(known)), :, known, 3:] = R / sigma
    flat = J.reshape(len(r), 6 * len(poses))
    if not anchors.on_body:
        return r, flat
    arm_m = body_arm(anchors, poses)
    J[np.arange(len(known)), :, known, :3] = -R @ skew(arm_m) / sigma
    by_arm = R.reshape(-1, 3)
    return r + by_arm @ arm_m / sigma, flat - by_arm @ (by_arm.T @ flat) / len(known)


def body_arm(anchors: Anchors, poses: Array) -> Array:
    """Position (3,) in the camera's frame of the body that the anchors refer to; else 0."""
    if not anchors.on_body:
        return np.zeros(3)
    known = np.isfinite(anchors.positions_world).all(axis=1)
    T_camera_world = inverse(poses[known])
    return transform_each(T_camera_world, anchors.positions_world[known]).mean(axis=0)


def transform_each(T: Array, points: Array) -> Array:
    """One point (..., 3) by each transform (..., 4, 4)."""
    return (T[..., :3, :3] @ points[..., None])[..., 0] + T[..., :3, 3]


def anchor_rms(problem: CalibrationProblem, state: CalibrationState) -> float:
    """RMS difference in metres of all anchors, positions and distances; NaN without any."""
    r, _ = anchor_terms(problem, state)
    if problem.anchors is None or not len(r):
        return float("nan")
    distances = len(problem.anchors.distances_m)
    sigma = np.full(len(r), problem.anchors.position_sigma_m)
    sigma[len(r) - distances :] = problem.anchors.distance_sigma_m
    return float(np.sqrt(np.mean((r * sigma) ** 2)))
