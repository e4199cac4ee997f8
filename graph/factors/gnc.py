"""Graduated non-convexity with truncated least squares (Yang et al., RA-L 2020)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bmask_slam.graph.arrays import Array


def truncated_weights(chi_squares: Array, limit: float, mu: float) -> Array:
    """Weights (M,) in [0, 1] of GNC's truncated least squares (Yang et al. 2020, eq. 14)."""
    middle = np.sqrt(limit * mu * (mu + 1) / np.maximum(chi_squares, 1e-12)) - mu
    return np.clip(middle, 0.0, 1.0)


def first_mu(chi_squares: Array, limit: float) -> float:
    """The mu at which the cost is convex for residuals up to the largest (Yang et al., remark 5).

    Only if one of them is beyond the limit; otherwise no weight would differ from 1.
    """
    return limit / (2 * float(chi_squares.max()) - limit)


def gnc_weights(
    chi_squares: Array,
    limit: float,
    mu: float,
    step: float,
    max_iterations: int,
    solve: Callable[[Array], Array],
) -> Array:
    """Weights (M,), each 0 or 1 at convergence.

    ``solve`` takes weights, updates the solution and returns the new chi-squares. mu grows by
    ``step`` until every weight is close to 0 or 1.
    """
    weights = np.ones(len(chi_squares))
    for _ in range(max_iterations):
        weights = truncated_weights(chi_squares, limit, mu)
        chi_squares = solve(weights)
        if ((weights < 1e-3) | (weights > 1 - 1e-3)).all():
            break
        mu *= step
    return weights
