"""Offline optimisation of a g2o file, with or without landmarks: read, optimise, write, draw."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bmask_slam.graph.arrays import Array, Ints, Mask
from bmask_slam.graph.batch.bundle_adjustment import Adjustment, adjust
from bmask_slam.graph.batch.iteration import Progress
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.whole_file import check_target
from bmask_slam.graph.g2o.landmark_graphs import write_landmark_graph
from bmask_slam.graph.g2o.landmark_reader import read_landmark_graph
from bmask_slam.graph.g2o.pose_graphs import read_g2o, write_g2o
from bmask_slam.graph.pose_graph.certificate import Certificate, certify, check_certifiable
from bmask_slam.graph.pose_graph.optimisation import (
    Method,
    PoseGraphConfig,
    PoseGraphResult,
    optimise_pose_graph,
)
from bmask_slam.graph.pose_graph.pose_graph import PoseGraph
from bmask_slam.refinement.adjustment_plot import (
    GraphSnapshot,
    View,
    check_picture,
    draw_adjustment,
    draw_before_after,
)


@dataclass(frozen=True)
class GraphOptions:
    """How a pose graph is optimised.

    Attributes:
        repair: take the nearest positive definite information matrices where a file's are not.
        certify: say whether the optimum is the global one, by Shonan averaging; 3-D only.
        plot: the picture before and after.
    """

    method: Method = "lm"
    repair: bool = False
    certify: bool = False
    plot: Path | None = None


def optimise_file(
    file: Path,
    out: Path,
    options: GraphOptions | None = None,
    progress: Progress = lambda iteration, cost: None,
) -> tuple[PoseGraphResult, Certificate | None]:
    """Optimise a g2o file and write the graph, without its outlier edges, to ``out``.

    If certified rotations lead to a lower cost, that solution is the result.

    Raises:
        InputError: the output's folder is not there, the output is the input, the type of the
            picture is not known, or ``read_g2o`` or the solver refuses the file.
    """
    options = options or GraphOptions()
    _check_paths(file, out, options.plot)
    graph, certificate = read_g2o(file, options.repair), None
    try:
        if options.certify:
            check_certifiable(graph)
        result = optimise_pose_graph(graph, PoseGraphConfig(method=options.method), progress)
        if options.certify:
            certificate = certify(result)
            result = _better(result, certificate)
    except InputError as error:
        raise InputError(f"{file}: {error}") from error
    write_g2o(out, result.graph.with_edges(~result.is_outlier))
    if options.plot is not None:
        _draw(result, options.plot)
    return result, certificate


def _check_paths(file: Path, out: Path, plot: Path | None) -> None:
    """Raise InputError for outputs that cannot be written, or would replace the input."""
    check_target(out)
    if plot is not None:
        check_picture(plot)
    for target in filter(None, (out, plot)):
        if target.resolve() == file.resolve():
            raise InputError(f"{target}: is the input, which stays as it is; choose another --out")


def _better(result: PoseGraphResult, certificate: Certificate) -> PoseGraphResult:
    if certificate.status != "not global" or certificate.poses is None:
        return result
    graph = result.graph.with_poses(certificate.poses)
    return replace(result, graph=graph, final_cost=certificate.cost)


def adjust_file(
    file: Path,
    out: Path,
    plot: Path | None = None,
    repair: bool = False,
    progress: Progress = lambda iteration, cost: None,
) -> tuple[Adjustment, GraphSnapshot]:
    """Adjust the graph with landmarks of a g2o file and write it, without outliers, to ``out``.

    Raises:
        InputError: as ``optimise_file``.
    """
    _check_paths(file, out, plot)
    tables, camera = read_landmark_graph(file, repair=repair)
    before = GraphSnapshot.of(tables)
    try:
        adjustment = adjust(tables, camera, progress=progress)
    except InputError as error:
        raise InputError(f"{file}: {error}") from error
    after = GraphSnapshot.of(tables)
    write_landmark_graph(out, tables, camera)
    if plot is not None:
        draw_adjustment(plot, before, after, adjustment)
    return adjustment, after


def format_result(result: PoseGraphResult, certificate: Certificate | None = None) -> str:
    """A few lines: the graph, the initial value, costs, outliers, and the certificate."""
    graph, outliers = result.graph, f"{result.is_outlier.sum()} edges, left out of the output"
    rows = [
        ("vertices", f"{len(graph.ids)} ({'2-D' if graph.is_planar else '3-D'})"),
        ("edges", f"{len(graph.edges)} ({np.sum(~graph.is_odometry)} between non-consecutive ids)"),
        ("method", result.method),
        ("cost before", f"{result.given_cost:.6g} ({result.given})"),
        ("initial value", result.start),
        ("initial cost", f"{result.initial_cost:.6g}"),
        ("final cost", f"{result.final_cost:.6g}"),
        *([("outliers", outliers)] if result.method == "gnc" else []),
        ("iterations", str(result.iterations)),
        ("time", f"{result.duration_ms:.0f} ms"),
    ]
    if certificate is not None:
        rows.append(("certificate", _describe(certificate)))
    return "\n".join(f"{name:15}{value}" for name, value in rows)


def _describe(certificate: Certificate) -> str:
    if certificate.poses is None:
        return "undecided: no rotations could be certified"
    text = {
        "global": "global optimum: certified rotations lead to the same cost",
        "not global": "was a local optimum: certified rotations lead to this lower cost",
        "undecided": f"undecided: certified rotations lead to the cost {certificate.cost:.6g}",
    }[certificate.status]
    return f"{text} (smallest eigenvalue {certificate.smallest_eigenvalue:.2g})"


def _draw(result: PoseGraphResult, path: Path) -> None:
    """Draw the graph at the given poses (or the odometry) and at the optimised ones.

    Odometry is blue, loops are grey, and outliers are red and only in the left picture. A 3-D graph
    is drawn from above when it is nearly flat, else in perspective.
    """
    graph = result.graph
    spatial = not graph.is_planar and not _is_flat(graph.poses[:, :3, 3])
    columns = slice(3 if spatial else 2)
    before = f"before ({result.given}), cost {result.given_cost:.5g}"
    after = f"after ({result.method}), cost {result.final_cost:.5g}"
    edges = _edges(graph, result.is_outlier)
    draw_before_after(
        path,
        View(before, result.given_poses[:, columns, 3], edges),
        View(after, graph.poses[:, columns, 3], [edges[0], edges[2]]),
    )


def _is_flat(points: Array) -> bool:
    """Whether the extent in z is less than a tenth of that in x and y."""
    extent_m = np.ptp(points, axis=0)
    return bool(extent_m[2] < 0.1 * extent_m[:2].max())


def _edges(graph: PoseGraph, is_outlier: Mask) -> list[tuple[Ints, str, float]]:
    """Loops, outliers and odometry, with colours and widths."""
    odometry = graph.is_odometry
    return [
        (graph.edges[~odometry & ~is_outlier], "0.7", 0.4),
        (graph.edges[is_outlier], "tab:red", 0.4),
        (graph.edges[odometry], "tab:blue", 0.9),
    ]
