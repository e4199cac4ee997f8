"""Errors of a trajectory file, and measurements of a run, as metrics of a cell."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bmask_slam.evaluation import evaluate_trajectory, read_reference
from bmask_slam.graph.trajectory_formats import read_trajectory
from bmask_slam.reporting.metric_table import BY_NAME
from bmask_slam.run_folder.reader import Run

COMPARISON_NAMES = {"estimate_share": "evaluated_share"}
"""Names of evaluation rows that have another name in a comparison."""


@dataclass(frozen=True)
class Rules:
    """How trajectories are compared: largest difference of stamps, and whether by Sim(3)."""

    max_time_difference_s: float
    with_scale: bool = False


def trajectory_errors(
    trajectory: Path, reference: Path, rules: Rules, frames: int | None = None
) -> dict[str, float]:
    """ATE, RPE and the share that could be evaluated, by metric; with ``frames`` the share tracked.

    Raises:
        InputError: a file that is missing or broken, or two without common times.
    """
    estimate, truth = read_trajectory(trajectory), read_reference(reference)
    result = evaluate_trajectory(
        estimate, truth, frames, rules.with_scale, rules.max_time_difference_s
    )
    rows = {COMPARISON_NAMES.get(row["name"], row["name"]): row["value"] for row in result.rows}
    if "tracked_share" in rows:
        rows["tracked_share"] = min(rows["tracked_share"], 1.0)
    return {name: value for name, value in rows.items() if name in BY_NAME}


def run_figures(run: Path) -> dict[str, float]:
    """The measurements of a run without errors: times, memory, shares."""
    return {
        name: float(metric.value)
        for name, metric in Run(run).metrics.items()
        if name in BY_NAME and not name.startswith(("ate_", "rpe_", "drift_"))
    }
