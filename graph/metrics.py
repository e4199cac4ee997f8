"""Absolute and relative trajectory errors (Sturm et al., IROS 2012), in numpy alone.

The estimate lives in its own world frame, ``estimate``, the reference in ``reference``. Both
functions take trajectories whose k-th poses belong together: see ``graph.trajectory.associate``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse, so3_log
from bmask_slam.graph.trajectory import Trajectory, nearest_indices

RELATIVE_DELTA_TOLERANCE = 0.1


@dataclass(frozen=True, eq=False)
class ErrorStatistics:
    """Errors (N,), at least one, none negative, and their usual statistics."""

    errors: Array

    @property
    def rmse(self) -> float:
        """Root of the mean square."""
        return float(np.sqrt(np.mean(self.errors**2)))

    @property
    def mean(self) -> float:
        return float(np.mean(self.errors))

    @property
    def median(self) -> float:
        return float(np.median(self.errors))

    @property
    def max(self) -> float:
        return float(np.max(self.errors))


@dataclass(frozen=True, eq=False)
class Alignment:
    """``p_reference = scale * R_reference_estimate @ p_estimate + t_reference_estimate``.

    ``T_reference_estimate`` (4, 4) holds R and t; scale is 1 for a rigid alignment.
    """

    T_reference_estimate: Array
    scale: float = 1.0

    def apply(self, estimate: Trajectory) -> Trajectory:
        """The estimate in the reference's world frame."""
        scaled = estimate.poses_world_camera.copy()
        scaled[:, :3, 3] *= self.scale
        return Trajectory(estimate.timestamps_s, self.T_reference_estimate @ scaled)


@dataclass(frozen=True, eq=False)
class AbsoluteError:
    """Absolute trajectory error: what remains after the best alignment.

    Attributes:
        alignment: of the estimate to the reference.
        aligned: the estimate's poses in the reference's frame.
        translation_m: distance of the camera centres at each pose.
        rotation_rad: angle between the aligned and the reference orientation at each pose. The
            alignment is by positions alone, as is usual.
    """

    alignment: Alignment
    aligned: Trajectory
    translation_m: ErrorStatistics
    rotation_rad: ErrorStatistics


@dataclass(frozen=True, eq=False)
class RelativeError:
    """Relative pose error ``E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j)`` over pairs (i, j) of poses.

    Attributes:
        timestamps_s: (M,) stamp of the estimate's pose i of each pair.
        translation_m: length of E's translation.
        rotation_rad: angle of E's rotation.
    """

    timestamps_s: Array
    translation_m: ErrorStatistics
    rotation_rad: ErrorStatistics


def align(points_estimate: Array, points_reference: Array, with_scale: bool = False) -> Alignment:
    """Least-squares SE(3) (or Sim(3)) alignment of points (N, 3) that belong together.

    Umeyama, PAMI 1991, eqs. (34)-(43). Points on a line or in one spot leave the rotation
    partly free; any of the best ones is returned, and the remaining distances are unaffected.

    Raises:
        ValueError: no points.
        InputError: a scale asked for points that do not move.
    """
    if not len(points_estimate) or points_estimate.shape != points_reference.shape:
        raise ValueError(f"cannot align {points_estimate.shape} with {points_reference.shape}")
    mean_e, mean_r = points_estimate.mean(axis=0), points_reference.mean(axis=0)
    centred_e, centred_r = points_estimate - mean_e, points_reference - mean_r
    U, D, Vt = np.linalg.svd(centred_r.T @ centred_e / len(centred_e))
    S = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])  # no reflection
    scale = 1.0
    if with_scale:
        variance = np.mean(np.sum(centred_e**2, axis=1))
        if variance < 1e-18:
            raise InputError("the estimate does not move, so no scale is found; omit --with-scale")
        scale = float(D @ S / variance)
    T = np.eye(4)
    T[:3, :3] = U @ (S[:, None] * Vt)
    T[:3, 3] = mean_r - scale * T[:3, :3] @ mean_e
    return Alignment(T, scale)


def absolute_error(
    estimate: Trajectory, reference: Trajectory, with_scale: bool = False
) -> AbsoluteError:
    """Absolute trajectory error of poses that belong together, after ``align``.

    Raises:
        InputError: ``with_scale`` for an estimate that does not move.
    """
    alignment = align(estimate.positions_world, reference.positions_world, with_scale)
    aligned = alignment.apply(estimate)
    E = inverse(reference.poses_world_camera) @ aligned.poses_world_camera
    return AbsoluteError(alignment, aligned, *_sizes(E))


def relative_error(
    estimate: Trajectory, reference: Trajectory, pairs: tuple[Ints, Ints]
) -> RelativeError | None:
    """Relative pose error over index pairs (i, j); None when there is no pair.

    It does not depend on the world frames, so no alignment is needed.
    """
    i, j = pairs
    if not len(i):
        return None
    P, Q = estimate.poses_world_camera, reference.poses_world_camera
    E = inverse(inverse(Q[i]) @ Q[j]) @ inverse(P[i]) @ P[j]
    return RelativeError(estimate.timestamps_s[i], *_sizes(E))


def frame_pairs(count: int, delta: int = 1) -> tuple[Ints, Ints]:
    """Every pair (i, i + delta) of ``count`` poses (evo's delta in frames with all pairs)."""
    i = np.arange(max(count - delta, 0))
    return i, i + delta


def time_pairs(timestamps_s: Array, delta_s: float = 1.0) -> tuple[Ints, Ints]:
    """For each i the j whose stamp is nearest to ``t_i + delta_s``, as TUM's script pairs them.

    A pair whose time difference is off by more than a tenth of ``delta_s`` is left out, so that
    gaps and the end of the trajectory do not count. evo has no such delta; on evenly sampled poses
    this is its delta of ``delta_s * fps`` frames with all pairs.
    """
    if not len(timestamps_s):
        return frame_pairs(0)
    i = np.arange(len(timestamps_s))
    j = nearest_indices(timestamps_s, timestamps_s + delta_s)
    difference_s = timestamps_s[j] - timestamps_s - delta_s
    good = np.abs(difference_s) <= RELATIVE_DELTA_TOLERANCE * delta_s
    return i[good], j[good]


def distance_pairs(positions: Array, delta_m: float = 1.0) -> tuple[Ints, Ints]:
    """For each i the later j to which the path over ``positions`` (N, 3) is nearest to ``delta_m``.

    A pair whose path is off by more than a tenth of ``delta_m`` is left out. This is evo's delta in
    metres with all pairs. Give the reference's positions, so that every estimate gets the same
    pairs.
    """
    if len(positions) < 2:
        return frame_pairs(0)
    steps_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    path_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    after = np.minimum(np.searchsorted(path_m, path_m + delta_m), len(path_m) - 1)
    before = np.searchsorted(path_m, path_m[after - 1])  # the first of those in one place
    off_m = np.abs(path_m[np.stack([before, after])] - path_m - delta_m)
    j = np.where(off_m[1] < off_m[0], after, before)
    good = off_m.min(axis=0) <= RELATIVE_DELTA_TOLERANCE * delta_m
    return np.flatnonzero(good), j[good]


def _sizes(E: Array) -> tuple[ErrorStatistics, ErrorStatistics]:
    """Translation in metres and rotation angle in radians of error transforms (N, 4, 4)."""
    translation_m = np.linalg.norm(E[:, :3, 3], axis=-1)
    rotation_rad = np.linalg.norm(so3_log(E[:, :3, :3]), axis=-1)
    return ErrorStatistics(translation_m), ErrorStatistics(rotation_rad)
