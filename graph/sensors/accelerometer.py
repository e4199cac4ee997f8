"""An accelerometer as a plumb line: which way is up, from its mean around each keyframe.

At rest specific force points up; a moving camera adds its acceleration, which averages out.
How the sensor is mounted is known to some degrees only, and a camera that turns shows it: the
direction of up and the mounting are estimated together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.factors.graph_update import GRAVITY, RelativePose
from bmask_slam.graph.geometry import make_pose, skew, so3_exp
from bmask_slam.graph.sensors.mounting import FREE_M, FREE_RAD, Mounting, T_of

UP = np.array([0.0, 0.0, 1.0])
"""Up in a reference frame."""
_ITERATIONS = 20
_HUBER = 2.0


@dataclass(frozen=True)
class AccelerometerConfig:
    """Noise and mounting of an accelerometer that says which way is up.

    Attributes:
        enabled: whether measurements are used; not by default: up is as wrong as the mounting.
        accelerometer_in_camera: only its rotation is used; that of TUM's Kinects, whose x points
            left and y up.
        sigma_mounting_rad: how well that is known, about each axis.
        average_s: the mean is taken over so long around a keyframe, turned with the camera: over a
            longer time its accelerations cancel.
        sigma_rad: of the direction of such a mean, of a hand-held camera, with its bias.
        min_keyframes: so many are needed before up is estimated.
    """

    enabled: bool = False
    accelerometer_in_camera: Mounting = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    sigma_mounting_rad: float = 0.05
    average_s: float = 1.0
    sigma_rad: float = 0.03
    min_keyframes: int = 3


@dataclass(frozen=True)
class Plumb:
    """Up as measured around a keyframe: about ``mean + turn @ d`` for a mounting turned by d.

    Attributes:
        mean: (3,) unit vector in the keyframe's camera.
        turn: (3, 3) its derivative by the mounting's rotation.
        sigma_rad: larger where the force differs from gravity's.
    """

    mean: Array
    turn: Array
    sigma_rad: float


@dataclass(frozen=True)
class Upright:
    """Which way is up, and how the accelerometer is mounted.

    Attributes:
        up_world: (3,) unit vector.
        mounting_rad: (3,) rotation of the mounting from the nominal one, in the camera.
        covariance: (3, 3) of ``up_world``, without its own direction.
    """

    up_world: Array
    mounting_rad: Array
    covariance: Array


def plumb(
    R_keyframe_camera: Array, forces: Array, gravity_m_s2: float, config: AccelerometerConfig
) -> Plumb | None:
    """The mean of forces (N, 3) turned into the keyframe's camera by (N, 3, 3); None if it is 0.

    ``sigma^2 = sigma_rad^2 + (|mean| / g - 1)^2``: an acceleration turns the direction by about as
    much as it changes the length.
    """
    f = forces @ T_of(config.accelerometer_in_camera)[:3, :3].T
    mean = np.mean(R_keyframe_camera @ f[:, :, None], axis=0)[:, 0]
    length = float(np.linalg.norm(mean))
    if not length > gravity_m_s2 / 10:
        return None
    turn = -np.mean(R_keyframe_camera @ skew(f), axis=0) / length
    sigma_rad = float(np.hypot(config.sigma_rad, length / gravity_m_s2 - 1))
    return Plumb(mean / length, turn, sigma_rad)


def estimate_up(
    R_world_camera: Array, measured: Sequence[Plumb], config: AccelerometerConfig
) -> Upright | None:
    """Up in the world and the mounting, from keyframes (N, 3, 3); None from too few.

    Gauss-Newton on ``R_world_camera (mean + turn d) - up_world`` with a prior on d, and Huber's
    weights.
    """
    if len(measured) < max(config.min_keyframes, 1):
        return None
    mean = _turned(R_world_camera, np.array([m.mean for m in measured]))
    turn = R_world_camera @ np.array([m.turn for m in measured])
    precision = np.array([m.sigma_rad for m in measured]) ** -2.0
    up, d = _unit(precision @ mean), np.zeros(3)
    prior = np.eye(3) / config.sigma_mounting_rad**2
    covariance = np.zeros((5, 5))
    for _ in range(_ITERATIONS):
        residual = mean + turn @ d - up
        large = np.linalg.norm(residual, axis=1) * np.sqrt(precision)
        weights = precision * np.minimum(1.0, _HUBER / np.maximum(large, 1e-12))
        basis = _tangents(up)
        J = np.concatenate([turn, np.broadcast_to(-basis, (len(turn), 3, 2))], axis=2)
        H = np.einsum("n,nij,nik->jk", weights, J, J)
        g = np.einsum("n,nij,ni->j", weights, J, residual)
        H[:3, :3] += prior
        g[:3] += prior @ d
        covariance = np.linalg.inv(H)
        step = -covariance @ g
        d = d + step[:3]
        up = _unit(up + basis @ step[3:])
    basis = _tangents(up)
    return Upright(up, d, basis @ covariance[3:, 3:] @ basis.T)


def gravity_factor(
    ids: tuple[int, int], T_reference_camera: Array, measured: Plumb, upright: Upright
) -> RelativePose:
    """Roll and pitch of a keyframe in the reference frame, whose z is up.

    ``T_reference_camera`` (4, 4) is the estimate, which gives what is not measured: the covariance
    is ``sigma^2 (I - u u^T)`` of the rotation, u being up in the camera, and free along it.
    """
    up_camera = _unit(measured.mean + measured.turn @ upright.mounting_rad)
    expected = T_reference_camera[:3, :3].T @ UP
    R = T_reference_camera[:3, :3] @ rotation_between(up_camera, expected)
    along = np.outer(up_camera, up_camera)
    covariance = np.diag([0.0] * 3 + [FREE_M**2] * 3)
    covariance[:3, :3] = measured.sigma_rad**2 * (np.eye(3) - along) + FREE_RAD**2 * along
    T = make_pose(R, T_reference_camera[:3, 3])
    return RelativePose(*ids, T, covariance, "huber", GRAVITY)


def rotation_between(a: Array, b: Array) -> Array:
    """The smallest rotation (3, 3) that turns unit vector a into b."""
    axis, cosine = np.cross(a, b), float(np.clip(a @ b, -1.0, 1.0))
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        side = np.cross(a, np.eye(3)[np.argmin(np.abs(a))])
        return so3_exp(np.pi * _unit(side)) if cosine < 0 else np.eye(3)
    return so3_exp(np.arctan2(sine, cosine) / sine * axis)


def _turned(R: Array, vectors: Array) -> Array:
    return np.asarray((R @ vectors[:, :, None])[:, :, 0])


def _tangents(up: Array) -> Array:
    """Two unit vectors (3, 2) across a third."""
    first = _unit(np.cross(up, np.eye(3)[np.argmin(np.abs(up))]))
    return np.stack([first, np.cross(up, first)], axis=1)


def _unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v))
