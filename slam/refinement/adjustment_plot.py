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
from bmask_slam.graph.factors.observability import component_labels, shared_landmarks
from bmask_slam.graph.files.whole_file import check_target, whole_file

PICTURE_TYPES = (".png", ".pdf", ".svg")


@dataclass(frozen=True, eq=False)
class GraphSnapshot:
    """A copy of a graph's keyframes (K) and landmarks (L), and the ends (N, 2) of its loops.

    Attributes:
        path: (M, 2) rows of keyframes that follow each other and share landmarks: what the camera
            passed between. Not where it was lost, nor where another recording begins.
        part: rows of the keyframes in the largest part of the graph. Other parts, as map segments
            that were never joined, have worlds of their own; what observes nothing is in none.
        cloud: rows of the landmarks that these keyframes observe.
    """

    keyframe_ids: Ints
    poses_world_camera: Array
    landmark_ids: Ints
    points_world: Array
    loops: Ints
    path: Ints
    part: Ints
    cloud: Ints

    @classmethod
    def of(cls, tables: FactorTables) -> GraphSnapshot:
        """The graph as it is now."""
        keyframes, landmarks = tables.keyframes, tables.landmarks
        ids, seen = keyframes.ids.copy(), tables.observations.all()
        linked = np.flatnonzero(shared_landmarks(ids, seen).diagonal(1))
        edges = [entry.keyframes for entry in tables.pose_factors.values()]
        parts, observing = component_labels(ids, seen, edges), np.isin(ids, seen.keyframe_ids)
        largest = np.bincount(parts[observing], minlength=1).argmax()
        part = np.flatnonzero(observing & (parts == largest))
        observed = seen.landmark_ids[np.isin(seen.keyframe_ids, ids[part])]
        return cls(
            ids,
            keyframes.values.copy(),
            landmarks.ids.copy(),
            landmarks.values.copy(),
            loop_edges(tables),
            linked[:, None] + np.array([0, 1]),
            part,
            np.flatnonzero(np.isin(landmarks.ids, observed)),
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
    """Draw path, loops (wrong ones red) and landmarks, seen along the axis of least motion.

    Of a graph in parts, each with a world of its own, the largest one.
    """
    part = before.part if len(before.part) else np.arange(len(before.keyframe_ids))
    ids, cloud = before.keyframe_ids[part], before.landmark_ids[before.cloud]
    plane = view_plane(after.poses_world_camera[part, :3, 3])
    views = []
    for state, cost, title in (
        (before, adjustment.initial_cost, "before"),
        (after, adjustment.final_cost, "after"),
    ):
        edges = [(_rows(ids, before.keyframe_ids[before.path]), "tab:blue", 0.9)]
        edges += [(_rows(ids, state.loops), "tab:green", 0.6)]
        edges += [(_rows(ids, adjustment.wrong_loops), "tab:red", 0.6)] if state is before else []
        positions = state.poses_world_camera[part, :3, 3][:, plane]
        points = state.points_world[np.isin(state.landmark_ids, cloud)][:, plane]
        axes = "".join("xyz"[k] for k in plane)
        views.append(View(f"{title}, cost {cost:.5g}", positions, edges, points, axes))
    draw_before_after(path, *views)


def _rows(ids: Ints, edges: Ints) -> Ints:
    """Rows (M, 2) among the sorted ids of the edges (N, 2) that are between two of them."""
    edges = np.asarray(edges, np.int64).reshape(-1, 2)
    return np.searchsorted(ids, edges[np.isin(edges, ids).all(axis=1)])


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
