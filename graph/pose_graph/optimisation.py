"""Optimising a pose graph offline: Levenberg-Marquardt, dogleg, or robustly with GNC.

The cost is GTSAM's: half the sum of ``r^T Omega r``, with r the tangent of ``inverse(measurement) @
inverse(T_world_i) @ T_world_j``.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bmask_slam.graph.arrays import Array, Mask
from bmask_slam.graph.batch.iteration import Progress
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.pose_graph.chordal import chordal_poses
from bmask_slam.graph.pose_graph.factors import edge_chi_squares
from bmask_slam.graph.pose_graph.gnc import find_wrong_loops
from bmask_slam.graph.pose_graph.loop_consistency import loop_consistency
from bmask_slam.graph.pose_graph.pose_graph import PoseGraph, is_connected, spanning_tree_poses
from bmask_slam.graph.pose_graph.solver import Descent, Method, PoseGraphConfig, PoseGraphSolver

RACE_STEPS = 3
FAR = 10.0  # of the chordal start's cost

__all__ = ["Method", "PoseGraphConfig", "PoseGraphResult", "optimise_pose_graph"]


@dataclass(frozen=True, eq=False)
class PoseGraphResult:
    """An optimised graph and how it was reached.

    Attributes:
        graph: the input with the optimised poses, all edges still in it.
        given: source of the poses before: file, or odometry if the file has none.
        given_poses: (N, 4, 4) those, and given_cost their cost.
        start: the initial value that was taken: file, odometry or chordal.
        initial_cost, final_cost: from there to the end, the latter without the outliers.
        iterations: solver steps altogether.
        is_outlier: (M,) bool, edges that GNC found wrong; never an odometry edge.
        duration_ms: wall time without reading and writing.
    """

    graph: PoseGraph
    method: Method
    given: str
    given_poses: Array
    given_cost: float
    start: str
    initial_cost: float
    final_cost: float
    iterations: int
    is_outlier: Mask
    duration_ms: float = 0.0


def optimise_pose_graph(
    graph: PoseGraph,
    config: PoseGraphConfig | None = None,
    progress: Progress = lambda iteration, cost: None,
) -> PoseGraphResult:
    """Optimise a connected pose graph from the best available initial value.

    The gauge is fixed by the fixed vertices, or by the first if there is none.

    Raises:
        InputError: the graph cannot be solved, with GTSAM's reason.
    """
    config = config or PoseGraphConfig()
    begin_s = time.perf_counter()
    try:
        result = _optimise(graph, config, PoseGraphSolver(graph, config, progress))
    except (RuntimeError, np.linalg.LinAlgError) as error:  # GTSAM's all arrive as the first
        raise InputError(f"the pose graph cannot be solved: {error}") from error
    return replace(result, duration_ms=1e3 * (time.perf_counter() - begin_s))


def _optimise(
    graph: PoseGraph, config: PoseGraphConfig, solver: PoseGraphSolver
) -> PoseGraphResult:
    is_outlier = np.zeros(len(graph.edges), bool)
    loops, trusted = None, ~is_outlier
    if config.method == "gnc":
        loops = loop_consistency(graph)
        if loops.consistent.any():
            trusted = loops.consistent | graph.is_odometry
    given = "file" if graph.has_poses else "odometry"
    given_poses = graph.poses if graph.has_poses else spanning_tree_poses(graph)
    solver.weigh(trusted.astype(float))
    starts = {"chordal": chordal_poses(graph.with_edges(trusted)), given: given_poses}
    chi_squares = {name: edge_chi_squares(graph, poses) for name, poses in starts.items()}
    costs = {name: 0.5 * float(c[trusted].sum()) for name, c in chi_squares.items()}
    start, raced = _best_start(solver, starts, costs)
    if loops is not None:
        is_outlier = find_wrong_loops(graph, solver, config, loops)
        if not is_connected(graph.with_edges(~is_outlier)):
            raise RuntimeError("edges of a finite cost do not connect it")
        solver.weigh(np.where(is_outlier, 0.0, 1.0))
    final = solver.run(config.max_iterations, raced if loops is None else None)
    return PoseGraphResult(
        graph=graph.with_poses(solver.poses),
        method=config.method,
        given=given,
        given_poses=given_poses,
        given_cost=0.5 * float(chi_squares[given].sum()),
        start=start,
        initial_cost=0.5 * float(chi_squares[start].sum()),
        final_cost=final.cost,
        iterations=solver.iterations,
        is_outlier=is_outlier,
    )


def _best_start(
    solver: PoseGraphSolver, starts: dict[str, Array], costs: dict[str, float]
) -> tuple[str, Descent]:
    """The start whose cost is lowest after a few steps, and these; the solver is left there.

    A low initial cost says little: odometry has none but in its loops, and ends in a local minimum.
    The chordal start is always raced. The given one is not if the chordal one has converged below
    its initial cost, or if it begins at many times the chordal one's. A start that cannot be solved
    drops out.
    """
    race: list[tuple[str, Descent, Any]] = []
    failure = RuntimeError("no initial value")
    for name, poses in starts.items():
        if race and race[0][1].is_nearly_converged and race[0][1].cost <= costs[name]:
            break
        if race and costs[name] > FAR * costs["chordal"]:
            break
        solver.poses = poses
        try:
            race.append((name, solver.run(RACE_STEPS), solver.values))
        except RuntimeError as error:
            failure = error
    if not race:
        raise failure
    name, descent, solver.values = min(race, key=lambda entry: entry[1].cost)
    return name, descent
