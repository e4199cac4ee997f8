"""Motion-only bundle adjustment: one camera pose from matched landmarks, vectorised."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graph.camera import Camera
from graph.geometry import Array, inverse, orthonormalised, se3_exp, transform

CHI2_3DOF = 7.815  # 95 %
CHI2_2DOF = 5.991


@dataclass(frozen=True)
class PoseOptimisationConfig:
    """Kernel widths in units of the chi-square gate, widest first, then the final rounds.

    Cauchy weights on ALL points with a narrowing kernel (graduated non-convexity) find the
    consensus from a prediction many sigmas away; the final rounds use the inliers alone.
    """

    kernel_widths: tuple[float, ...] = (64.0, 16.0, 4.0, 1.0)
    kernel_iterations: int = 3
    final_rounds: int = 2
    final_iterations: int = 5
    step_tolerance: float = 3e-5
    min_points: int = 6


@dataclass(frozen=True)
class PoseEstimate:
    """A pose from N matches.

    Attributes:
        T_world_camera: (4, 4).
        inliers: (N,) bool: within the chi-square gate, taken without the robust kernel.
        information: (6, 6) in the camera's own tangent [rotation rad, translation m].
        ok: False where too few points were left or the system was singular; the pose is
            then that of the last good step and must not be used.
    """

    T_world_camera: Array
    inliers: NDArray[np.bool_]
    information: Array
    ok: bool


def residuals(
    T_world_camera: Array, points_world: Array, measurements: Array, camera: Camera
) -> tuple[Array, Array]:
    """Residuals (N, 3) px of u, v, disparity (predicted - measured), and points_camera (N, 3)."""
    points_camera = transform(inverse(T_world_camera), points_world)
    z = points_camera[:, 2]
    safe_z = np.where(z > 1e-3, z, 1e-3)
    predicted = np.stack(
        [
            camera.fx * points_camera[:, 0] / safe_z + camera.cx,
            camera.fy * points_camera[:, 1] / safe_z + camera.cy,
            camera.stereo_bf_px_m / safe_z,
        ],
        axis=1,
    )
    return predicted - measurements, points_camera


def jacobian(points_camera: Array, camera: Camera) -> Array:
    """d(u, v, disparity)/d(xi) (N, 3, 6) for ``T_world_camera <- T_world_camera @ se3_exp(xi)``.

    Chain rule, multiplied out: d(pixel)/d(point_camera) @ d(point_camera)/d(xi), and the latter
    is [skew(p), -I] since p <- exp(-xi) p.
    """
    x, y, z = points_camera.T
    inv_z = 1.0 / np.where(z > 1e-3, z, 1e-3)
    xn, yn, bf = x * inv_z, y * inv_z, camera.stereo_bf_px_m
    J = np.zeros((len(x), 3, 6))
    J[:, 0, 0], J[:, 0, 1], J[:, 0, 2] = (
        camera.fx * xn * yn,
        -camera.fx * (1 + xn**2),
        camera.fx * yn,
    )
    J[:, 0, 3], J[:, 0, 5] = -camera.fx * inv_z, camera.fx * xn * inv_z
    J[:, 1, 0], J[:, 1, 1], J[:, 1, 2] = (
        camera.fy * (1 + yn**2),
        -camera.fy * xn * yn,
        -camera.fy * xn,
    )
    J[:, 1, 4], J[:, 1, 5] = -camera.fy * inv_z, camera.fy * yn * inv_z
    J[:, 2, 0], J[:, 2, 1], J[:, 2, 5] = bf * yn * inv_z, -bf * xn * inv_z, bf * inv_z**2
    return J


def optimise_pose(
    T_world_camera: Array,
    points_world: Array,
    measurements: Array,
    sigmas_px: Array,
    camera: Camera,
    config: PoseOptimisationConfig | None = None,
) -> PoseEstimate:
    """The pose that minimises the robustly weighted reprojection and disparity errors.

    Args:
        T_world_camera: (4, 4) initial pose.
        points_world: (N, 3) landmarks.
        measurements: (N, 3) u, v, disparity in undistorted pixels; disparity NaN: monocular.
        sigmas_px: (N, 3) their standard deviations.

    Inliers are chosen by the chi-square gate of 95 % for 3 or 2 degrees of freedom, taken without
    the robust kernel.
    """
    config = config or PoseOptimisationConfig()
    stereo = np.isfinite(measurements[:, 2])
    measured = np.where(np.isfinite(measurements), measurements, 0.0)
    weight = np.where(np.isfinite(measurements), 1.0 / sigmas_px**2, 0.0)
    gate = np.where(stereo, CHI2_3DOF, CHI2_2DOF)
    T, inliers, H = T_world_camera, np.ones(len(stereo), bool), np.zeros((6, 6))
    stages: list[tuple[float | None, int]] = []
    stages += [(width, config.kernel_iterations) for width in config.kernel_widths]
    stages += [(None, config.final_iterations)] * config.final_rounds
    for width, iterations in stages:
        if width is None:
            inliers = _inliers(T, points_world, measured, weight, gate, camera)
        if inliers.sum() < config.min_points:
            return PoseEstimate(orthonormalised(T), inliers, H, False)
        chosen = (points_world[inliers], measured[inliers], weight[inliers])
        kernel = None if width is None else width * gate
        for _ in range(iterations):
            H, g = _normal_equations(T, *chosen, kernel, camera)
            if not (np.isfinite(H).all() and np.isfinite(g).all()):
                return PoseEstimate(orthonormalised(T), inliers, H, False)
            H[np.diag_indices(6)] += (
                1e-9  # a singular system makes no step, and fails the check below
            )
            step = np.asarray(-np.linalg.solve(H, g), dtype=np.float64)
            T = T @ se3_exp(step)
            if np.abs(step).max() < config.step_tolerance:
                break
    inliers = _inliers(T, points_world, measured, weight, gate, camera)
    ok = int(inliers.sum()) >= config.min_points and _well_conditioned(H)
    return PoseEstimate(orthonormalised(T), inliers, H, ok)


def _inliers(
    T: Array, points_world: Array, measured: Array, weight: Array, gate: Array, camera: Camera
) -> NDArray[np.bool_]:
    """Points (N,) in front of the camera and within the chi-square gate, without any kernel."""
    r, p = residuals(T, points_world, measured, camera)
    return (np.einsum("ij,ij,ij->i", r, r, weight) < gate) & (p[:, 2] > 0.05)


def _well_conditioned(H: Array) -> bool:
    """Whether the six directions are all observed, judged by H scaled to a unit diagonal."""
    scale = np.sqrt(np.diagonal(H))
    if not (np.isfinite(scale).all() and (scale > 0).all()):
        return False
    return bool(np.linalg.eigvalsh(H / np.outer(scale, scale))[0] > 1e-10)


def _normal_equations(
    T: Array,
    points_world: Array,
    measured: Array,
    weight: Array,
    kernel: Array | None,
    camera: Camera,
) -> tuple[Array, Array]:
    """H (6, 6) and gradient (6,) of the weighted squares; with a kernel, Cauchy's weights."""
    r, points_camera = residuals(T, points_world, measured, camera)
    w = weight
    if kernel is not None:
        chi2 = np.einsum("ij,ij,ij->i", r, r, weight)
        w = weight * (kernel / (kernel + chi2))[:, None]
    J = jacobian(points_camera, camera).reshape(-1, 6)
    weighted = J * w.reshape(-1, 1)
    return weighted.T @ J, weighted.T @ r.reshape(-1)
