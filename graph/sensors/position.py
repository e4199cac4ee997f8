"""Absolute positions of an antenna: satellites, ultra-wideband, a tracked marker.

The local frame (ENU, z up) is a pose of the graph, ``T_world_reference``, which is aligned to the
first positions and optimised with everything else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.factors.graph_update import POSITION, RelativePose
from bmask_slam.graph.geometry import adjoint, inverse, make_pose
from bmask_slam.graph.sensors.accelerometer import UP
from bmask_slam.graph.sensors.mounting import FREE_RAD, Lever
from bmask_slam.graph.sensors.odometry import Kernel, kernel_of


@dataclass(frozen=True)
class PositionConfig:
    """Noise and mounting of absolute positions.

    Attributes:
        enabled: whether measurements are used.
        antenna_in_camera: the lever arm, in metres in the camera's frame (x right, y down).
        sigma_m: of each coordinate, where a line does not say it.
        robust: kernel against jumps.
        max_apart_s: longest time from a position to its keyframe; the tracked frames between say
            how the camera moved.
        min_positions: so many are needed to align the frame ...
        min_spread_sigmas: ... and their spread across their main direction must be so many sigmas.
    """

    enabled: bool = True
    antenna_in_camera: Lever = (0.0, 0.0, 0.0)
    sigma_m: float = 1.0
    robust: Kernel = "cauchy"
    max_apart_s: float = 0.5
    min_positions: int = 4
    min_spread_sigmas: float = 4.0


def position_factor(
    ids: tuple[int, int],
    T_reference_camera: Array,
    lever_camera: Array,
    measured: Array,
    config: PositionConfig,
) -> RelativePose:
    """``T_reference_camera lever = measured``; ``measured`` (4,) is x y z and sigma in metres.

    The rotation is free: it is that of the estimate (4, 4). At the antenna the covariance is
    diagonal; ``Ad(T_camera_antenna)`` takes it to the camera.
    """
    T_camera_antenna = make_pose(np.eye(3), lever_camera)
    T_reference_antenna = make_pose(T_reference_camera[:3, :3], measured[:3])
    A, sigma_m = adjoint(T_camera_antenna), sigma_of(measured[3:], config)[0]
    covariance = A @ np.diag([FREE_RAD**2] * 3 + [sigma_m**2] * 3) @ A.T
    T = T_reference_antenna @ inverse(T_camera_antenna)
    robust = kernel_of(config.robust)
    return RelativePose(*ids, T, (covariance + covariance.T) / 2, robust, POSITION)


def sigma_of(given_m: Array, config: PositionConfig) -> Array:
    """The sigma (N,) of positions, by the configuration where it is NaN."""
    return np.where(np.isnan(given_m), config.sigma_m, given_m)


def align(
    antennas_world: Array, measured: Array, up_world: Array | None, config: PositionConfig
) -> Array | None:
    """T_world_reference (4, 4) of antennas (N, 3) and positions (N, 4); None if it is not sure.

    Kabsch's alignment, with the direction of up as one more pair where it is known: then a
    straight path is enough.
    """
    if len(measured) < config.min_positions:
        return None
    sigma_m = float(np.median(sigma_of(measured[:, 3], config)))
    p, q = measured[:, :3], antennas_world
    p_0, q_0 = p.mean(axis=0), q.mean(axis=0)
    spread_m = np.linalg.svd(q - q_0, compute_uv=False) / np.sqrt(len(q))
    needed = 0 if up_world is not None else 1
    if spread_m[needed] < config.min_spread_sigmas * sigma_m:
        return None
    cross = (q - q_0).T @ (p - p_0)
    if up_world is not None:
        cross += np.linalg.norm(cross) * 10.0 * np.outer(up_world, UP)
    U, _, Vt = np.linalg.svd(cross)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return make_pose(R, q_0 - R @ p_0)
