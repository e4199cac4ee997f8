"""Offline optimisation of a pose graph file: read, optimise, write, draw."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection  # type: ignore[import-untyped]
from tqdm import tqdm

from graph.errors import InputError
from graph.g2o import read_g2o, write_g2o
from graph.geometry import Array
from graph.pose_graph import Mask, PoseGraph
from graph.pose_graph_optimisation import (
    Method,
    PoseGraphConfig,
    PoseGraphResult,
    optimise_pose_graph,
)

PICTURE_TYPES = (".png", ".pdf", ".svg")


def optimise_file(
    file: Path, out: Path, method: Method = "lm", plot: Path | None = None, quiet: bool = False
) -> PoseGraphResult:
    """Optimise a g2o file and write the graph, without the edges found wrong, to ``out``.

    Raises:
        InputError: a run folder, an output whose folder is not there, a picture of a type that is
            not known, or a file that ``read_g2o`` or the solver refuses.
    """
    if file.is_dir():
        raise InputError(
            f"{file}: run folders are not supported yet; give a pose graph, a g2o file"
        )
    _check_outputs(out, plot)
    graph = read_g2o(file)
    with tqdm(unit="step", disable=quiet or not sys.stderr.isatty()) as bar:
        try:
            result = optimise_pose_graph(graph, PoseGraphConfig(method=method), _shown_on(bar))
        except InputError as error:
            raise InputError(f"{file}: {error}") from error
    write_g2o(out, result.graph.with_edges(~result.is_outlier))
    if plot is not None:
        draw_before_after(result, plot)
    return result


def _check_outputs(out: Path, plot: Path | None) -> None:
    """What would fail after the work is refused before it."""
    for path in (out, plot):
        if path is not None and not path.parent.is_dir():
            raise InputError(f"{path}: the folder {path.parent} is not there; make it first")
        if path is not None and path.is_dir():
            raise InputError(f"{path}: a folder; give the name of a file to write")
    if plot is not None and plot.suffix.lower() not in PICTURE_TYPES:
        raise InputError(f"{plot}: cannot draw {plot.suffix!r}; use {', '.join(PICTURE_TYPES)}")


def _shown_on(bar: tqdm) -> Callable[[int, float], None]:
    def show(iteration: int, cost: float) -> None:
        bar.set_postfix_str(f"cost {cost:.6g}", refresh=False)
        bar.update(iteration - bar.n)

    return show


def format_result(result: PoseGraphResult) -> str:
    """A few lines on what was optimised, from where, and how it ended."""
    graph = result.graph
    rows = [
        ("vertices", f"{len(graph.ids)} ({'2-D' if graph.is_planar else '3-D'})"),
        ("edges", f"{len(graph.edges)} ({np.sum(~graph.is_odometry)} between non-consecutive ids)"),
        ("method", result.method),
        ("cost before", f"{result.given_cost:.6g} ({result.given})"),
        ("initial value", result.start),
        ("initial cost", f"{result.initial_cost:.6g}"),
        ("final cost", f"{result.final_cost:.6g}"),
        ("iterations", str(result.iterations)),
        ("time", f"{result.duration_ms:.0f} ms"),
    ]
    if result.method == "gnc":
        rows.insert(7, ("outliers", f"{result.is_outlier.sum()} edges, left out of the output"))
    return "\n".join(f"{name:15}{value}" for name, value in rows)


# --- picture -------------------------------------------------------------------------------------


def draw_before_after(result: PoseGraphResult, path: Path) -> None:
    """Draw the graph at the poses given (or the odometry) and at the optimised ones.

    Odometry is blue, loops are grey, and those found wrong are red, in the left picture alone. A
    3-D graph is seen from above when it is nearly flat, else in perspective.
    """
    graph = result.graph
    spatial = not graph.is_planar and not _is_flat(graph.poses[:, :3, 3])
    figure = Figure(figsize=(12, 6), layout="constrained")
    FigureCanvasAgg(figure)
    none = np.zeros(len(graph.edges), bool)
    views = (
        (f"before ({result.given}), cost {result.given_cost:.5g}", result.given_poses, none),
        (f"after ({result.method}), cost {result.final_cost:.5g}", graph.poses, result.is_outlier),
    )
    for k, (title, poses, hidden) in enumerate(views, start=1):
        axes = figure.add_subplot(1, 2, k, projection="3d" if spatial else None)
        axes.set_title(title)
        _draw(axes, graph, poses[:, : 3 if spatial else 2, 3], result.is_outlier, hidden)
    figure.savefig(path, dpi=150)


def _is_flat(points: Array) -> bool:
    """Whether the extent in z is less than a tenth of that in x and y."""
    extent_m = np.ptp(points, axis=0)
    return bool(extent_m[2] < 0.1 * extent_m[:2].max())


def _draw(axes: Any, graph: PoseGraph, points: Array, is_outlier: Mask, hidden: Mask) -> None:
    """Edges between points (N, 2 or 3) in metres."""
    lines: Any = LineCollection if points.shape[1] == 2 else Line3DCollection
    odometry = graph.is_odometry
    kinds = (
        (~odometry & ~is_outlier, "0.7", 0.4),
        (is_outlier & ~hidden, "tab:red", 0.4),
        (odometry, "tab:blue", 0.9),
    )
    for mask, colour, width in kinds:
        segments = points[graph.edges[mask]]
        if len(segments):
            axes.add_collection(lines(segments, colors=colour, linewidths=width))
    low, high = points.min(axis=0), points.max(axis=0)
    centre, half = (low + high) / 2, 0.55 * max(float(np.max(high - low)), 1e-3)
    for name, middle in zip("xyz", centre, strict=False):
        getattr(axes, f"set_{name}lim")(middle - half, middle + half)
        getattr(axes, f"set_{name}label")(f"{name} [m]")
    axes.set_aspect("equal")
