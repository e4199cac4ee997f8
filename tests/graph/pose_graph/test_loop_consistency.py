"""Cycles of loops: their chi-square, with frames and adjoints."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from bmask_slam.graph.geometry import inverse, se3_exp
from bmask_slam.graph.pose_graph.loop_consistency import cycle_chi2


def test_chi_square_of_true_loops_has_six_degrees_of_freedom() -> None:
    rng, count = np.random.default_rng(4), 3000
    T_world_a = se3_exp(rng.normal(size=(2 * count, 6)))
    T_world_b = se3_exp(rng.normal(size=(2 * count, 6)))
    root = rng.normal(size=(4, 6, 6)) * 0.002
    loop, step_a, step_b = (r @ r.T + 1e-7 * np.eye(6) for r in root[:3])

    def noise(covariance: np.ndarray, size: int) -> np.ndarray:
        return se3_exp(rng.multivariate_normal(np.zeros(6), covariance, size))

    T_a_b = inverse(T_world_a) @ T_world_b @ noise(loop, 2 * count)
    first, second = np.arange(count), np.arange(count, 2 * count)
    T_a_c = inverse(T_world_a[first]) @ T_world_a[second] @ noise(step_a, count)
    T_d_b = inverse(T_world_b[second]) @ T_world_b[first] @ noise(step_b, count)
    map_a, map_b = T_world_a.copy(), T_world_b.copy()
    map_a[second] = map_a[first] @ T_a_c
    map_b[first] = map_b[second] @ T_d_b
    covariances = np.tile(loop, (2 * count, 1, 1))
    steps = np.stack([np.tile(step_a, (count, 1, 1)), np.tile(step_b, (count, 1, 1))])
    values = cycle_chi2(T_a_b, covariances, (map_a, map_b), (first, second), steps)
    low, high = chi2.ppf([0.005, 0.995], 6 * count) / count
    assert low < values.mean() < high
    assert abs((values > chi2.ppf(0.95, 6)).mean() - 0.05) < 0.012
