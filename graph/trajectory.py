"""Stamped camera poses, the TUM text format, and association by time. Needs numpy alone."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.errors import InputError, finite_number
from bmask_slam.graph.files.reading import read_lines
from bmask_slam.graph.files.whole_file import whole_file
from bmask_slam.graph.geometry import (
    inverse,
    make_pose,
    quaternion_from_rotation,
    rotation_from_quaternion,
    se3_exp,
    se3_log,
)

MAX_TIME_DIFFERENCE_S = 0.02
MAX_STAMP_ERROR_S = 1e-5  # of stamps with six decimals
GAP_STEPS = 5  # frames without a pose, at the usual rate: a gap in the path
MAX_TYPICAL_STEP_S = 5.0
TUM_HEADER = "# timestamp_s tx ty tz qx qy qz qw (T_world_camera, metres)"

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Camera poses in time; sorted by stamp on construction, each stamp once.

    Attributes:
        timestamps_s: (N,) float64, strictly increasing.
        poses_world_camera: (N, 4, 4) float64, ``p_world = T_world_camera @ p_camera``.

    Raises:
        ValueError: shapes that do not fit, a value that is not finite, or a repeated stamp.
    """

    timestamps_s: Array
    poses_world_camera: Array

    def __post_init__(self) -> None:
        stamps = np.asarray(self.timestamps_s, float).reshape(-1)
        poses = np.asarray(self.poses_world_camera, float).reshape(-1, 4, 4)
        if len(stamps) != len(poses):
            raise ValueError(f"{len(stamps)} timestamps for {len(poses)} poses")
        if not (np.isfinite(stamps).all() and np.isfinite(poses).all()):
            raise ValueError("a trajectory holds only finite numbers")
        order = np.argsort(stamps, kind="stable")
        stamps, poses = stamps[order], poses[order]
        if (np.diff(stamps) == 0).any():
            raise ValueError(f"repeated timestamp {stamps[:-1][np.diff(stamps) == 0][0]:.6f} s")
        object.__setattr__(self, "timestamps_s", stamps)
        object.__setattr__(self, "poses_world_camera", poses)

    def __len__(self) -> int:
        return len(self.timestamps_s)

    @property
    def positions_world(self) -> Array:
        """Camera centres (N, 3) in metres."""
        return self.poses_world_camera[:, :3, 3]

    @property
    def duration_s(self) -> float:
        """Time from the first pose to the last, 0 when there are fewer than two."""
        return float(self.timestamps_s[-1] - self.timestamps_s[0]) if len(self) else 0.0

    def select(self, indices: NDArray) -> Trajectory:
        """The poses at these indices (or under this mask)."""
        return Trajectory(self.timestamps_s[indices], self.poses_world_camera[indices])

    def at(self, times_s: Array, max_gap_s: float) -> tuple[Array, NDArray[np.bool_]]:
        """Poses (M, 4, 4) at times (M,), along the geodesic between neighbours.

        And whether each is between two poses at most ``max_gap_s`` apart; the others mean nothing.
        """
        stamps_s, T = self.timestamps_s, self.poses_world_camera
        if len(self) < 2:
            return np.tile(np.eye(4), (len(times_s), 1, 1)), np.zeros(len(times_s), bool)
        before = np.clip(np.searchsorted(stamps_s, times_s, side="right") - 1, 0, len(self) - 2)
        step_s = stamps_s[before + 1] - stamps_s[before]
        share = (times_s - stamps_s[before]) / step_s
        inside = (share >= 0) & (share <= 1) & (step_s <= max_gap_s)
        steps = se3_log(inverse(T[before]) @ T[before + 1])
        return np.asarray(T[before] @ se3_exp(share[:, None] * steps)), inside

    def moved(self, T_new_world: Array) -> Trajectory:
        """The same motion seen from another world frame: ``T_new_camera``."""
        return Trajectory(self.timestamps_s, T_new_world @ self.poses_world_camera)


def rows_after_gaps(timestamps_s: Array) -> Ints:
    """The rows of stamps (N,), in order, before which so much is missing that no line is drawn."""
    if len(timestamps_s) < 3:
        return np.zeros(0, np.int64)
    step_s = np.diff(timestamps_s)
    return np.flatnonzero(step_s > GAP_STEPS * np.median(step_s)) + 1


def nearest_indices(stamps_s: Array, queries_s: Array) -> Ints:
    """Index (M,) of the stamp nearest to each query; ``stamps_s`` (N,) sorted and not empty.

    Of two equally near stamps it is the earlier.
    """
    right = np.clip(np.searchsorted(stamps_s, queries_s), 1, max(len(stamps_s) - 1, 1))
    right = np.minimum(right, len(stamps_s) - 1)
    left = np.maximum(right - 1, 0)
    nearer_right = np.abs(stamps_s[right] - queries_s) < np.abs(queries_s - stamps_s[left])
    return np.where(nearer_right, right, left)


def associate_stamps(
    a_s: Array, b_s: Array, max_difference_s: float = MAX_TIME_DIFFERENCE_S
) -> tuple[Ints, Ints]:
    """Pairs of stamps that belong together: indices into ``a_s`` (N,) and ``b_s`` (M,), sorted.

    The closest pair is taken first, then the closest of the rest, as in TUM's associate script, so
    that each stamp is used at most once. The same result is reached here by taking all mutually
    nearest pairs at once and repeating on the rest; two or three rounds are usual.
    Pairs that cross in time (possible where the limit is longer than the steps) exchange their
    partners, which makes no difference larger than the larger of the two: both results increase.
    """
    left_a, left_b = np.arange(len(a_s)), np.arange(len(b_s))
    pairs: list[tuple[Ints, Ints]] = [(left_a[:0], left_b[:0])]
    while len(left_a) and len(left_b):
        to_b = nearest_indices(b_s[left_b], a_s[left_a])
        to_a = nearest_indices(a_s[left_a], b_s[left_b])
        near = np.abs(a_s[left_a] - b_s[left_b[to_b]]) <= max_difference_s
        rows_a = np.flatnonzero((to_a[to_b] == np.arange(len(left_a))) & near)
        if not len(rows_a):
            break
        rows_b = to_b[rows_a]
        pairs.append((left_a[rows_a], left_b[rows_b]))
        left_a, left_b = np.delete(left_a, rows_a), np.delete(left_b, rows_b)
    i, j = np.concatenate([p[0] for p in pairs]), np.concatenate([p[1] for p in pairs])
    return np.sort(i), np.sort(j)


def associate(
    estimate: Trajectory, reference: Trajectory, max_difference_s: float = MAX_TIME_DIFFERENCE_S
) -> tuple[Trajectory, Trajectory]:
    """Both trajectories cut to the poses that belong together, pairwise; may be empty."""
    i, j = associate_stamps(estimate.timestamps_s, reference.timestamps_s, max_difference_s)
    return estimate.select(i), reference.select(j)


def check_seconds(stamps_s: Array, path: Path) -> None:
    """Refuse sorted stamps (N,) whose typical step is too long to be seconds.

    Raises:
        InputError: naming the file, the step and the factor that cures it.
    """
    typical = float(np.median(np.diff(stamps_s))) if len(stamps_s) > 2 else 0.0
    if typical <= MAX_TYPICAL_STEP_S:
        return
    unit, factor = "nanoseconds", "1e9"
    if typical < 5e3:
        unit, factor = "milliseconds", "1000"
    elif typical < 5e6:
        unit, factor = "microseconds", "1e6"
    raise InputError(
        f"{path}: timestamps are {typical:g} apart, which looks like {unit}; "
        f"they must be seconds, divide them by {factor}"
    )


def read_tum(path: Path) -> Trajectory:
    """Read ``timestamp tx ty tz qx qy qz qw`` lines (seconds, metres, T_world_camera).

    Lines may come in any order; empty lines and those that begin with # are ignored. Of
    lines with the same stamp the first is kept, with a warning: TUM's own freiburg2_desk ground
    truth has such a pair.

    Raises:
        InputError: the file is missing or empty, or a line has the wrong number of columns, a
            value that is no finite number or a zero quaternion, or the stamps are not in seconds.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such trajectory file; give a file in TUM format")
    cure = "give a file in TUM format"
    rows = [_tum_row(line, f"{path}:{number}") for number, line in read_lines(path, cure)]
    if not rows:
        raise InputError(f"{path}: no pose in the file; expected lines of {TUM_HEADER[2:]}")
    values = np.array(rows)
    stamps_s, first = np.unique(values[:, 0], return_index=True)
    if len(first) < len(values):
        logger.warning("%s: %d repeated timestamps left out", path, len(values) - len(first))
    check_seconds(stamps_s, path)
    quaternions, positions = values[first, 4:], values[first, 1:4]
    return Trajectory(stamps_s, make_pose(rotation_from_quaternion(quaternions), positions))


def _tum_row(content: str, where: str) -> list[float]:
    """The eight numbers of one line; ``where`` is its file and line for the message."""
    columns = content.replace(",", " ").split()
    if len(columns) != 8:
        hint = " (12 columns are KITTI's format: convert it)" if len(columns) == 12 else ""
        raise InputError(
            f"{where}: {len(columns)} columns in {content[:60]!r}, expected 8: "
            f"timestamp tx ty tz qx qy qz qw{hint}"
        )
    row = [finite_number(column, where) for column in columns]
    check_quaternion(row[4:], where)
    return row


def check_quaternion(words: list[float], where: str) -> None:
    """Refuse four numbers that are no rotation: all about zero, or far beyond one."""
    if not 1e-12 <= sum(q * q for q in words) <= 1e12:
        kind = "zero" if abs(max(words, key=abs)) < 1 else "very long"
        raise InputError(f"{where}: a {kind} quaternion is no rotation; correct or remove the line")


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a TUM file that appears whole or not at all; the same poses give the same bytes.

    Stamps have 6 decimals, positions and quaternions (w >= 0) have 9.
    """
    path = Path(path)
    quaternions = quaternion_from_rotation(trajectory.poses_world_camera[:, :3, :3])
    numbers = np.round(np.hstack([trajectory.positions_world, quaternions]), 9) + 0.0  # no -0.0
    rows = [
        f"{stamp:.6f} " + " ".join(f"{value:.9f}" for value in row)
        for stamp, row in zip(trajectory.timestamps_s, numbers, strict=True)
    ]
    with whole_file(path) as temporary:
        temporary.write_text("\n".join([TUM_HEADER, *rows]) + "\n", encoding="utf-8", newline="\n")
