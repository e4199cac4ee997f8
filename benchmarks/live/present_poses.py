"""The poses and velocities that the live loop gives out frame by frame, tracked and filtered.

    python -m benchmarks.live.present_poses [SEQUENCE ...]

A recording is given at thirty frames a second; of each frame the pose is kept as it was tracked,
and as the filter (`slam/tracking/pose_filter.py`) gave it out. Errors are RMSE against the truth
after SE(3) alignment; the map moves on the way. Those of velocities are against the truth's poses
before and after the frame: of the filter, and of the difference to the tracked pose before.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from benchmarks.paths import SHARED
from bmask_slam import LiveSlam, open_sequence
from bmask_slam.calibration.motion import twists_at
from bmask_slam.evaluation.ate_rpe import evaluate_trajectory
from bmask_slam.evaluation.reference import read_reference
from bmask_slam.graph.geometry import inverse, se3_log
from bmask_slam.graph.trajectory import Trajectory, nearest_indices
from bmask_slam.tracking.pose_filter import PoseFilter
from bmask_slam.tracking.results import FrameResult

HEAD = ("poses", "ATE mm", "RPE/s mm", "RPE/frame mm", "rad/s", "m/s")
STEP_S = 1 / 30


class RecordedFilter(PoseFilter):
    """Keeps what it was given and what it gave."""

    def __init__(self) -> None:
        super().__init__()
        self.tracked: list[FrameResult] = []
        self.given_out: list[FrameResult] = []

    def filtered(self, result: FrameResult) -> FrameResult:
        """As the filter, and kept."""
        found = super().filtered(result)
        self.tracked.append(result)
        self.given_out.append(found)
        return found


def recorded(path: Path) -> RecordedFilter:
    """The poses of a recording that is tracked live."""
    sequence, kept = open_sequence(path), RecordedFilter()
    with LiveSlam(sequence.camera) as slam:
        slam._system._filter = kept
        due_s = time.monotonic()
        for frame in sequence.frames():
            slam.track(frame.timestamp_s, frame.rgb, frame.depth_m)
            due_s += STEP_S
            time.sleep(max(due_s - time.monotonic(), 0.0))
    return kept


def path_of(results: list[FrameResult]) -> Trajectory:
    """The poses of the first segment."""
    known = [r for r in results if r.T_world_camera is not None and r.segment == 0]
    poses = np.array([r.T_world_camera for r in known])
    return Trajectory(np.array([r.timestamp_s for r in known]), poses)


def velocity_errors(kept: RecordedFilter, reference: Trajectory) -> list[tuple[float, float]]:
    """RMS in rad/s and m/s of differences of tracked poses, and of the filter."""
    path = path_of(kept.tracked)
    at = nearest_indices(reference.timestamps_s, path.timestamps_s)
    truth = Trajectory(path.timestamps_s, reference.poses_world_camera[at])
    true, T = twists_at(truth, path.timestamps_s)[1:], path.poses_world_camera
    differences = se3_log(inverse(T[:-1]) @ T[1:]) / np.diff(path.timestamps_s)[:, None]
    by_stamp = {r.timestamp_s: r.velocity for r in kept.given_out}
    velocities = [by_stamp[s] for s in path.timestamps_s[1:].tolist()]
    own = np.array([np.full(6, np.nan) if v is None else v.twist for v in velocities])
    both, usable = [found - true for found in (differences, own)], np.isfinite(own).all(axis=1)
    return [
        (float(np.sqrt((e[usable, :3] ** 2).mean())), float(np.sqrt((e[usable, 3:] ** 2).mean())))
        for e in both
    ]


def main() -> None:
    """Print two lines for each recording."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    recordings = [SHARED / "tum_fr1_rpy", SHARED / "bonn_crowd"]
    parser.add_argument("sequences", type=Path, nargs="*", default=recordings)
    print(f"{'':26}{''.join(f'{name:>14}' for name in HEAD)}")
    for sequence in parser.parse_args().sequences:
        kept, reference = recorded(sequence), read_reference(sequence)
        sides = {"tracked": kept.tracked, "given out": kept.given_out}
        for (title, results), velocity in zip(
            sides.items(), velocity_errors(kept, reference), strict=True
        ):
            found = evaluate_trajectory(path_of(results), reference)
            names = ("ate_rmse", "rpe_trans_rmse_second", "rpe_trans_rmse_frame")
            errors = "".join(f"{1e3 * found.value(name):14.1f}" for name in names)
            rates = "".join(f"{value:14.3f}" for value in velocity)
            name = f"{sequence.name}, {title}"
            print(f"{name:26}{len(path_of(results)):14}{errors}{rates}", flush=True)


if __name__ == "__main__":
    main()
