"""How an IMU is mounted on the camera, and its delay, by the motion that both measure.

A turn ``A`` of the camera and ``B`` of the IMU over the same time are ``A = X B X^T`` for the
mounting's rotation X (Park and Martin, T-RA 1994): ``log A = X log B``. The gyroscope's bias and
the delay change B and are estimated with X. The lever follows from the forces: an IMU off the
camera's centre moves otherwise when the camera turns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import make_pose, skew, so3_exp, so3_log
from bmask_slam.graph.sensors.imu import ImuConfig, integrals, turned

Cut = Callable[[float], Sequence[Array] | None]
"""Readings (N, 10) over each of K times, for a delay in s; None if one is not covered."""
_ITERATIONS = 8
_DELAY_SIGMA_S, _DELAY_STEP_S = 0.03, 0.002
"""How large a delay may be, and the step of its derivative."""
_TURN_SIGMA_RAD = 0.0002
"""A camera's turn from keyframe to keyframe is never believed better."""
_LEVER_SIGMA_M = 0.2
_PLACE_SIGMA_M, _SPEED_WEIGHT_S = 0.002, 0.1
"""Of the IMU's place by the camera's; an error of 1 m/s counts as one of so many metres."""
_MIN_PAIRS = 6


@dataclass(frozen=True, eq=False)
class ImuMounting:
    """How an IMU is mounted.

    Attributes:
        T_camera_imu: (4, 4); the lever is zero where it is not known.
        sigmas_rad: (3,) of the rotation, in the IMU's frame. lever_sigma_m: the largest.
        delay_s, delay_sigma_s: the IMU's stamps are so much later than the camera's.
    """

    T_camera_imu: Array
    sigmas_rad: Array
    lever_sigma_m: float
    delay_s: float
    delay_sigma_s: float


def find_mounting(T_world_camera: Array, cut: Cut, config: ImuConfig) -> ImuMounting | None:
    """The mounting by K + 1 poses (K + 1, 4, 4) and the readings of the K times between them.

    None where the readings do not cover the times. Its sigmas say what the motion shows: turns
    about one axis leave the rotation about that axis open.
    """
    R = T_world_camera[:, :3, :3]
    a = so3_log(R[:-1].mT @ R[1:])
    readings = cut(config.delay_s)
    if readings is None or len(a) < _MIN_PAIRS:
        return None
    X, bias, delay_s = _rotation(a, _turns(readings, np.zeros(3))), np.zeros(3), config.delay_s
    seconds = np.array([r[:, 0].sum() for r in readings])
    prior = np.array([0.0] * 3 + [config.sigma_gyroscope_bias] * 3 + [_DELAY_SIGMA_S])
    weights = np.where(prior > 0, 1 / np.maximum(prior, 1e-12) ** 2, 1e-6)
    for _ in range(_ITERATIONS):
        moved = [cut(delay_s + step) for step in (-_DELAY_STEP_S, 0.0, _DELAY_STEP_S)]
        if any(m is None for m in moved):
            return None
        early, now, late = (_turns(m, bias) for m in moved if m is not None)
        r = (a - now @ X.T)[..., None]
        drift = (late - early)[..., None] / (2 * _DELAY_STEP_S)
        J = np.concatenate([X @ skew(now), seconds[:, None, None] * X, -X @ drift], axis=2)
        off = np.concatenate([np.zeros(3), bias, [delay_s - config.delay_s]])
        H, g = _normal_equations(r, J)
        H += np.diag(weights)
        step = -np.linalg.solve(H, g + weights * off)
        X, bias = X @ so3_exp(step[:3]), bias + step[3:6]
        delay_s += float(np.clip(step[6], -_DELAY_STEP_S * 5, _DELAY_STEP_S * 5))
    sigmas = np.sqrt(np.diag(np.linalg.inv(H)))
    final = cut(delay_s)
    if final is None:
        return None
    lever, lever_sigma_m = find_lever(T_world_camera, final, X, (bias, config))
    T_camera_imu = make_pose(X, lever)
    return ImuMounting(T_camera_imu, sigmas[:3], lever_sigma_m, delay_s, float(sigmas[6]))


def _normal_equations(r: Array, J: Array) -> tuple[Array, Array]:
    """H (7, 7) and g (7,) of residuals (K, 3, 1), weighted by their own spread, with Huber's."""
    fitted = np.sqrt(r.size / (r.size - J.shape[2]))
    sigma = max(_TURN_SIGMA_RAD, 1.48 * fitted * float(np.median(np.abs(r))))
    robust = 1 / np.maximum(1.0, np.linalg.norm(r, axis=1) / (3 * sigma))[:, :, None]
    H = np.sum(robust * (J.mT @ J), axis=0) / sigma**2
    return H, np.sum(robust * (J.mT @ r), axis=0)[:, 0] / sigma**2


def _rotation(a: Array, b: Array) -> Array:
    """The rotation X (3, 3) with ``a = X b`` for turns (K, 3), by least squares."""
    U, _, Vt = np.linalg.svd(a.T @ b)
    return np.asarray((U * [1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def _turns(readings: Sequence[Array], bias: Array) -> Array:
    """Rotation vectors (K, 3) of the IMU over readings."""
    return so3_log(np.array([turned(r, bias)[-1] for r in readings]))


def find_lever(
    T_world_camera: Array, readings: Sequence[Array], X: Array, known: tuple[Array, ImuConfig]
) -> tuple[Array, float]:
    """The IMU's place (3,) in the camera's frame, and its largest sigma.

    As `graph.sensors.imu.begin`, with the lever l and the accelerometer's bias b as further
    unknowns: ``p = p_camera + R_camera l``, and b is taken from the force.
    """
    bias, config = known
    R_c, p, K = T_world_camera[:, :3, :3], T_world_camera[:, :3, 3], len(readings)
    R, eye = R_c @ X, np.eye(3)
    A, y = np.zeros((K, 2, 3, 9 + 3 * (K + 1))), np.zeros((K, 2, 3))
    for k, rows in enumerate(readings):
        t = float(rows[:, 0].sum())
        dv, dp = integrals(rows, bias)
        middle = R[k] @ so3_exp(so3_log(R[k].T @ R[k + 1]) / 2)
        at = 9 + 3 * k
        A[k, 0, :, :3], A[k, 0, :, 3:6] = t * t / 2 * eye, -(R_c[k + 1] - R_c[k])
        A[k, 0, :, 6:9], A[k, 0, :, at : at + 3] = -t * t / 2 * middle, t * eye
        A[k, 1, :, :3], A[k, 1, :, 6:9] = t * eye, -t * middle
        A[k, 1, :, at : at + 3], A[k, 1, :, at + 3 : at + 6] = eye, -eye
        y[k] = p[k + 1] - p[k] - R[k] @ dp, -R[k] @ dv
    scale = np.array([1.0, _SPEED_WEIGHT_S])[:, None] / _PLACE_SIGMA_M
    J, r = (A * scale[..., None]).reshape(6 * K, -1), (y * scale).ravel()
    H, g = J.T @ J, J.T @ r
    H[3:6, 3:6] += eye / _LEVER_SIGMA_M**2
    H[6:9, 6:9] += eye / config.sigma_accelerometer_bias**2
    H += 1e-9 * np.eye(len(H))
    x, covariance = np.linalg.solve(H, g), np.linalg.inv(H)
    spread = max(1.0, float(np.mean((J @ x - r) ** 2)))
    return x[3:6].astype(float), float(
        np.sqrt(spread * np.linalg.eigvalsh(covariance[3:6, 3:6])[-1])
    )
