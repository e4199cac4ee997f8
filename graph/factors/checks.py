"""Checks of new variables and factors, each on its own, in numpy.

GTSAM does not detect these: a factor whose landmark lies behind the camera has a zero Jacobian and
no error, and one NaN spoils every value.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import gammaincinv

from bmask_slam.graph.arrays import Array, Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.factor_tables import FactorTables, ValueTable
from bmask_slam.graph.factors.graph_estimate import (
    ObservationErrors,
    RefusalReason,
    RefusedFactor,
    RelativePoseErrors,
)
from bmask_slam.graph.factors.graph_update import (
    KERNELS,
    GraphUpdate,
    Observations,
    PosePrior,
    RelativePose,
)
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.geometry import inverse, se3_log

OBSERVATION_PROBABILITY = 0.95


def chi2_quantile(probability: float, degrees: int | Ints) -> Any:
    """Quantile of the chi-square distribution with these degrees of freedom, elementwise.

    As ``scipy.stats.chi2.ppf``, whose module takes a third of a second to import.
    """
    return 2 * gammaincinv(np.asarray(degrees) / 2, probability)


@dataclass(frozen=True)
class Candidates:
    """New variables with usable initial values, and the graph as it is."""

    new_keyframes: Ints
    new_poses: Array
    new_landmarks: Ints
    new_points: Array
    tables: FactorTables

    def has_keyframes(self, ids: Ints) -> Mask:
        """Which of these are new or in the graph."""
        return self.tables.keyframes.contains(ids) | np.isin(ids, self.new_keyframes)

    def has_landmarks(self, ids: Ints) -> Mask:
        """Which of these are new or in the graph."""
        return self.tables.landmarks.contains(ids) | np.isin(ids, self.new_landmarks)

    def poses(self, ids: Ints) -> Array:
        """Poses (N, 4, 4) of ids that must exist."""
        table = self.tables.keyframes
        return _lookup(ids, (table.ids, table.values), (self.new_keyframes, self.new_poses))

    def points(self, ids: Ints) -> Array:
        """Points (N, 3) of ids that must exist."""
        table = self.tables.landmarks
        return _lookup(ids, (table.ids, table.values), (self.new_landmarks, self.new_points))


def check_variables(ids: Ints, values: Array, known: Ints) -> tuple[Ints, Ints]:
    """Rows of usable new variables, and a reason (0: fine) for each given one."""
    reasons = np.zeros(len(ids), np.int64)
    first = np.zeros(len(ids), bool)
    first[np.unique(ids, return_index=True)[1]] = True
    reasons[~first | np.isin(ids, known)] = RefusalReason.DUPLICATE
    bad = np.logical_not(np.isfinite(values).all(axis=tuple(range(1, values.ndim))))
    if values.ndim == 3:
        rotations = np.where(bad[:, None, None], np.eye(3), values[:, :3, :3])
        off = np.abs(np.swapaxes(rotations, 1, 2) @ rotations - np.eye(3)).max(
            axis=(1, 2), initial=0
        )
        bad |= (off > 1e-4) | (np.linalg.det(rotations) < 0)
    reasons[bad | (ids < 0)] = RefusalReason.NOT_FINITE
    return np.flatnonzero(reasons == 0), reasons


def check_pose_factors(
    update: GraphUpdate, candidates: Candidates
) -> tuple[tuple[RelativePose | PosePrior, ...], tuple[RefusedFactor, ...]]:
    """The usable priors and relative poses, and those refused with a reason."""
    good: list[RelativePose | PosePrior] = []
    refused: list[RefusedFactor] = []
    given: list[RelativePose | PosePrior] = [*update.priors, *update.relative_poses]
    for factor in given:
        reason = _pose_factor_reason(factor, candidates)
        if reason is None:
            good.append(factor)
        else:
            refused.append(RefusedFactor(factor.kind, factor.keyframe_ids, reason))
    return tuple(good), tuple(refused)


def _pose_factor_reason(
    factor: RelativePose | PosePrior, candidates: Candidates
) -> RefusalReason | None:
    ids = factor.keyframe_ids
    T = factor.T_world_camera if isinstance(factor, PosePrior) else factor.T_a_b
    if not candidates.has_keyframes(np.array(ids, np.int64)).all():
        return RefusalReason.UNKNOWN_KEYFRAME
    if len(set(ids)) < len(ids):
        return RefusalReason.DUPLICATE
    if len(check_variables(np.zeros(1, np.int64), T[None], np.zeros(0, np.int64))[0]) == 0:
        return RefusalReason.NOT_FINITE
    covariance = factor.covariance
    symmetric = np.isfinite(covariance).all() and np.allclose(
        covariance, covariance.T, rtol=1e-6, atol=0.0
    )
    if not symmetric or np.linalg.eigvalsh(covariance)[0] <= 0:
        return RefusalReason.BAD_COVARIANCE
    if isinstance(factor, RelativePose) and factor.robust not in (None, *KERNELS):
        raise ValueError(f"RelativePose.robust is {factor.robust!r}; use None or one of {KERNELS}")
    return None


def check_observations(
    observations: Observations, candidates: Candidates, camera: Camera, config: SmootherConfig
) -> Ints:
    """A reason (0: fine) for each observation on its own."""
    z, sigmas = observations.measurements, observations.sigmas_px
    stereo = np.isfinite(z[:, 2])
    used = np.ones((len(z), 3), bool)
    used[:, 2] = stereo
    bad_z = ~np.isfinite(z[:, :2]).all(axis=1) | np.isinf(z[:, 2])
    bad_sigma = (used & ~(np.isfinite(sigmas) & (sigmas > 0))).any(axis=1)
    depth_m, chi2 = reprojection(
        observations,
        candidates.poses(observations.keyframe_ids),
        candidates.points(observations.landmark_ids),
        camera,
    )
    is_new = ~candidates.tables.landmarks.contains(observations.landmark_ids)
    with np.errstate(invalid="ignore"):
        disparity_ratio = (z[:, 0] - z[:, 2]) * depth_m / camera.stereo_bf_px_m
    checks = (
        (bad_z | bad_sigma, RefusalReason.NOT_FINITE),
        (~candidates.has_keyframes(observations.keyframe_ids), RefusalReason.UNKNOWN_KEYFRAME),
        (~candidates.has_landmarks(observations.landmark_ids), RefusalReason.UNKNOWN_LANDMARK),
        (_repeated(observations, candidates.tables), RefusalReason.DUPLICATE),
        (~(depth_m >= config.min_depth_m), RefusalReason.BEHIND_CAMERA),
        (~(depth_m <= config.max_range_m), RefusalReason.OUT_OF_RANGE),
        (~(chi2 <= config.gate_sigmas**2), RefusalReason.REPROJECTION),
        (is_new & (disparity_ratio > config.max_disparity_ratio), RefusalReason.REPROJECTION),
    )
    reasons = np.zeros(len(observations), np.int64)
    for failed, reason in reversed(checks):
        reasons[failed] = reason
    return reasons


def reprojection(
    observations: Observations, poses_world_camera: Array, points_world: Array, camera: Camera
) -> tuple[Array, Array]:
    """z-depth (M,) in metres and chi-square (M,) of each observation, without any kernel.

    ``poses_world_camera`` (M, 4, 4) and ``points_world`` (M, 3) belong to the observations row
    by row. 3 degrees of freedom with u_right, else 2.
    """
    T_camera_world = inverse(poses_world_camera)
    points_camera = (T_camera_world[:, :3, :3] @ points_world[:, :, None])[:, :, 0]
    points_camera += T_camera_world[:, :3, 3]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        residual = camera.project_stereo(points_camera) - observations.measurements
        residual[:, 2] = residual[:, 0] - residual[:, 2]  # of the disparity
        whitened = residual / observations.sigmas_px
    mono = ~np.isfinite(observations.measurements[:, 2])
    whitened[mono, 2] = 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        return points_camera[:, 2], np.sum(whitened**2, axis=1)


def observation_errors(tables: FactorTables, camera: Camera) -> ObservationErrors:
    """Chi-square of every observation at the current values."""
    observations = tables.observations.all()
    poses, points = tables.values_of(observations)
    depth_m, chi_squares = reprojection(observations, poses, points, camera)
    is_stereo = np.isfinite(observations.measurements[:, 2])
    return ObservationErrors(
        observations.keyframe_ids, observations.landmark_ids, chi_squares, depth_m, is_stereo
    )


def wrong_observations(
    tables: FactorTables, camera: Camera, probability: float = OBSERVATION_PROBABILITY
) -> Ints:
    """Keyframe and landmark ids (N, 2) of observations beyond their chi-square bound.

    3 degrees of freedom with depth, 2 without; without the robust kernel.
    """
    errors = observation_errors(tables, camera)
    wrong = ~(errors.chi2 <= chi2_quantile(probability, np.where(errors.is_stereo, 3, 2)))
    return np.stack([errors.keyframe_ids[wrong], errors.landmark_ids[wrong]], axis=1)


def relative_pose_errors(
    factors: Sequence[RelativePose], keyframes: ValueTable, slack: Array | None = None
) -> RelativePoseErrors:
    """Chi-square of relative poses between keyframes that the table holds.

    ``slack`` (N, 6, 6) is added to their covariances: errors of the poses that no factor states.
    """
    a = np.array([f.keyframe_a for f in factors], np.int64)
    b = np.array([f.keyframe_b for f in factors], np.int64)
    measured = np.array([f.T_a_b for f in factors]).reshape(-1, 4, 4)
    covariances = np.array([f.covariance for f in factors]).reshape(-1, 6, 6)
    r = se3_log(inverse(measured) @ inverse(keyframes.get(a)) @ keyframes.get(b))
    kinds = np.array([f.kind for f in factors], np.str_)
    S = covariances if slack is None else covariances + slack
    return RelativePoseErrors(a, b, kinds, mahalanobis(r, S))


def mahalanobis(r: Array, covariances: Array) -> Array:
    """``r^T inverse(S) r`` of vectors (K, d) and covariances (K, d, d)."""
    return np.sum(r * np.linalg.solve(covariances, r[..., None])[..., 0], axis=1)


def _repeated(observations: Observations, tables: FactorTables) -> Mask:
    """Observations of a (keyframe, landmark) pair that the graph or an earlier row has."""
    observed: set[tuple[int, int]] = set()
    repeated = np.zeros(len(observations), bool)
    for i, pair in enumerate(map(tuple, observations.pairs.tolist())):
        repeated[i] = (
            pair in observed
            or tables.observations.row(*pair) is not None
            or tables.marginalised.contains(*pair)
        )
        observed.add(pair)
    return repeated


def _lookup(ids: Ints, *tables: tuple[Ints, Array]) -> Array:
    values = np.full((len(ids), *tables[0][1].shape[1:]), np.nan)
    for known_ids, known in tables:
        if not len(known_ids):
            continue
        order = np.argsort(known_ids, kind="stable")
        at = order[np.minimum(np.searchsorted(known_ids[order], ids), len(known_ids) - 1)]
        found = known_ids[at] == ids
        values[found] = known[at[found]]
    return values
