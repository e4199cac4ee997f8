"""A small comparison with a failed cell, difficult names, and trajectories with known errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from bmask_slam.comparison.experiment.result import Cell, CellStatus, Comparison, Kind, Method
from bmask_slam.graph.trajectory import Trajectory, write_tum
from bmask_slam.reporting.drawing import SVG
from bmask_slam.reporting.parts import Picture

HOSTILE = "<script>alert('x')</script> & 50%_{\\input{a}} `|#~^"
FAILED_LOG = "first line\n" + "noise\n" * 100 + "Killed <b>here</b> & there"
CIRCLE_M, WAVE_M = 1.0, 0.05


def make_comparison(folder: Path, hostile: str = HOSTILE) -> Comparison:
    """Two sequences, a run with two seeds, an ablation that failed once, two other systems."""
    write_tum(folder / "truth.txt", circle(0.0))
    write_tum(folder / "good.txt", circle(WAVE_M))
    write_tum(folder / "bad.txt", circle(2 * WAVE_M))
    (folder / "failed.log").write_text(FAILED_LOG, encoding="utf-8")
    cells = (
        _run("one", "default", 0, 0.0111, "good.txt"),
        _run("one", "default", 1, 0.0155, "good.txt"),
        _run("one", hostile, 0, 0.0077, "bad.txt"),
        Cell("one", hostile, 1, CellStatus.FAILED, {"ate_rmse": 9.99}, log="failed.log",
             error="killed by <signal> 9"),
        Cell("one", "other", None, CellStatus.DONE, {"ate_rmse": 0.0023}, trajectory="good.txt",
             reference="truth.txt"),
        Cell("one", "paper", None, CellStatus.DONE, {"ate_rmse": 0.0034},
             source="Table 3 of X & Y"),
        _run("two_x", "default", 0, 0.0222, "good.txt"),
        Cell("two_x", "default", 1, CellStatus.PENDING),
        _run("two_x", hostile, 0, 0.0188, "bad.txt", evaluated_share=0.62),
        _run("two_x", hostile, 1, 0.0199, "missing.txt"),
    )  # fmt: skip
    methods = (
        Method("default", Kind.RUN),
        Method(hostile, Kind.RUN, "loops.enabled=false"),
        Method("other", Kind.TRAJECTORY, with_scale=True),
        Method("paper", Kind.PUBLISHED),
    )
    provenance = {"commit": "abc123def", "versions": {"numpy": "2.9.9"}, "command": "compare <x>"}
    title = "Small & <odd>"
    return Comparison("small", title, "Of $5", ("one", "two_x"), methods, cells, provenance)


def unsaved(drawn: Figure, title: str, caption: str, for_paper: bool) -> Picture:
    """In place of ``as_picture``: the fonts of a PDF take a second."""
    return Picture(title, caption, b"<svg/>", SVG, (8.0, 8.0), b"%PDF")


def circle(wave_m: float) -> Trajectory:
    """Ten seconds around a circle at 10 Hz whose height swings by ``wave_m``."""
    time_s = np.arange(100) / 10
    poses = np.tile(np.eye(4), (100, 1, 1))
    angle_rad = 2 * np.pi * time_s / 10
    poses[:, 0, 3], poses[:, 1, 3] = CIRCLE_M * np.cos(angle_rad), CIRCLE_M * np.sin(angle_rad)
    poses[:, 2, 3] = wave_m * np.sin(3 * angle_rad)
    return Trajectory(time_s, poses)


def _run(sequence: str, method: str, seed: int, ate_m: float, file: str, **more: float) -> Cell:
    metrics = {"ate_rmse": ate_m, "tracked_share": 0.987, **more}
    return Cell(
        sequence, method, seed, CellStatus.DONE, metrics, trajectory=file, reference="truth.txt"
    )
