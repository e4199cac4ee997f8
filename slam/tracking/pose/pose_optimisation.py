"""Motion-only bundle adjustment: one camera pose from matched landmarks, vectorised."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dposv

from bmask_slam.graph.arrays import Array, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, orthonormalised, transform
from bmask_slam.tracking.pose.reprojection import Reprojection, moved

CHI2_3DOF = 7.815  # 95 %
CHI2_2DOF = 5.991
_DAMPING = 1e-9 * np.eye(6)


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
    step_tolerance: float = 3e-5  # rad and m: a fiftieth of a pixel
    max_noise_scale: float = 4.0
    min_points: int = 6

    def __post_init__(self) -> None:
        if min(self.kernel_iterations, self.final_iterations) < 1:
            raise ValueError("kernel_iterations and final_iterations must be at least 1")
        if not self.kernel_widths and not self.final_rounds:
            raise ValueError("there must be kernel_widths or final_rounds")
        if self.max_noise_scale < 1:
            raise ValueError("max_noise_scale must be at least 1")


@dataclass(frozen=True)
class PoseEstimate:
    """A pose from N matches.

    Attributes:
        T_world_camera: (4, 4).
        inliers: (N,) bool: within the chi-square gate, taken without the robust kernel.
        noise_scale: factor on the pixel sigmas by the median of the residuals, at least 1.
        information: (6, 6) in the camera's own tangent [rotation rad, translation m].
        ok: False where too few points were left or a direction of motion is not observed; the
            other values are then those of the initial pose and must not be used.
    """

    T_world_camera: Array
    inliers: Mask
    information: Array
    noise_scale: float
    ok: bool

    @property
    def position_sigma_m(self) -> float:
        """Standard deviation of the position, over all directions, by the information."""
        return float(np.sqrt(np.trace(np.linalg.inv(self.information)[3:, 3:])))


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
        T_world_camera: (4, 4) initial pose; points_world: (N, 3) landmarks.
        measurements: (N, 3) u, v, disparity in undistorted pixels; disparity NaN: monocular.
        sigmas_px: (N, 3) their standard deviations.

    Inliers pass the chi-square gate (95 %, 3 or 2 degrees of freedom) without the kernel, with
    sigmas scaled to the residuals of the frame: blurred images have more noise.
    """
    config, known = config or PoseOptimisationConfig(), np.isfinite(measurements)
    measured, weight = np.where(known, measurements, 0.0), np.where(known, 1 / sigmas_px**2, 0.0)
    gate = np.where(known[:, 2], CHI2_3DOF, CHI2_2DOF)
    T, nothing = T_world_camera, np.zeros(len(known), bool)
    failed = PoseEstimate(T_world_camera, nothing, np.zeros((6, 6)), 1.0, False)
    if len(known) < config.min_points:
        return failed
    matches = Reprojection.of(points_world, measured, weight, camera)
    for width in config.kernel_widths:
        T, H = _descend(T, matches, width * gate, config.kernel_iterations, config.step_tolerance)
    squares, z = matches.squares(T)
    scale = min(_noise_scale(squares[:2] * matches.weight[:2], z, gate), config.max_noise_scale)
    matches = matches.weighted(np.array([scale**-2, scale**-2, 1.0]))
    for _ in range(config.final_rounds):
        inliers = _inliers(squares, z, matches, gate)
        if inliers.sum() < config.min_points:
            return failed
        T, H = _descend(T, matches[inliers], None, config.final_iterations, config.step_tolerance)
        squares, z = matches.squares(T)
    inliers = _inliers(squares, z, matches, gate)
    ok = inliers.sum() >= config.min_points and _well_conditioned(H)
    return PoseEstimate(orthonormalised(T), inliers, H, scale, True) if ok else failed


def _descend(
    T: Array, matches: Reprojection, kernel: Array | None, iterations: int, tolerance: float
) -> tuple[Array, Array]:
    """Gauss-Newton steps from a pose; returns pose and H (6, 6).

    A direction that is not observed is not changed; H shows it.
    """
    for _ in range(iterations):
        H, g = matches.normal_equations(T, kernel)
        step = _solution(H + _DAMPING, -g)
        T = moved(T, step)
        if np.abs(step).max() < tolerance:
            break
    return T, H


def _solution(H: Array, b: Array) -> Array:
    """x (6,) of H x = b for a symmetric H (6, 6), by Cholesky if it is positive definite."""
    _, x, failure = dposv(H, b)  # a third of numpy's time, most of which is overhead
    return np.asarray(x if failure == 0 else np.linalg.solve(H, b), dtype=np.float64)


def _inliers(squares: Array, z: Array, matches: Reprojection, gate: Array) -> Mask:
    """Points (N,) in front of the camera and within the chi-square gate, without any kernel."""
    u, v, disparity = squares * matches.weight
    return np.asarray((u + v + disparity < gate) & (z > 0.05))


def _noise_scale(chi2: Array, z: Array, gate: Array) -> float:
    """Ratio of the pixel residuals to their sigmas, by their weighted squares (2, N); at least 1.

    The median of chi-square with 2 degrees of freedom is 1.386; gross outliers do not count.
    """
    pixel = chi2[0] + chi2[1]
    plausible = (pixel < 16 * gate) & (z > 0.05)
    if not plausible.any():
        return 1.0
    return max(1.0, math.sqrt(median(pixel[plausible]) / 1.386))


def median(values: Array) -> float:
    """The median of values (N,), N > 0, without NaN; numpy's own takes twice as long."""
    low, high = (len(values) - 1) // 2, len(values) // 2
    ordered = np.partition(values, (low, high))
    return float((ordered[low] + ordered[high]) / 2)


def _well_conditioned(H: Array) -> bool:
    """Whether all six directions are observed, by the condition of H with unit diagonal."""
    scale = np.sqrt(np.diagonal(H))
    if not (np.isfinite(scale).all() and (scale > 0).all()):
        return False
    return bool(np.linalg.eigvalsh(H / np.outer(scale, scale))[0] > 1e-10)
