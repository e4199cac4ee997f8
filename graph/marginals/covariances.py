"""Marginal covariances of many variables from one factorisation of the graph.

ISAM2 gives them too, but traverses its tree for each variable and is linearised at older values;
here everything is linearised at the current ones. A robust kernel enters by its weight at these
values, so that outliers add little information: the covariance is that of the weighted
least-squares problem at the optimum. It contains only the noise that the factors state, no errors
of calibration and no wrong matches.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import gtsam
import numpy as np

from bmask_slam.graph.arrays import Array, Ints, no_ids
from bmask_slam.graph.factors.keys import keyframe_keys, landmark_keys


@dataclass(frozen=True)
class Marginals:
    """Marginal covariances of keyframes and landmarks.

    Attributes:
        keyframe_ids: (K,) int64.
        keyframes: (K, 6, 6) of ``[rotation rad, translation m]`` on the right side: the true
            pose is about ``T_world_camera @ se3_exp(xi)``, xi ~ N(0, covariance). The prior on the
            first keyframe of each component fixes the world, so these grow with the path from
            there.
        landmark_ids: (L,) int64.
        landmarks: (L, 3, 3) of points_world in metres.
    """

    keyframe_ids: Ints
    keyframes: Array
    landmark_ids: Ints = field(default_factory=no_ids)
    landmarks: Array = field(default_factory=lambda: np.zeros((0, 3, 3)))


def marginals_of(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    keyframe_ids: Ints,
    landmark_ids: Ints,
    order: gtsam.Ordering | None = None,
) -> Marginals:
    """The covariances of some variables; ``order``: of elimination, None for GTSAM's own.

    Raises RuntimeError where the graph is singular.
    """
    source: gtsam.Marginals | gtsam.GaussianBayesTree = (
        gtsam.Marginals(graph, values)
        if order is None
        else graph.linearize(values).eliminateMultifrontal(order)
    )
    poses = [source.marginalCovariance(key) for key in keyframe_keys(keyframe_ids)]
    points = [source.marginalCovariance(key) for key in landmark_keys(landmark_ids)]
    return Marginals(
        keyframe_ids,
        np.array(poses).reshape(-1, 6, 6),
        landmark_ids,
        np.array(points).reshape(-1, 3, 3),
    )
