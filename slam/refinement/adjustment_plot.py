"""The picture of an optimisation: the graph before and after it, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection  # type: ignore[import-untyped]

from bmask_slam.evaluation.plot import view_plane
from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.batch.bundle_adjustment import Adjustment, loop_edges
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.files.whole_file import check_target, whole_file

PICTURE_TYPES = (".png", ".pdf", ".svg")


@dataclass(frozen=True, eq=False)
class GraphSnapshot:
    """A copy of a graph's keyframes (K) and landmarks (L), and the ends (N, 2) of its loops."""

    keyframe_ids: Ints
    poses_world_camera: Array
    landmark_ids: Ints
    points_world: Array
    loops: Ints

    @classmethod
    def of(cls, tables: FactorTables) -> GraphSnapshot:
        """The graph as it is now."""
        keyframes, landmarks = tables.keyframes, tables.landmarks
        return cls(
            keyframes.ids.copy(),
            keyframes.values.copy(),
            landmarks.ids.copy(),
            landmarks.values.copy(),
            loop_edges(tables),
        )


@dataclass(frozen=True, eq=False)
class View:
    """One half of the picture.

    Attributes:
        title: above it.
        points: (N, 2 or 3) in metres, the ends of the edges.
        edges: rows (M, 2) into the points, with colour and width, drawn in this order.
        cloud: (L, 2 or 3) in metres, dots behind the edges.
        axes: names of the columns.
    """

    title: str
    points: Array
    edges: Sequence[tuple[Ints, str, float]]
    cloud: Array = field(default_factory=lambda: np.zeros((0, 2)))
    axes: str = "xyz"


def check_picture(path: Path) -> None:
    """Raises InputError if a picture could not be written there, before the work is done."""
    check_target(path)
    if path.suffix.lower() not in PICTURE_TYPES:
        raise InputError(f"{path}: cannot draw {path.suffix!r}; use {', '.join(PICTURE_TYPES)}")


def draw_before_after(path: Path, before: View, after: View) -> None:
    """Write the picture; it appears whole or not at all."""
    figure = Figure(figsize=(12, 6), layout="compressed")  # squares, with room for titles
    FigureCanvasAgg(figure)
    for k, view in enumerate((before, after), start=1):
        projection = "3d" if view.points.shape[1] == 3 else None
        axes = figure.add_subplot(1, 2, k, projection=projection)
        axes.set_title(view.title)
        _draw(axes, view)
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=150, format=path.suffix[1:].lower())


def draw_adjustment(
    path: Path, before: GraphSnapshot, after: GraphSnapshot, adjustment: Adjustment
) -> None:
    """Draw path, loops (wrong ones red) and landmarks, seen along the axis of least motion."""
    plane = view_plane(after.poses_world_camera[:, :3, 3])
    ends = np.arange(len(before.keyframe_ids))
    path_edges = np.stack([ends[:-1], ends[1:]], axis=1)
    views = []
    for state, cost, title in (
        (before, adjustment.initial_cost, "before"),
        (after, adjustment.final_cost, "after"),
    ):
        loops = np.searchsorted(before.keyframe_ids, state.loops)
        wrong = np.searchsorted(before.keyframe_ids, adjustment.wrong_loops)
        edges = [(path_edges, "tab:blue", 0.9), (loops, "tab:green", 0.6)]
        edges += [(wrong, "tab:red", 0.6)] if state is before else []
        positions = state.poses_world_camera[:, :3, 3][:, plane]
        cloud, axes = state.points_world[:, plane], "".join("xyz"[k] for k in plane)
        views.append(View(f"{title}, cost {cost:.5g}", positions, edges, cloud, axes))
    draw_before_after(path, *views)


def _draw(axes: Any, view: View) -> None:
    points = view.points
    lines: Any = LineCollection if points.shape[1] == 2 else Line3DCollection
    if len(view.cloud):
        axes.scatter(*view.cloud.T, s=0.6, color="0.6", linewidths=0)
    for edges, colour, width in view.edges:
        if len(edges):
            axes.add_collection(lines(points[edges], colors=colour, linewidths=width))
    shown = np.vstack([points, view.cloud]) if len(view.cloud) else points
    low, high = np.percentile(shown, (0, 100) if shown is points else (1, 99), axis=0)
    low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
    centre, half = (low + high) / 2, 0.55 * max(float(np.max(high - low)), 1e-3)
    count = len(centre)
    for name, label, middle in zip("xyz"[:count], view.axes[:count], centre, strict=True):
        getattr(axes, f"set_{name}lim")(middle - half, middle + half)
        getattr(axes, f"set_{name}label")(f"{label} [m]")
    axes.set_aspect("equal")
