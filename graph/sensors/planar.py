"""Planar motion: the base that the camera is on keeps its height above a plane, and its tilt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.factors.graph_update import PLANAR, RelativePose
from bmask_slam.graph.geometry import adjoint, inverse, make_pose
from bmask_slam.graph.sensors.accelerometer import UP, rotation_between
from bmask_slam.graph.sensors.mounting import FREE_M, FREE_RAD, Mounting, T_of
from bmask_slam.graph.sensors.odometry import Kernel, kernel_of


@dataclass(frozen=True)
class PlanarConfig:
    """How flat the ground is on which a base moves.

    Attributes:
        enabled: whether the motion is planar.
        camera_in_base: the camera in a frame whose z is the plane's normal; its turn about z and
            its place do not matter where the height is the same.
        sigma_height_m, sigma_tilt_rad: of the base at a keyframe, with springs and the mounting.
        robust: kernel against bumps.
    """

    enabled: bool = False
    camera_in_base: Mounting = (0.0, 0.0, 0.0, 0.5, -0.5, 0.5, -0.5)
    sigma_height_m: float = 0.01
    sigma_tilt_rad: float = 0.02
    robust: Kernel = "huber"


def planar_factor(
    ids: tuple[int, int], T_plane_camera: Array, config: PlanarConfig
) -> RelativePose:
    """Height, roll and pitch of the base are zero in the plane's frame.

    ``T_plane_camera`` (4, 4) is the estimate, which gives what is free: place and heading. The
    covariance is diagonal at the base; ``Ad(T_camera_base)`` takes it to the camera.
    """
    T_base_camera = T_of(config.camera_in_base)
    T_plane_base = T_plane_camera @ inverse(T_base_camera)
    R = rotation_between(T_plane_base[:3, 2], UP) @ T_plane_base[:3, :3]
    T = make_pose(R, T_plane_base[:3, 3] * [1.0, 1.0, 0.0]) @ T_base_camera
    tilt, height = config.sigma_tilt_rad, config.sigma_height_m
    sigmas = np.array([tilt, tilt, FREE_RAD, FREE_M, FREE_M, height])
    A = adjoint(inverse(T_base_camera))
    covariance = A @ np.diag(sigmas**2) @ A.T
    robust = kernel_of(config.robust)
    return RelativePose(*ids, T, (covariance + covariance.T) / 2, robust, PLANAR)
