"""The relative pose of two keyframes, refined on keypoints that show the same points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.features.brisk import Features
from bmask_slam.graph.arrays import Array, Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import adjoint, inverse, orthonormalised, se3_exp
from bmask_slam.tracking.pose.pose_optimisation import CHI2_2DOF, CHI2_3DOF, jacobian, residuals

MAX_NOISE_SCALE = 3.0
MEDIAN_TO_GATE = 2.366 / CHI2_3DOF  # of chi-square


@dataclass(frozen=True)
class LoopView:
    """A keyframe as loop verification sees it.

    ``features`` are its N keypoints, ``landmark_ids`` (N,) their landmarks in the map, -1 for none,
    ``points_camera`` (N, 3) these in its camera's frame, NaN also where the keypoint has no depth.
    """

    keyframe_id: int
    features: Features
    points_camera: Array
    landmark_ids: Ints


Views = tuple[LoopView, LoopView]
Pairs = tuple[Ints, Ints]  # keypoint a[k] goes with b[k]


@dataclass(frozen=True)
class RefinedPose:
    """T_a_b (4, 4) from M pairs of keypoints.

    Attributes:
        covariance: (6, 6) of the tangent at b, scaled by the noise.
        inliers: (M,) bool, which pairs agree.
        noise_scale: ratio of residuals to their sigmas, at least 1.
    """

    T_a_b: Array
    covariance: Array
    inliers: Mask
    noise_scale: float


def refine_relative_pose(views: Views, pairs: Pairs, T_a_b: Array, camera: Camera) -> RefinedPose:
    """The pose near T_a_b (4, 4) that fits pairs of keypoints best.

    Gauss-Newton with Cauchy's kernel on all pairs, then on inliers alone. A pair with points on
    both sides is used in both directions with half the weight.
    """
    scale, active = 1.0, np.ones(len(pairs[0]), bool)
    for kernel in (16.0, 4.0, 1.0, None, None, None, None):
        r, J, W, gate = _linearised(views, pairs, T_a_b, camera)
        chi2 = np.einsum("wni,wnij,wnj->n", r, W, r)
        if kernel is None or kernel == 1.0:
            factor = np.sqrt(np.median(chi2 / gate) / MEDIAN_TO_GATE)
            scale = float(np.clip(factor, 1.0, MAX_NOISE_SCALE))
        active = chi2 < gate * scale**2
        w = active if kernel is None else 1 / (1 + chi2 / (kernel * gate))
        H = np.einsum("n,wnia,wnij,wnjb->ab", w, J, W, J)
        g = np.einsum("n,wnia,wnij,wnj->a", w, J, W, r)
        T_a_b = orthonormalised(T_a_b @ se3_exp(-np.linalg.solve(H + 1e-9 * np.eye(6), g)))
    covariance = np.linalg.inv(H + 1e-9 * np.eye(6)) * scale**2
    return RefinedPose(T_a_b, covariance, active, scale)


def _linearised(views: Views, pairs: Pairs, T_a_b: Array, camera: Camera) -> tuple[Array, ...]:
    """Residuals (2, M, 3), Jacobians (2, M, 3, 6), weights (2, M, 3, 3) and gates (M,) both ways.

    Direction 0 projects points of a into b, direction 1 points of b into a. For ``T_a_b <- T_a_b @
    se3_exp(xi)`` the inverse becomes ``T_b_a @ se3_exp(-Ad(T_a_b) @ xi)``. Without a point the
    weight is zero.
    """
    r_b, J_b, W_b = _way(views, pairs, T_a_b, camera)
    r_a, J_a, W_a = _way(views[::-1], pairs[::-1], inverse(T_a_b), camera)
    W = np.stack([W_b, W_a])
    has_point, has_depth = W[:, :, 0, 0] > 0, W[:, :, 2, 2] > 1e-9
    W /= has_point.sum(axis=0)[:, None, None]
    gate = np.where(has_depth.any(axis=0), CHI2_3DOF, CHI2_2DOF)
    return np.stack([r_b, r_a]), np.stack([J_b, -J_a @ adjoint(T_a_b)]), W, gate


def _way(views: Views, pairs: Pairs, T_source_target: Array, camera: Camera) -> tuple[Array, ...]:
    """Residuals, Jacobians and weights of the source's points in the target's image.

    The covariance of a point is that of its measurement in its own keyframe alone.
    """
    source, target = views
    own, measured = source.points_camera[pairs[0]], target.features.measurements[pairs[1]]
    known, stereo = np.isfinite(own[:, 2]), np.isfinite(measured[:, 2])
    own, measured = np.where(known[:, None], own, [0, 0, 1]), np.nan_to_num(measured)
    r, points = residuals(T_source_target, own, measured, camera)
    J = jacobian(points, camera)
    to_pixels = -J[:, :, 3:] @ T_source_target[:3, :3].T  # d(u, v, disparity) / d(own)
    spread = to_pixels @ np.linalg.inv(-jacobian(own, camera)[:, :, 3:])
    own_sigmas = np.where(known[:, None], source.features.sigmas_px[pairs[0]], 1.0)
    sigmas = target.features.sigmas_px[pairs[1]].copy()
    sigmas[~stereo, 2] = 1e6  # without depth, no weight
    S = (spread * own_sigmas[:, None] ** 2) @ np.swapaxes(spread, 1, 2)
    W = np.linalg.inv(S + sigmas[:, None] ** 2 * np.eye(3))
    return r, J, W * known[:, None, None]
