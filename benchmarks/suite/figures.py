"""The figure of graph growth, from the growth.csv of recorded runs."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bmask_slam.graph.arrays import Array

QUARTERS = (0.25, 0.5, 0.75, 1.0)
COLOURS = ("#1f5fa8", "#d6302a", "#3a8f4d", "#8a5fb0")


@dataclass(frozen=True)
class Growth:
    """One recorded run; every column has a value for each keyframe made, frame is its index."""

    sequence: str
    frames: int
    columns: dict[str, Array]


def read_growth(path: Path, sequence: str, frames: int) -> Growth:
    """Read growth.csv of a run over so many frames."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    columns = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    return Growth(sequence, frames, columns)


def growth_rows(growth: Growth) -> list[dict[str, float]]:
    """Sizes at the end of each quarter of the run, and the update's time during it."""
    rows, start = [], 0
    for share in QUARTERS:
        stop = int(np.searchsorted(growth.columns["frame"], share * growth.frames, side="right"))
        last = max(stop - 1, 0)
        times_ms = growth.columns["update_ms"][start:stop]
        median, high = np.percentile(times_ms, (50, 95)) if len(times_ms) else (np.nan, np.nan)
        sizes = ("keyframes", "graph_landmarks", "factors", "landmarks", "rss_mb")
        row = {name: float(growth.columns[name][last]) for name in sizes}
        row |= {"share": share, "update_median_ms": float(median), "update_p95_ms": float(high)}
        rows.append(row)
        start = stop
    return rows


def plot_growth(runs: list[Growth], path: Path) -> None:
    """Four panels over the frames of every run: factors, landmarks, keyframes, update time."""
    figure = Figure(figsize=(10, 5.6), dpi=120, layout="constrained")
    panels = (
        ("factors", "factors in the graph"),
        ("graph_landmarks", "landmarks in the graph"),
        ("keyframes", "keyframes in the graph"),
        ("update_ms", "graph update (ms)"),
    )
    axes = figure.subplots(2, 2, sharex=True).ravel()
    for axis, (column, label) in zip(axes, panels, strict=True):
        for growth, colour in zip(runs, COLOURS, strict=False):
            _draw(axis, growth, column, colour)
        axis.set_ylabel(label)
        axis.set_ylim(bottom=0)
        axis.grid(alpha=0.25, lw=0.5)
    axes[0].legend(frameon=False, fontsize=9)
    for axis in axes[2:]:
        axis.set_xlabel("frame")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def _draw(axis: Axes, growth: Growth, column: str, colour: str) -> None:
    frames, values = growth.columns["frame"], growth.columns[column]
    if column != "update_ms":
        axis.step(frames, values, where="post", color=colour, lw=1.4, label=growth.sequence)
        return
    axis.plot(frames, values, ".", color=colour, ms=3, alpha=0.4)
    width = 15
    if len(values) > width:
        middle = np.median(np.lib.stride_tricks.sliding_window_view(values, width), axis=1)
        axis.plot(frames[width // 2 : width // 2 + len(middle)], middle, color=colour, lw=1.4)
