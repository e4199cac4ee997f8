"""The picture of a real sequence: its path against the truth, errors and status over time."""

from __future__ import annotations

from dataclasses import dataclass
from io import BytesIO
from itertools import groupby
from pathlib import Path

import numpy as np
import PIL.Image
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bmask_slam.evaluation.plot import DIFFERENCE, draw_top_view
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.hand_eye import body_trajectory, hand_eye
from bmask_slam.graph.metrics import AbsoluteError, absolute_error
from bmask_slam.graph.trajectory import Trajectory, associate, read_tum
from bmask_slam.run_folder.reader import Run

STATUS_COLOURS = {"WEAK": "#e8b54a", "LOST": "#8a2be2"}
OTHER_COLOURS = ("#1f77b4", "#3a8f4d", "#7fbf7b", "#5b5b9f", "#9e9ac8")
FLOOR_MM = 0.1
LEGEND_SHARE = 0.3
"""Room above the curves, of their height."""


@dataclass(frozen=True)
class Pictured:
    """What is drawn.

    Attributes:
        title: above the picture.
        run: the run's folder.
        truth: the sequence with groundtruth.txt.
        others: trajectory files of other systems by name.
        hand_eye: the truth is of another body.
    """

    title: str
    run: Path
    truth: Path
    others: dict[str, Path]
    hand_eye: bool


def draw_sequence(wanted: Pictured, path: Path) -> None:
    """Write the picture."""
    truth = read_tum(wanted.truth / "groundtruth.txt")
    estimate, error = _compared(wanted.run / "trajectory.txt", truth, wanted.hand_eye)
    figure = Figure(figsize=(11, 5.0), dpi=100, layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(0.9, 1.1))
    _, reference = associate(estimate, truth)
    aligned = error.alignment.apply(estimate)
    draw_top_view(figure.add_subplot(grid[:, 0]), aligned, truth, (error.aligned, reference))
    own, beside = figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, 1])
    frames = Run(wanted.run).frames
    stamps_s = frames.timestamps_s
    begin_s = stamps_s[0]
    _draw_own(own, error, begin_s)
    _draw_status(own, stamps_s - begin_s, frames.status)
    beside.plot(*_over_time(error, begin_s), color=DIFFERENCE, lw=1.4, label="bmask-slam")
    for (name, file), colour in zip(wanted.others.items(), OTHER_COLOURS, strict=False):
        _, other = _compared(file, truth, wanted.hand_eye)
        beside.plot(*_over_time(other, begin_s), color=colour, lw=0.9, label=name)
    beside.set_yscale("log")
    beside.set_ylabel("position error (mm, log)")
    beside.set_xlabel("time (s)")
    beside.grid(alpha=0.25, lw=0.5)
    low_mm, high_mm = beside.get_ylim()
    beside.set_ylim(low_mm, high_mm * (high_mm / low_mm) ** LEGEND_SHARE)
    beside.legend(frameon=False, fontsize=7.5, loc="upper left", ncols=3)
    for axes in (own, beside):
        axes.set_xlim(0, stamps_s[-1] - begin_s)
    where = ", truth at the place found by hand-eye" if wanted.hand_eye else ""
    rmse_mm = 1e3 * error.translation_m.rmse
    figure.suptitle(f"{wanted.title}: ATE RMSE {rmse_mm:.1f} mm{where}", fontsize=11)
    path.parent.mkdir(parents=True, exist_ok=True)
    buffer = BytesIO()
    figure.savefig(buffer, format="png")
    with PIL.Image.open(buffer) as picture:  # a palette makes the file a third as large
        picture.convert("RGB").quantize(256).save(path, optimize=True)


def _compared(file: Path, truth: Trajectory, with_body: bool) -> tuple[Trajectory, AbsoluteError]:
    """An estimate, as the path of the truth's body where that is another, and its errors."""
    estimate = read_tum(file)
    if with_body:
        estimate = body_trajectory(estimate, hand_eye(*associate(estimate, truth)))
    return estimate, absolute_error(*associate(estimate, truth))


def _over_time(error: AbsoluteError, begin_s: float) -> tuple[Array, Array]:
    """Seconds and position errors in mm, with a NaN wherever poses are missing."""
    time_s = error.aligned.timestamps_s - begin_s
    error_mm = np.maximum(1e3 * error.translation_m.errors, FLOOR_MM)
    steps_s = np.diff(time_s)
    gaps = np.flatnonzero(steps_s > 5 * np.median(steps_s)) + 1
    return np.insert(time_s, gaps, np.nan), np.insert(error_mm, gaps, np.nan)


def _draw_own(axes: Axes, error: AbsoluteError, begin_s: float) -> None:
    time_s, error_mm = _over_time(error, begin_s)
    axes.plot(time_s, error_mm, color=DIFFERENCE, lw=1.0, label="bmask-slam")
    rmse_mm = 1e3 * error.translation_m.rmse
    axes.axhline(rmse_mm, color="black", lw=0.8, ls="--", label=f"RMSE {rmse_mm:.1f} mm")
    axes.set_ylim(0, 1.35 * np.nanmax(error_mm))
    axes.set_ylabel("position error (mm)")
    axes.tick_params(labelbottom=False)
    axes.grid(alpha=0.25, lw=0.5)


def _draw_status(axes: Axes, time_s: Array, status: tuple[str, ...]) -> None:
    """Shade where frames are WEAK or LOST, and say how many there are."""
    for wanted, colour in STATUS_COLOURS.items():
        axes.axvspan(0, 0, color=colour, alpha=0.5, lw=0,
                     label=f"{wanted}: {status.count(wanted)} frames")  # fmt: skip
    half_s = 0.5 * float(np.median(np.diff(time_s)))
    for value, group in groupby(range(len(status)), status.__getitem__):
        if value in STATUS_COLOURS:
            frames = list(group)
            span = time_s[frames[0]] - half_s, time_s[frames[-1]] + half_s
            axes.axvspan(*span, color=STATUS_COLOURS[value], alpha=0.5, lw=0)
    axes.legend(frameon=False, fontsize=7.5, loc="upper left", ncols=4, columnspacing=1.0)
