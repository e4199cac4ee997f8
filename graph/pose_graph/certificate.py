"""Whether the optimum of a 3-D pose graph is the global one, by Shonan rotation averaging."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import gtsam
import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.pose_graph.chordal import mean_information, poses_of_rotations
from bmask_slam.graph.pose_graph.optimisation import PoseGraphResult
from bmask_slam.graph.pose_graph.pose_graph import PoseGraph
from bmask_slam.graph.pose_graph.solver import PoseGraphConfig, PoseGraphSolver

Status = Literal["global", "not global", "undecided"]
MAX_DIMENSION = 7
NOTHING = 1e-9  # cost of a graph without noise
SAME = 1e-5  # difference of two costs of the same optimum, relative


@dataclass(frozen=True, eq=False)
class Certificate:
    """What the globally optimal rotations say of a solution.

    Attributes:
        status: global: from the certified rotations the same cost is reached; not global: a lower
            one; undecided: a higher one, or no rotations could be certified.
        smallest_eigenvalue: of Shonan's certificate matrix; not below zero but for rounding.
        poses: (N, 4, 4) that are reached from the certified rotations, and cost theirs.
    """

    status: Status
    smallest_eigenvalue: float
    poses: Array | None = None
    cost: float = np.nan


def certify(result: PoseGraphResult) -> Certificate:
    """Compare a solution with the one that globally optimal rotations lead to.

    The certificate is of rotations with one weight an edge; the whole cost of the graph, with its
    information matrices, has none. An optimum that it confirms is the global one unless that
    difference makes another.

    Raises:
        InputError: a 2-D graph.
    """
    used = result.graph.with_edges(~result.is_outlier)
    poses, smallest = certified_rotations(used)
    if poses is None:
        return Certificate("undecided", smallest)
    solver = PoseGraphSolver(used, PoseGraphConfig(), lambda iteration, cost: None)
    solver.poses = poses
    cost = solver.run(PoseGraphConfig().max_iterations).cost
    slack = SAME * max(cost, result.final_cost) + NOTHING
    status: Status = "global" if abs(cost - result.final_cost) <= slack else "undecided"
    if cost < result.final_cost - slack:
        status = "not global"
    return Certificate(status, smallest, solver.poses, cost)


def check_certifiable(graph: PoseGraph) -> None:
    """Raise InputError for a 2-D graph."""
    if graph.is_planar:
        raise InputError("--certify: is of 3-D graphs; leave it out for a 2-D one")


def certified_rotations(graph: PoseGraph) -> tuple[Array | None, float]:
    """Poses (N, 4, 4) whose rotations are certified, and the smallest eigenvalue, or None.

    Dellaert, Rosen, Wu, Mahony and Carlone, ECCV 2020, by GTSAM, from the graph's poses: rotations
    that minimise ``sum kappa |R_j - R_i R_ij|^2`` over SO(p), p from 3 on, until the smallest
    eigenvalue of a matrix shows that no others have a lower cost. The certificate is of rotations
    and of this cost; positions follow linearly.

    Raises:
        InputError: a 2-D graph.
    """
    check_certifiable(graph)
    weights = mean_information(graph.information[:, :3, :3])
    measurements = [
        gtsam.BinaryMeasurementRot3(
            i, j, gtsam.Rot3(R), gtsam.noiseModel.Isotropic.Precision(3, weight)
        )
        for (i, j), R, weight in zip(
            graph.edges.tolist(), graph.measurements[:, :3, :3], weights.tolist(), strict=True
        )
    ]
    initial = gtsam.Values()
    for k, R in enumerate(graph.poses[:, :3, :3]):
        initial.insert(k, gtsam.Rot3(R))
    parameters = gtsam.ShonanAveragingParameters3(gtsam.LevenbergMarquardtParams.CeresDefaults())
    try:
        shonan = gtsam.ShonanAveraging3(measurements, parameters)
        values, smallest = shonan.run(initial, 3, MAX_DIMENSION)
        R = np.stack([values.atRot3(k).matrix() for k in range(len(graph.ids))])
        anchor = int(np.argmax(graph.fixed))
        poses = poses_of_rotations(graph, graph.poses[anchor, :3, :3] @ R[anchor].T @ R)
    except RuntimeError:  # no certificate up to that dimension, or no positions for it
        return None, np.nan
    return poses, float(smallest)
