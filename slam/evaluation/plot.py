"""The plot of a run: top view against the reference, errors over time (paper figs. 10, 11)."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from bmask_slam.events import Event, EventKind
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.whole_file import whole_file
from bmask_slam.graph.metrics import AbsoluteError, absolute_error
from bmask_slam.graph.trajectory import (
    GAP_STEPS,
    Trajectory,
    associate,
    nearest_indices,
    rows_after_gaps,
)

ESTIMATE, REFERENCE, DIFFERENCE = "#1f5fa8", "#9a9a96", "#d6302a"
MARGINS = {"left": 0.075, "right": 0.985, "bottom": 0.105, "top": 0.915}
"""Of the plot; a layout that measures all of its text takes half of the time of drawing it."""
FORMATS = ("png", "pdf", "svg")
MARKS = {
    EventKind.LOOP_REFUSED: ("x", "#8a8a86", 3.0),
    EventKind.LOOP_CLOSED: ("o", "#7b3fa0", 5.0),
    EventKind.LOOP_REMOVED: ("X", "#7b3fa0", 5.0),
    EventKind.JOINED: ("D", "#1b8a5a", 6.0),
    EventKind.SEGMENT: ("s", "#e08a00", 6.0),
    EventKind.FOUND: ("^", "#1b8a5a", 6.5),
    EventKind.LOST: ("v", "#b0151b", 6.5),
    EventKind.CALIBRATION: ("*", "#e08a00", 9.0),
}
"""Symbol, colour and size in points of the events that the top view shows, the lowest first."""
PNG_OPTIONS: dict[str, Any] = {"pil_kwargs": {"compress_type": zlib.Z_RLE}}
"""Half the time of the default, for 3 % more bytes."""


def plot_trajectory(
    path: Path,
    estimate: Trajectory,
    reference: Trajectory | None,
    title: str,
    events: Sequence[Event] = (),
    with_scale: bool = False,
) -> None:
    """Write the plot in the format of its suffix; the file appears whole or not at all.

    Without a reference, or with fewer than three associated poses, only the top view is drawn, in
    the estimate's own world frame. Events are marked in it.

    Raises:
        InputError: the folder does not exist, or the suffix is not in FORMATS.
    """
    path, form = Path(path), Path(path).suffix[1:].lower()
    if not path.parent.is_dir():
        raise InputError(f"{path}: no such folder for the picture; make it first")
    if form not in FORMATS:
        raise InputError(f"{path}: unknown suffix {path.suffix!r}; use .png, .pdf or .svg")
    matched, truth = associate(estimate, reference) if reference is not None else (estimate, None)
    if truth is None or len(truth) < 3:
        figure = Figure(figsize=(6.4, 5.6), dpi=150)
        grid = figure.add_gridspec(1, 1, left=0.13, right=0.98, bottom=0.1, top=0.92)
        top_view, aligned = figure.add_subplot(grid[0]), estimate
        draw_top_view(top_view, estimate)
    else:
        error = absolute_error(matched, truth, with_scale)
        figure = Figure(figsize=(11, 5.2), dpi=150)
        grid = figure.add_gridspec(2, 2, width_ratios=(1.1, 1), wspace=0.18, hspace=0.08, **MARGINS)
        top_view, aligned = figure.add_subplot(grid[:, 0]), error.alignment.apply(estimate)
        draw_top_view(top_view, aligned, reference, (error.aligned, truth))
        draw_errors([figure.add_subplot(grid[k, 1]) for k in range(2)], error)
        rmse_cm = 100 * error.translation_m.rmse
        title = f"{title}: ATE RMSE {rmse_cm:.2f} cm over {len(matched)} poses"
    draw_events(top_view, events, aligned, reference)
    figure.suptitle(title, fontsize=11)
    with whole_file(path) as temporary:
        figure.savefig(temporary, format=form, **(PNG_OPTIONS if form == "png" else {}))


def draw_top_view(
    axes: Axes,
    estimate: Trajectory,
    reference: Trajectory | None = None,
    matched: tuple[Trajectory, Trajectory] | None = None,
    joined_by: str = "difference",
) -> None:
    """Draw the plane of the two axes in which the camera moved most, both in one world frame.

    ``matched`` are associated poses of estimate and reference; red lines join them, with
    ``joined_by`` as their entry in the legend.
    """
    plane = _view_plane_of(estimate, reference)
    if reference is not None:
        within = _same_time(reference, estimate)
        shown = path_with_gaps(within)[:, plane].T
        axes.plot(*shown, color=REFERENCE, lw=2.2, label="reference", zorder=2)
    if matched is not None:
        ends = np.stack([pose.positions_world[:, plane] for pose in matched], axis=1)
        axes.add_collection(LineCollection(list(ends), colors=DIFFERENCE, linewidths=0.5, zorder=1))
        axes.plot([], [], color=DIFFERENCE, lw=0.8, label=joined_by)
    found = path_with_gaps(estimate)[:, plane].T
    axes.plot(*found, color=ESTIMATE, lw=1.1, label="estimate", zorder=3)
    start = estimate.positions_world[:1, plane]
    axes.plot(*start.T, "o", color=ESTIMATE, ms=5, label="start", zorder=4)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"{'xyz'[plane[0]]} (m)")
    axes.set_ylabel(f"{'xyz'[plane[1]]} (m)")
    axes.grid(alpha=0.25, lw=0.5)
    axes.legend(frameon=False, fontsize=8, loc="best")


def draw_events(
    axes: Axes, events: Sequence[Event], estimate: Trajectory, reference: Trajectory | None = None
) -> None:
    """Mark events in a top view of the same trajectories, and count each kind in its legend.

    An event is where the pose next to it in time is; it is only counted if there is none near.
    """
    plane = _view_plane_of(estimate, reference)
    near_s = (
        GAP_STEPS * float(np.median(np.diff(estimate.timestamps_s))) if len(estimate) > 1 else 0.0
    )
    for height, (kind, (symbol, colour, size)) in enumerate(MARKS.items()):
        stamps_s = np.array([event.timestamp_s for event in events if event.kind is kind])
        if kind is EventKind.SEGMENT:  # the one that begins at the start is marked as such
            stamps_s = stamps_s[~np.isin(stamps_s.round(6), estimate.timestamps_s[:1].round(6))]
        if not len(stamps_s):
            continue
        points = np.zeros((0, 2))
        if len(estimate):
            rows = nearest_indices(estimate.timestamps_s, stamps_s)
            rows = rows[np.abs(estimate.timestamps_s[rows] - stamps_s) <= near_s]
            points = estimate.positions_world[rows][:, plane]
        axes.plot(
            *points.T,
            symbol,
            color=colour,
            ms=size,
            mew=0.8,
            mfc="none" if kind is EventKind.LOOP_CLOSED else colour,
            zorder=5 + height,
            label=f"{kind.value} ({len(stamps_s)})",
        )
    axes.legend(frameon=False, fontsize=8, loc="best")


def draw_errors(axes: list[Axes], error: AbsoluteError) -> None:
    """Draw translation and rotation error over time, each with its RMSE."""
    time_s = error.aligned.timestamps_s - error.aligned.timestamps_s[0]
    rows = (
        (axes[0], 100.0, error.translation_m, "translation error (cm)"),
        (axes[1], 180 / np.pi, error.rotation_rad, "rotation error (deg)"),
    )
    for axis, factor, statistics, label in rows:
        rmse = factor * statistics.rmse
        axis.plot(
            *_with_gaps(time_s, factor * statistics.errors[:, None]).T, color=DIFFERENCE, lw=0.7
        )
        axis.axhline(rmse, color="black", lw=0.8, ls="--", label=f"RMSE {rmse:.2f}")
        axis.set_ylabel(label)
        axis.set_xlim(0, max(time_s[-1], 1e-3))
        axis.set_ylim(0, 1.25 * factor * statistics.max + 1e-3)  # room for the legend
        axis.grid(alpha=0.25, lw=0.5)
        axis.legend(frameon=False, fontsize=8, loc="upper right")
    axes[0].tick_params(labelbottom=False)
    axes[1].set_xlabel("time (s)")


def _view_plane_of(estimate: Trajectory, reference: Trajectory | None) -> list[int]:
    return view_plane((estimate if reference is None else reference).positions_world)


def view_plane(positions_world: Array) -> list[int]:
    """The two axes of largest extent of positions (N, 3), in the order x, y, z."""
    if not len(positions_world):
        return [0, 2]
    extent_m = np.ptp(positions_world, axis=0)
    return sorted(np.argsort(-extent_m, kind="stable")[:2].tolist())


def _same_time(reference: Trajectory, estimate: Trajectory) -> Trajectory:
    """The reference within the estimate's span, a second more on both sides."""
    first_s, last_s = estimate.timestamps_s[[0, -1]]
    stamps_s = reference.timestamps_s
    return reference.select((stamps_s >= first_s - 1) & (stamps_s <= last_s + 1))


def path_with_gaps(trajectory: Trajectory) -> Array:
    """Positions (M, 3) in metres with a row of NaN wherever the trajectory has a gap."""
    return _with_gaps(trajectory.timestamps_s, trajectory.positions_world)[:, 1:]


def _with_gaps(timestamps_s: Array, values: Array) -> Array:
    """Columns (stamp, values...) with a row of NaN in each gap, so that no line crosses it."""
    rows = np.column_stack([timestamps_s, values])
    return np.insert(rows, rows_after_gaps(timestamps_s), np.nan, axis=0)
