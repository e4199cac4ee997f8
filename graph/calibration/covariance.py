"""Covariance of a self-calibration whose measurement errors are correlated."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtri, stdtrit

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.calibration.equations import normal_equations, root_weights, with_points
from bmask_slam.graph.calibration.model import CalibrationViews, linearise
from bmask_slam.graph.calibration.problem import (
    CalibrationProblem,
    CalibrationState,
    N,
    prior_information,
)

STRETCHES = 8


def covariance_of(problem: CalibrationProblem, state: CalibrationState, scales: Array) -> Array:
    """Covariance (18, 18) of the calibration, zero in what is held fixed.

    The inverse of the normal equations is right if errors are independent. They are not: a
    landmark's patch errs alike in neighbouring views, and a stretch of the path shares light, blur
    and depth relief. So sandwich estimates are made with clusters of all errors of a landmark, of a
    stretch of keyframes, and of the landmarks first seen in a stretch (Cameron and Miller, J. Human
    Resources 2015). The correlations are those of the normal equations, the standard deviations the
    largest of all, in terms of 95 % bounds.
    """
    views = problem.views
    reduced = normal_equations(problem, state, scales, 0.0)
    unit = 1 / np.sqrt(np.diag(reduced.S))
    correlation = np.linalg.inv(reduced.S * np.outer(unit, unit)).astype(float)
    by_rhs: Array = (correlation * np.outer(unit, unit))[:, -N:]
    poses, points, model = with_points(views, reduced, by_rhs)
    lin = linearise(views, *state.values)
    influence = (
        lin.pose @ poses[views.keyframes]
        + lin.point @ points[views.landmarks]
        + lin.calibration @ model
    )
    weight = (root_weights(lin.residuals, scales) ** 2)[..., 0]
    scores = np.einsum("mri,mr->mi", influence, weight * lin.residuals)
    prior = np.diag(by_rhs.T @ prior_information(problem, state) @ by_rhs)
    variances = [np.diag(model)]
    for clusters in _clusters(views):
        variances.append(_clustered_variance(scores, clusters) + prior)
    larger = np.sqrt(np.max(variances, axis=0) / variances[0])
    free = problem.prior_sigmas > 0
    return np.where(np.outer(free, free), model * np.outer(larger, larger), 0.0)


def _clusters(views: CalibrationViews) -> tuple[Ints, Ints, Ints]:
    """Three clusterings (M,) of views whose errors may be correlated: see ``covariance_of``."""
    keyframes = int(views.keyframes.max()) + 1
    stretch = np.arange(keyframes) * min(STRETCHES, keyframes) // keyframes
    first = np.full(int(views.landmarks.max()) + 1, keyframes)
    np.minimum.at(first, views.landmarks, views.keyframes)
    return views.landmarks, stretch[views.keyframes], stretch[first[views.landmarks]]


def _clustered_variance(scores: Array, clusters: Ints) -> Array:
    """Variances (18,) from scores (M, 18) whose errors are correlated within clusters (M,).

    Few clusters estimate their spread badly: the variance is increased so that 1.96 standard
    deviations are the bound of Student's t with as many degrees of freedom.
    """
    sums = np.zeros((int(clusters.max()) + 1, N))
    np.add.at(sums, clusters, scores)
    freedom = max(int(np.count_nonzero(sums.any(axis=1))) - 1, 1)
    bound = float(stdtrit(freedom, 0.975) / ndtri(0.975))
    return (sums**2).sum(axis=0) * (freedom + 1) / freedom * bound**2
