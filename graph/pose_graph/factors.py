"""A pose graph in GTSAM's terms: factors, values, its cost, and the chordal initial value."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.pose_graph.pose_graph import PoseGraph, planar_coordinates, planar_poses

_IN_PLANE = np.array([3, 4, 2])  # positions of x, y and angle in a tangent of SE(3)


def pose_graph_cost(graph: PoseGraph) -> float:
    """Half the sum of squared, whitened residuals at the graph's poses."""
    return float(make_factors(graph).error(make_values(graph, graph.poses)))


def chordal_poses(graph: PoseGraph) -> Array:
    """Poses (N, 4, 4) by chordal relaxation: rotations first, then all in one linear step.

    Carlone et al., ICRA 2015, by GTSAM. A 2-D graph is solved as 3-D in the plane. The
    first vertex that is fixed (or the first) keeps its pose.
    """
    anchor = int(np.argmax(graph.fixed))
    information = graph.information
    if graph.is_planar:
        information = np.tile(np.eye(6), (len(graph.edges), 1, 1))
        information[:, _IN_PLANE[:, None], _IN_PLANE] = graph.information
    spatial = replace(graph, information=information)
    factors = make_factors(spatial)
    factors.add(
        gtsam.PriorFactorPose3(
            anchor, gtsam.Pose3(graph.poses[anchor]), gtsam.noiseModel.Unit.Create(6)
        )
    )
    poses = poses_of(spatial, gtsam.InitializePose3.initialize(factors))
    return planar_poses(planar_coordinates(poses)) if graph.is_planar else poses


def make_factors(graph: PoseGraph, information: Array | None = None) -> gtsam.NonlinearFactorGraph:
    """A factor an edge, with the graph's information (M, d, d) or another."""
    information = graph.information if information is None else information
    between = gtsam.BetweenFactorPose2 if graph.is_planar else gtsam.BetweenFactorPose3
    factors = gtsam.NonlinearFactorGraph()
    measurements = _gtsam_poses(graph, graph.measurements)
    for (i, j), T, omega in zip(graph.edges.tolist(), measurements, information, strict=True):
        factors.add(between(i, j, T, gtsam.noiseModel.Gaussian.Information(omega)))
    return factors


def make_gauge(graph: PoseGraph) -> gtsam.NonlinearFactorGraph:
    """Priors on the fixed vertices; any prior fixes a single one exactly."""
    prior = gtsam.PriorFactorPose2 if graph.is_planar else gtsam.PriorFactorPose3
    fixed = np.flatnonzero(graph.fixed) if graph.fixed.any() else np.array([0])
    sigma = 1.0 if len(fixed) == 1 else 1e-5
    noise = gtsam.noiseModel.Isotropic.Sigma(graph.information.shape[-1], sigma)
    factors = gtsam.NonlinearFactorGraph()
    for k, pose in zip(fixed.tolist(), _gtsam_poses(graph, graph.poses[fixed]), strict=True):
        factors.add(prior(k, pose, noise))
    return factors


def _gtsam_poses(graph: PoseGraph, T: Array) -> list[Any]:
    if graph.is_planar:
        return [gtsam.Pose2(x, y, angle) for x, y, angle in planar_coordinates(T).tolist()]
    return [gtsam.Pose3(pose) for pose in T]


def make_values(graph: PoseGraph, poses: Array) -> gtsam.Values:
    values = gtsam.Values()
    for k, pose in enumerate(_gtsam_poses(graph, poses)):
        values.insert(k, pose)
    return values


def poses_of(graph: PoseGraph, values: gtsam.Values) -> Array:
    """(N, 4, 4) from values."""
    count = range(len(graph.ids))
    if not graph.is_planar:
        return np.stack([values.atPose3(k).matrix() for k in count])
    coordinates = [(p.x(), p.y(), p.theta()) for p in map(values.atPose2, count)]
    return planar_poses(np.array(coordinates))
