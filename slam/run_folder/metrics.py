"""The end of a run: its metrics and its result files."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from bmask_slam.evaluation import Row, evaluate_trajectory, format_json
from bmask_slam.events import read_events
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.run_folder.folder import RunFolder
from bmask_slam.run_folder.landmark_file import write_landmarks
from bmask_slam.runtime.memory import peak_rss_mb
from bmask_slam.system_interface import System
from bmask_slam.tracking.results import FrameResult, TrackingStatus

logger = logging.getLogger(__name__)

MOST_NAMED = 3
"""Files of map segments that a warning names."""
EVALUATION_ROWS = (
    "ate_rmse",
    "rpe_trans_rmse_frame",
    "rpe_trans_rmse_second",
    "rpe_rot_rmse_second",
)


@dataclass
class RunCounters:
    """Counts and times of the frames so far.

    Attributes:
        tracking_ms: time of each frame in features, moving objects and tracking, without the work
            that a keyframe adds.
        next_index: the first index of the sequence that was not processed.
        keyframes: number of keyframes made.
        lost: number of frames without a pose.
        wall_s: time of the whole loop, without frames that a kill discarded.
    """

    tracking_ms: list[float] = field(default_factory=list)
    next_index: int = 0
    keyframes: int = 0
    lost: int = 0
    wall_s: float = 0.0

    @property
    def frames(self) -> int:
        """Frames given to the system."""
        return len(self.tracking_ms)

    def count(self, result: FrameResult) -> None:
        """Count a frame."""
        stages = result.stage_ms
        spent_ms = (stages.get(stage, 0.0) for stage in ("features", "moving", "tracking"))
        self.tracking_ms.append(sum(spent_ms))
        self.next_index = result.index + 1
        self.keyframes += result.keyframe_id is not None
        self.lost += result.status is TrackingStatus.LOST


def measure(
    system: System, reference: Trajectory | None, counters: RunCounters, arrived: int
) -> list[Row]:
    """The rows of metrics.json; errors only where there is a reference that covers the run.

    ``arrived``: frames that the source gave, the broken ones among them too.
    """
    trajectory, statistics = system.trajectory(), system.statistics()
    rows = [row("tracked_share", len(trajectory) / max(arrived, 1), "1")]
    if reference is not None:
        try:
            errors = evaluate_trajectory(trajectory, reference).rows
            rows += [row for row in errors if row["name"] in EVALUATION_ROWS]
        except InputError as error:
            logger.warning("no comparison with the reference: %s", error)
    rows += _percentiles("tracking_ms", counters.tracking_ms)
    rows.append(row("frames_per_second", counters.frames / counters.wall_s, "Hz"))
    rows.append(row("keyframes", int(statistics["keyframes"]), "keyframes"))
    rows.append(row("landmarks", int(statistics["landmarks"]), "landmarks"))
    rows.append(row("loops_closed", int(statistics["loops_closed"]), "loops"))
    rows += _percentiles("isam2_update_ms", statistics["isam2_update_ms"])
    for what, count in statistics["graph"].items():
        words = what.replace(":", "").replace(",", "").split()
        rows.append(row("_".join(("graph", *words)), count, words[0]))
    rows.append(row("peak_rss_mb", peak_rss_mb(), "MB"))
    return rows


def row(name: str, value: float, unit: str) -> Row:
    """A row of metrics.json."""
    return {"name": name, "value": value, "unit": unit}


def _percentiles(name: str, values_ms: list[float]) -> list[Row]:
    """Rows of the median and the 95th percentile; none without values."""
    if not values_ms:
        return []
    median, high = np.percentile(values_ms, (50, 95))
    return [row(f"{name}_median", float(median), "ms"), row(f"{name}_p95", float(high), "ms")]


def save_poses_and_points(system: System, folder: RunFolder) -> tuple[str, ...]:
    """Write all poses, and the landmarks: what there is even where the graph was lost.

    Every map segment that is not joined to the largest has a file of its own; if there are any, a
    warning says so, which is logged too.
    """
    trajectory, apart = system.trajectory(), dict[str, Trajectory]()
    folder.write_trajectory(trajectory)
    folder.write_trajectory(system.keyframe_trajectory(), "keyframes.txt")
    for number, segment in system.segments().items():
        if segment.timestamps_s[0] not in trajectory.timestamps_s:
            apart[f"trajectory_segment_{number}.txt"] = segment
    for name, segment in apart.items():
        folder.write_trajectory(segment, name)
    landmarks = system.landmarks()
    folder.written(lambda path: write_landmarks(path / "landmarks.ply", landmarks))
    if not apart:
        return ()
    text = _told_apart(len(trajectory), apart)
    logger.warning(text)
    return (text,)


def _told_apart(frames: int, apart: Mapping[str, Trajectory]) -> str:
    """What a run says whose map fell into parts."""
    theirs = sum(map(len, apart.values()))
    names = ", ".join([*list(apart)[:MOST_NAMED], *(["..."] if len(apart) > MOST_NAMED else [])])
    return (
        f"map: {theirs} of {frames + theirs} frames with a pose are in {len(apart)} segments that "
        f"were never recognised in the largest, each in a world of its own ({names}); "
        f"trajectory.txt, landmarks, objects and dense map are of the largest, {frames} frames"
    )


def save(
    system: System, folder: RunFolder, rows: list[Row], reference: Trajectory | None, title: str
) -> tuple[str, ...]:
    """Write the result files; returns a warning where the map is in several segments."""
    from bmask_slam.evaluation.plot import plot_trajectory  # noqa: PLC0415 - matplotlib is large

    trajectory = system.trajectory()
    warnings = save_poses_and_points(system, folder)
    files = system.files()
    for name, write in files.items():
        folder.write_file(name, write)
    folder.write_text("metrics.json", format_json(rows))
    events = read_events(folder.path)
    picture = trajectory, reference, title, events
    folder.written(lambda path: plot_trajectory(path / "trajectory.png", *picture))
    for name in files:
        size_mb = (folder.path / name).stat().st_size / 1e6
        logger.info("%s: %.1f MB", name, size_mb)
    return warnings
