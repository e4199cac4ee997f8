"""Elimination of landmarks: what their observations say about the poses alone.

The observations are linearised at the current values with the weights of Huber's kernel there.
With ``xi`` the poses' tangents on the right side and ``dp`` the points' shifts in the world, the
cost is ``|r + J_pose xi + J_point dp|^2 / 2``, and eliminating each point's ``dp`` leaves the
Schur complement, dense over the poses that saw a common landmark.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.factor_tables import ValueTable
from bmask_slam.graph.factors.graph_update import Observations
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.geometry import inverse, skew

POINT_FLOOR_PER_M2 = 1e-6
"""Information added to each point, that of a sigma of 1 km, so that it is invertible."""


@dataclass(frozen=True)
class PoseInformation:
    """A Gaussian over the tangents of some poses: cost ``xi^T H xi / 2 + g^T xi``.

    Attributes:
        keyframe_ids: (K,) sorted.
        poses_world_camera: (K, 4, 4) where it is linearised.
        H: (K, 6, K, 6) information of ``[rotation rad, translation m]``; moving all poses
            together costs nothing, so its rank is at most 6 (K - 1).
        g: (K, 6) gradient there.
    """

    keyframe_ids: Ints
    poses_world_camera: Array
    H: Array
    g: Array


@dataclass(frozen=True)
class PointInformation:
    """What the observations say of each landmark given the poses.

    Attributes:
        landmark_ids: (L,) sorted.
        covariances: (L, 3, 3) in the world frame, m^2.
        points_world: (L, 3) the optimum of one Gauss-Newton step.
    """

    landmark_ids: Ints
    covariances: Array
    points_world: Array


def linearise(
    observations: Observations,
    poses_world_camera: Array,
    points_world: Array,
    camera: Camera,
    config: SmootherConfig,
) -> tuple[Array, Array, Array]:
    """Residuals (M, 3) of u, v, disparity and their Jacobians, whitened and robustly weighted.

    Poses (M, 4, 4) and points (M, 3) are those of each observation. Returns r,
    J_pose (M, 3, 6) and J_point (M, 3, 3); a monocular row's third line is zero.
    """
    T_camera_world = inverse(poses_world_camera)
    p = (T_camera_world[:, :3, :3] @ points_world[:, :, None])[:, :, 0] + T_camera_world[:, :3, 3]
    z = observations.measurements
    stereo = np.isfinite(z[:, 2])
    predicted = camera.project_stereo(p)
    r = predicted - z
    r[:, 2] = (predicted[:, 0] - predicted[:, 2]) - (z[:, 0] - z[:, 2])
    precision = np.where([True, True, False] | stereo[:, None], 1 / observations.sigmas_px, 0.0)
    r = np.where(precision > 0, r, 0.0) * precision
    root_weights = np.sqrt(_huber_weights(r, stereo, config))[:, None]
    r *= root_weights
    J = projection_jacobian(p, camera) * (precision * root_weights)[:, :, None]
    J_pose = np.concatenate([J @ skew(p), -J], axis=2)  # d p / d xi = [skew(p), -1]
    return r, J_pose, J @ T_camera_world[:, :3, :3]


def projection_jacobian(points_camera: Array, camera: Camera) -> Array:
    """Derivatives (M, 3, 3) of u, v and disparity (px) by points (M, 3) in the camera (m)."""
    x, y, z = points_camera.T
    J = np.zeros((len(z), 3, 3))
    J[:, 0, 0], J[:, 1, 1] = camera.fx / z, camera.fy / z
    J[:, 0, 2], J[:, 1, 2] = -camera.fx * x / z**2, -camera.fy * y / z**2
    J[:, 2, 2] = -camera.stereo_bf_px_m / z**2
    return J


def _huber_weights(r: Array, stereo: Array, config: SmootherConfig) -> Array:
    """Weights (M,) of Huber's kernel at whitened residuals (M, 3); 1 without a kernel."""
    if not config.robust:
        return np.ones(len(r))
    k = np.where(stereo, config.huber_stereo, config.huber_mono)
    return k / np.maximum(np.linalg.norm(r, axis=1), k)


def eliminate_points(
    observations: Observations,
    keyframes: ValueTable,
    landmarks: ValueTable,
    camera: Camera,
    config: SmootherConfig,
) -> tuple[PoseInformation, PointInformation]:
    """The observations' information on the poses, and what is left on each landmark given them.

    p(poses, points) = p(poses) p(points | poses). ``keyframes`` and ``landmarks`` contain all
    that are observed.
    """
    poses, points = keyframes.values, landmarks.values
    row = np.searchsorted(keyframes.ids, observations.keyframe_ids)
    column = np.searchsorted(landmarks.ids, observations.landmark_ids)
    r, J_pose, J_point = linearise(observations, poses[row], points[column], camera, config)
    count, points_count = len(poses), len(points)
    J_pose_T, J_point_T = np.swapaxes(J_pose, 1, 2), np.swapaxes(J_point, 1, 2)
    H_point = np.zeros((points_count, 3, 3))
    np.add.at(H_point, column, J_point_T @ J_point)
    g_point = np.zeros((points_count, 3))
    np.add.at(g_point, column, (J_point_T @ r[:, :, None])[:, :, 0])
    covariances = np.asarray(np.linalg.inv(H_point + POINT_FLOOR_PER_M2 * np.eye(3)), float)
    diagonal = np.zeros((count, 6, 6))
    np.add.at(diagonal, row, J_pose_T @ J_pose)
    g = np.zeros((count, 6))
    np.add.at(g, row, (J_pose_T @ r[:, :, None])[:, :, 0])
    root = np.linalg.cholesky(covariances)
    cross = np.zeros((count, 6, points_count, 3))
    cross[row, :, column] = J_pose_T @ J_point @ root[column]  # each pair is one observation
    flat = cross.reshape(6 * count, 3 * points_count)
    H = np.zeros((count, 6, count, 6))
    H[np.arange(count), :, np.arange(count)] = diagonal
    H -= (flat @ flat.T).reshape(H.shape)
    g -= (flat @ np.einsum("lji,lj->li", root, g_point).ravel()).reshape(g.shape)
    moved = points - (covariances @ g_point[:, :, None])[:, :, 0]
    return PoseInformation(keyframes.ids, poses, H, g), PointInformation(
        landmarks.ids, covariances, moved
    )
