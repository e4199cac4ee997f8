"""One measurement: a run in a process of its own, and the figures of its run folder."""

from __future__ import annotations

import filecmp
import json
import logging
import multiprocessing
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.paths import ROOT, SHARED
from bmask_slam.evaluation import Row, evaluate
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import inverse
from bmask_slam.graph.trajectory import associate, read_tum
from bmask_slam.run_folder.frame_file import STAGES, FrameTable
from bmask_slam.run_folder.reader import Run

logger = logging.getLogger(__name__)

KEYFRAME_STAGES = ("keyframe", "graph", "loops", "semantics")
TRAJECTORIES = (
    ("RGB-D SLAM v2 on freiburg1_xyz", "freiburg1_xyz-rgbdslam", "freiburg1_xyz-groundtruth"),
    ("ORB-SLAM on freiburg2_desk", "fr2_desk_ORB", "fr2_desk_groundtruth"),
)


@dataclass(frozen=True)
class Job:
    """A sequence with its name, and options that differ from the defaults."""

    sequence: str
    folder: Path
    variant: str = "default"
    options: tuple[str, ...] = ()


@dataclass(frozen=True)
class Measurement:
    """The figures of a run.

    Attributes:
        sequence, variant: of the job.
        command: as typed.
        metrics: of metrics.json, by name.
        printed: the rows of metrics.json, as the command line prints them.
        stages: (median ms, 95 % ms, number of frames that took this stage) by name.
        frames, weak, lost: of frames.csv.
        path_m: length of the reference's path during the run, 0 without a reference.
        drift_m: error of the last pose if the first one is that of the reference.
    """

    sequence: str
    variant: str
    command: str
    metrics: dict[str, float]
    printed: list[Row]
    stages: dict[str, tuple[float, float, int]]
    frames: int
    weak: int
    lost: int
    path_m: float = 0.0
    drift_m: float = 0.0
    folder: str = field(default="", compare=False)


def shown(path: Path) -> str:
    """The path relative to the repository's root."""
    path = path.resolve()
    for base, prefix in ((ROOT, ""), (ROOT.parent, "../")):
        if path.is_relative_to(base):
            return prefix + str(path.relative_to(base))
    return str(path)


def call(arguments: list[str]) -> str:
    """Run this Python with arguments from the repository's root; returns what it printed."""
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(f"error: {' '.join(arguments)} failed:\n{done.stderr.strip()[-2000:]}")
    return done.stdout


def in_own_process(work: Callable[..., dict[str, float]], *given: Any) -> dict[str, float]:
    """What a function returns in a new process; its error, or that it was killed, is raised."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(work, *given).result()


def render(folder: Path, name: str, options: tuple[str, ...] = ()) -> str:
    """Render a sequence unless it exists; returns the command."""
    command = ["render", name, *options, "--out"]
    if not (folder / "groundtruth.txt").is_file():
        logger.info("rendering %s", folder)
        call(["-m", "bmask_slam", *command, str(folder), "--quiet"])
    return f"bmask-slam {' '.join(command)} {shown(folder)}"


def measure(job: Job, work: Path) -> Measurement:
    """Run a job and read its run folder."""
    out = work / "results" / f"{job.sequence}-{job.variant}".replace(" ", "-")
    logger.info("running %s, %s", job.sequence, job.variant)
    where = [str(job.folder), "--out", str(out), "--overwrite", "--quiet"]
    options = job.options
    if "--segmenter" not in options:
        options = (*options, "--segmenter", "none")  # as the other systems
    call(["-m", "bmask_slam", "run", *where, *options])
    command = " ".join(["bmask-slam run", shown(job.folder), *options])
    return read_run(out, job, command)


def read_run(out: Path, job: Job, command: str) -> Measurement:
    """The measurement of a run folder."""
    rows = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
    frames = Run(out).frames
    path_m, drift_m = drift(out / "trajectory.txt", job.folder / "groundtruth.txt")
    return Measurement(
        sequence=job.sequence,
        variant=job.variant,
        command=command,
        metrics={row["name"]: row["value"] for row in rows},
        printed=rows,
        stages={stage: stage_times(frames, stage) for stage in STAGES},
        frames=len(frames),
        weak=frames.status.count("WEAK"),
        lost=frames.status.count("LOST"),
        path_m=path_m,
        drift_m=drift_m,
        folder=str(out),
    )


def stage_times(frames: FrameTable, stage: str) -> tuple[float, float, int]:
    """Median and 95th percentile in milliseconds, and how many frames took part.

    Stages of keyframes are counted over keyframes.
    """
    times_ms = frames.stage_ms[stage]
    if stage in KEYFRAME_STAGES:
        times_ms = times_ms[frames.keyframe_ids >= 0]
    times_ms = times_ms[np.isfinite(times_ms)]
    if not len(times_ms):
        return 0.0, 0.0, 0
    median, high = np.percentile(times_ms, (50, 95))
    return float(median), float(high), len(times_ms)


def drift(estimate_file: Path, reference_file: Path) -> tuple[float, float]:
    """Path length and error of the last pose, in metres, with the first poses made equal.

    T_error = inverse(T_reference_first_last) @ T_estimate_first_last; its translation's norm.
    """
    if not reference_file.is_file():
        return 0.0, 0.0
    estimate, reference = associate(read_tum(estimate_file), read_tum(reference_file))
    if len(estimate) < 2:
        return 0.0, 0.0
    steps = np.diff(reference.positions_world, axis=0)
    T_error = inverse(_first_last(reference.poses_world_camera)) @ _first_last(
        estimate.poses_world_camera
    )
    return float(np.linalg.norm(steps, axis=1).sum()), float(np.linalg.norm(T_error[:3, 3]))


def _first_last(poses_world_camera: Array) -> Array:
    """The last pose in the frame of the first."""
    T_first_last: Array = inverse(poses_world_camera[0]) @ poses_world_camera[-1]
    return T_first_last


def identical(a: Measurement, b: Measurement) -> bool:
    """Whether two runs wrote the same bytes of trajectory."""
    first, second = (Path(m.folder) / "trajectory.txt" for m in (a, b))
    return filecmp.cmp(first, second, shallow=False)


def published_trajectories() -> list[dict[str, float | str]]:
    """Other systems' published trajectories through our evaluation; empty without the files."""
    rows: list[dict[str, float | str]] = []
    for title, estimate, reference in TRAJECTORIES:
        file, truth = (SHARED / "trajectories" / f"{name}.txt" for name in (estimate, reference))
        if file.is_file() and truth.is_file():
            result = evaluate(file, truth)
            names = ("ate_rmse", "rpe_trans_rmse_second", "rpe_rot_rmse_second")
            values = {name: result.value(name) for name in (*names, "associated_poses")}
            rows.append({"title": title, "file": file.name, **values})
    return rows
