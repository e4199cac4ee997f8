"""Synthetic pose graphs: laps on a circle, each pose connected with the previous lap."""

from __future__ import annotations

import numpy as np

from bmask_slam.graph.geometry import inverse, make_pose, se3_exp, so3_exp
from bmask_slam.graph.pose_graph.pose_graph import PoseGraph, planar_poses

PER_LAP = 12


def ring(count: int, planar: bool, seed: int = 0, sigma: float = 0.0) -> PoseGraph:
    """A graph at its true poses whose measurements err by ``sigma`` (m and rad).

    Radius 3 m; ids are 10, 11, ...; the information differs from edge to edge and is full.
    """
    rng = np.random.default_rng(seed)
    k = np.arange(count)
    angle = 2 * np.pi * k / PER_LAP
    x, y = 3 * np.cos(angle), 3 * np.sin(angle)
    if planar:
        poses, d = planar_poses(np.stack([x, y, angle], axis=1)), 3
    else:
        R = so3_exp(np.stack([0.3 * np.sin(k), 0.2 * np.cos(k), angle % 6 - 3], axis=1))
        poses, d = make_pose(R, np.stack([x, y, 0.1 * k], axis=1)), 6
    loops = np.stack([k[:-PER_LAP], k[PER_LAP:]], axis=1)
    edges = np.concatenate([np.stack([k[:-1], k[1:]], axis=1), loops])
    measurements = inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]]
    noise = sigma * rng.normal(size=(len(edges), 6))
    if planar:
        noise[:, [0, 1, 5]] = 0
    A = rng.normal(size=(len(edges), d, d))
    shape = np.eye(d) + 0.02 * (A @ A.swapaxes(1, 2))
    return PoseGraph(
        ids=10 + k,
        poses=poses,
        edges=edges,
        measurements=measurements @ se3_exp(noise),
        information=shape / max(sigma, 0.01) ** 2,
        fixed=np.zeros(count, bool),
    )
