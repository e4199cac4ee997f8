"""GTSAM's batch optimisers, one iteration at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Progress = Callable[[int, float], None]  # iteration, cost


def iterate(
    optimiser: Any, max_iterations: int, relative_tolerance: float, progress: Progress
) -> tuple[float, int]:
    """Iterate until the cost falls by less than a share of itself; the cost and the steps taken.

    ``progress`` is called after each step, counted from 1.
    """
    cost, steps = float(optimiser.error()), 0
    for steps in range(1, max_iterations + 1):
        optimiser.iterate()
        before, cost = cost, float(optimiser.error())
        progress(steps, cost)
        if before - cost <= relative_tolerance * before:
            break
    return cost, steps
