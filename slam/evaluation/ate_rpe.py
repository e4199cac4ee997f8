"""Errors of a trajectory against a reference: from files to a table of named numbers."""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict

import numpy as np

from bmask_slam.evaluation.recordings import OVERLAPPING, MergedClock, merged_clock
from bmask_slam.evaluation.reference import file_in, read_reference, reference_file
from bmask_slam.events import read_events
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError, finite_number, naming
from bmask_slam.graph.files.reading import read_table
from bmask_slam.graph.geometry import so3_log
from bmask_slam.graph.hand_eye import body_trajectory, hand_eye
from bmask_slam.graph.metrics import (
    AbsoluteError,
    RelativeError,
    absolute_error,
    distance_pairs,
    frame_pairs,
    relative_error,
    time_pairs,
)
from bmask_slam.graph.trajectory import (
    MAX_TIME_DIFFERENCE_S,
    Trajectory,
    associate,
    nearest_indices,
)
from bmask_slam.graph.trajectory_formats import read_times, read_trajectory

logger = logging.getLogger(__name__)

MIN_POSES = 3

DRIFT_LENGTHS_M = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0)


class Row(TypedDict):
    """One line of metrics.json; unit "1" is a share."""

    name: str
    value: float
    unit: str


@dataclass(frozen=True, eq=False)
class EvaluationResult:
    """The errors of a trajectory, also as rows for metrics.json.

    Attributes:
        absolute: error of each pose after alignment.
        per_frame: relative error of consecutive associated poses; across a gap in the estimate
            such a pair spans the gap.
        per_second: relative error over one second, None where no two poses are that far apart.
        per_metre: the same over one metre of the reference's path.
        rows: all errors by name.
    """

    absolute: AbsoluteError
    per_frame: RelativeError | None
    per_second: RelativeError | None
    per_metre: RelativeError | None
    rows: list[Row]

    def value(self, name: str) -> float:
        """The value of a row; KeyError when there is no such row."""
        return {row["name"]: row["value"] for row in self.rows}[name]


def evaluate_trajectory(
    estimate: Trajectory,
    reference: Trajectory,
    expected_frames: int | None = None,
    with_scale: bool = False,
    max_time_difference_s: float = MAX_TIME_DIFFERENCE_S,
) -> EvaluationResult:
    """Compare an estimate with a reference, which may be in another world frame.

    Poses are associated by stamp; the alignment is SE(3), or Sim(3) with ``with_scale`` (for
    monocular systems only), whose scale applies to relative errors too. ``expected_frames``, the
    number of frames that the system was given, adds the share that it tracked.

    Raises:
        InputError: fewer than three poses are associated, or ``with_scale`` for an estimate that
            does not move.
    """
    matched, truth = associate(estimate, reference, max_time_difference_s)
    if not len(estimate):
        raise InputError("the trajectory has no pose, so there is nothing to compare")
    if len(matched) < MIN_POSES:
        raise InputError(
            f"{len(matched)} of {len(estimate)} poses have a reference pose within "
            f"{max_time_difference_s:g} s, at least {MIN_POSES} are needed; estimate "
            f"{_span(estimate)}, reference {_span(reference)}: "
            + ("use the same clock in both" if len(estimate) >= MIN_POSES else "give a longer run")
        )
    absolute = absolute_error(matched, truth, with_scale)
    scaled = absolute.alignment.apply(matched) if with_scale else matched
    per_frame = relative_error(scaled, truth, frame_pairs(len(matched)))
    per_second = relative_error(scaled, truth, time_pairs(matched.timestamps_s))
    path_pairs = distance_pairs(truth.positions_world)
    per_metre = relative_error(scaled, truth, path_pairs)
    rows = _absolute_rows(absolute) + _relative_rows("frame", per_frame)
    rows += _relative_rows("second", per_second) + _relative_rows("metre", per_metre)
    rows += _drift_rows(scaled, truth)
    rows += _coverage_rows(estimate, reference, matched)
    if expected_frames:
        rows.append(_row("tracked_share", len(estimate) / expected_frames, "1"))
    return EvaluationResult(absolute, per_frame, per_second, per_metre, rows)


def evaluate(
    run_or_trajectory: Path,
    reference: Path,
    plot: Path | None = None,
    with_scale: bool = False,
    times: Path | None = None,
    with_body: bool = False,
) -> EvaluationResult:
    """Evaluate a run folder or a trajectory against a trajectory or a sequence folder.

    Trajectories are in the format of TUM, EuRoC or KITTI; stamps of the latter are read from the
    file ``times``, or are those of the run's frames. ``plot`` shows a run's events. ``with_body``:
    the reference is of another body, such as markers or an IMU, whose pose on the camera is
    estimated. A merged run has its recordings' own stamps; where these overlap it warns instead.

    Raises:
        InputError: a missing or broken file, trajectories without common times, ``with_scale`` for
            an estimate at rest, or ``with_body`` for one that does not turn or has no known scale.
    """
    if with_body and with_scale:
        raise InputError("--hand-eye with --with-scale: a body's place needs metres; leave one out")
    run_or_trajectory, truth_file = Path(run_or_trajectory), reference_file(Path(reference))
    file = file_in(run_or_trajectory, "trajectory.txt", "a run folder or a trajectory file")
    frames_s, clock = frame_stamps(file), clock_of(file)
    stamps_s = read_times(times) if times else frames_s
    frames = 0 if frames_s is None else len(frames_s)
    estimate = clock.own_trajectory(read_trajectory(file, stamps_s))
    truth = read_reference(truth_file, stamps_s)
    with naming(f"{file} against {truth_file}"):
        estimate, body = _of_body(estimate, truth) if with_body else (estimate, [])
        result = evaluate_trajectory(estimate, truth, frames, with_scale)
        result.rows.extend(body)
    _tell_segments(file)
    if plot is not None:
        from bmask_slam.evaluation.plot import plot_trajectory  # noqa: PLC0415 - matplotlib loads slowly

        events = [] if frames_s is None else clock.own_events(read_events(file.parent))
        plot_trajectory(plot, estimate, truth, run_or_trajectory.resolve().stem, events, with_scale)
    return result


def _tell_segments(file: Path) -> None:
    """Warn of a run's frames that are not compared, since no pose joins them to trajectory.txt."""
    others = file.parent.glob("trajectory_segment_*.txt") if file.name == "trajectory.txt" else ()
    if names := ", ".join(sorted(path.name for path in others)):
        text = "%s: only the largest map segment is compared; %s beside it can be evaluated alone"
        logger.warning(text, file, names)


def _of_body(estimate: Trajectory, truth: Trajectory) -> tuple[Trajectory, list[Row]]:
    """The estimate as the trajectory of the reference's body, and rows with its pose."""
    T_camera_body = hand_eye(*associate(estimate, truth))
    return body_trajectory(estimate, T_camera_body), _body_rows(T_camera_body)


def clock_of(file: Path) -> MergedClock:
    """The clock of the run of a trajectory.txt; warns where moved stamps stay as they are."""
    clock = merged_clock(file.parent) if file.name == "trajectory.txt" else MergedClock()
    if clock.overlapping:
        logger.warning(OVERLAPPING, file)
    return clock


def frame_stamps(trajectory_file: Path) -> Array | None:
    """Stamps of all frames of the run of a trajectory.txt; None if it belongs to no run."""
    path = trajectory_file.parent / "frames.csv"
    if trajectory_file.name != "trajectory.txt" or not path.is_file():
        return None
    stamps = read_table(path, ("timestamp",), "run again", growing=True)["timestamp"]
    return np.array([finite_number(stamp, str(path)) for stamp in stamps])


def format_table(rows: list[Row]) -> str:
    """Rows as aligned text, shares in per cent."""
    lines = []
    for row in rows:
        value, unit = row["value"], row["unit"]
        if unit == "1":
            value, unit = 100 * value, "%"
        number = f"{value:d}" if isinstance(value, int) else f"{value:.4f}"
        lines.append(f"{row['name']:<24}{number:>12} {unit}")
    return "\n".join(lines)


def format_json(rows: list[Row]) -> str:
    """Rows as the JSON list that metrics.json holds."""
    return json.dumps(rows, indent=1)


def _row(name: str, value: float, unit: str) -> Row:
    return {"name": name, "value": value, "unit": unit}


def _absolute_rows(error: AbsoluteError) -> list[Row]:
    names = ("rmse", "mean", "median", "max")
    rows = [_row(f"ate_{name}", getattr(error.translation_m, name), "m") for name in names]
    return [*rows, _row("ate_rot_rmse", float(np.rad2deg(error.rotation_rad.rmse)), "deg")]


def _relative_rows(step: str, error: RelativeError | None) -> list[Row]:
    """Rows for a step, "frame", "second" or "metre"; none when no pair was found.

    Without pairs of the first two a warning is logged; a path below one metre is not unusual.
    """
    if error is None:
        if step != "metre":
            logger.warning("no two associated poses one %s apart: no RPE per %s", step, step)
        return []
    degrees = float(np.rad2deg(error.rotation_rad.rmse))
    return [
        _row(f"rpe_trans_rmse_{step}", error.translation_m.rmse, "m"),
        _row(f"rpe_rot_rmse_{step}", degrees, "deg"),
    ]


def _drift_rows(estimate: Trajectory, truth: Trajectory) -> list[Row]:
    """The mean error over paths of DRIFT_LENGTHS_M, by the length; none for a shorter trajectory.

    As in KITTI's odometry benchmark (Geiger et al. 2012), at a hundredth of its lengths.
    """
    translation, rotation = [], []
    for length_m in DRIFT_LENGTHS_M:
        pairs = distance_pairs(truth.positions_world, length_m)
        if (error := relative_error(estimate, truth, pairs)) is not None:
            translation.append(error.translation_m.errors / length_m)
            rotation.append(np.rad2deg(error.rotation_rad.errors) / length_m)
    if not translation:
        return []
    means = (float(np.concatenate(errors).mean()) for errors in (translation, rotation))
    units = (("drift_trans", "1"), ("drift_rot", "deg/m"))
    return [_row(name, mean, unit) for (name, unit), mean in zip(units, means, strict=True)]


def _body_rows(T_camera_body: Array) -> list[Row]:
    """Position and angle of the reference's body in the camera's frame."""
    names = ("body_x", "body_y", "body_z")
    rows = [_row(name, float(t), "m") for name, t in zip(names, T_camera_body[:3, 3], strict=True)]
    angle_rad = np.linalg.norm(so3_log(T_camera_body[:3, :3]))
    return [*rows, _row("body_angle", float(np.rad2deg(angle_rad)), "deg")]


def _coverage_rows(estimate: Trajectory, reference: Trajectory, matched: Trajectory) -> list[Row]:
    """Shares that were compared: of the estimate by poses, of the reference by time.

    A reference pose counts as covered when the estimate has a pose within its own typical step,
    so that an estimate at 30 Hz can cover all of a reference at 100 Hz.
    """
    step_s = max(float(np.median(np.diff(estimate.timestamps_s))), MAX_TIME_DIFFERENCE_S)
    nearest = nearest_indices(estimate.timestamps_s, reference.timestamps_s)
    covered = np.abs(estimate.timestamps_s[nearest] - reference.timestamps_s) <= step_s
    estimate_share = len(matched) / len(estimate)
    if estimate_share < 0.5:
        logger.warning("only %.0f %% of the estimate has a reference pose", 100 * estimate_share)
    return [
        _row("associated_poses", len(matched), "poses"),
        _row("estimate_share", estimate_share, "1"),
        _row("reference_share", float(covered.mean()), "1"),
    ]


def _span(trajectory: Trajectory) -> str:
    stamps_s = trajectory.timestamps_s
    return f"{stamps_s[0]:.3f} to {stamps_s[-1]:.3f} s" if len(stamps_s) else "without a pose"
