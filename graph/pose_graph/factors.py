"""A pose graph in GTSAM's terms: factors and values; its residuals and cost without GTSAM."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import inverse, make_pose, se3_log
from bmask_slam.graph.pose_graph.pose_graph import (
    PoseGraph,
    complex_rotations,
    planar_coordinates,
    planar_poses,
)


def edge_chi_squares(graph: PoseGraph, poses: Array | None = None) -> Array:
    """(M,) ``r^T Omega r`` of all edges at poses (N, 4, 4), by default the graph's.

    ``r = log(inverse(measurement) @ inverse(T_world_i) @ T_world_j)``, as GTSAM has it.
    """
    T = graph.poses if poses is None else poses
    if graph.is_planar:
        r = _planar_residuals(graph, T)
    else:
        i, j = graph.edges.T
        r = se3_log(inverse(T[i] @ graph.measurements) @ T[j])
    return np.asarray(np.einsum("mi,mij,mj->m", r, graph.information, r, optimize=True))


def _planar_residuals(graph: PoseGraph, T: Array) -> Array:
    """(M, 3) x, y and angle: the logarithm in SE(2), rotations and positions as complex numbers."""
    i, j = graph.edges.T
    q, p = complex_rotations(T), T[:, 0, 3] + 1j * T[:, 1, 3]
    Z = graph.measurements
    back = np.conj(q[i] * complex_rotations(Z))
    angle_rad = np.angle(back * q[j])
    half = 0.5 * angle_rad
    scale = np.cos(half) / np.sinc(half / np.pi) - 1j * half  # of V(angle), inverted
    t = scale * back * (p[j] - p[i] - q[i] * (Z[:, 0, 3] + 1j * Z[:, 1, 3]))
    return np.stack([t.real, t.imag, angle_rad], axis=1)


def pose_graph_cost(graph: PoseGraph) -> float:
    """Half the sum of squared, whitened residuals at the graph's poses."""
    return 0.5 * float(edge_chi_squares(graph).sum())


def make_factors(graph: PoseGraph, information: Array | None = None) -> gtsam.NonlinearFactorGraph:
    """A factor an edge, with the graph's information (M, d, d) or another."""
    information = graph.information if information is None else information
    between = gtsam.BetweenFactorPose2 if graph.is_planar else gtsam.BetweenFactorPose3
    factors = gtsam.NonlinearFactorGraph()
    measurements = _gtsam_poses(graph, graph.measurements)
    noises: dict[bytes, Any] = {}  # most files have few different ones
    for (i, j), T, omega in zip(graph.edges.tolist(), measurements, information, strict=True):
        noise = noises.get(key := omega.tobytes())
        if noise is None:
            noise = noises[key] = gtsam.noiseModel.Gaussian.Information(omega)
        factors.add(between(i, j, T, noise))
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
    rotations = T[:, :3, :3].reshape(-1, 9).tolist()
    return [gtsam.Pose3(gtsam.Rot3(*R), t) for R, t in zip(rotations, T[:, :3, 3], strict=True)]


def make_values(graph: PoseGraph, poses: Array) -> gtsam.Values:
    values = gtsam.Values()
    kind = "pose2" if graph.is_planar else "pose3"  # names the overload: half the time
    for k, pose in enumerate(_gtsam_poses(graph, poses)):
        values.insert(k, **{kind: pose})
    return values


def poses_of(graph: PoseGraph, values: gtsam.Values) -> Array:
    """(N, 4, 4) from values."""
    if graph.is_planar:
        return planar_poses(np.asarray(gtsam.utilities.extractPose2(values)))
    rows = np.asarray(gtsam.utilities.extractPose3(values))  # R row by row, then t
    return make_pose(rows[:, :9].reshape(-1, 3, 3), rows[:, 9:])
