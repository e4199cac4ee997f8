"""What is asked of the system, with what was measured beside it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Run = dict[str, Any]


@dataclass(frozen=True)
class Target:
    """One thing asked: of which run, what, at most (or at least) how much."""

    sequence: str
    variant: str
    asked: str
    value: Callable[[Run], float]
    limit: float
    form: str
    at_least: bool = False


def _metric(name: str, factor: float = 1.0) -> Callable[[Run], float]:
    return lambda run: factor * run["metrics"].get(name, float("nan"))


TARGETS = (
    Target("redkitchen", "default", "frames tracked: all", _metric("tracked_share", 100), 100,
           "{:.1f} %", True),
    Target("redkitchen", "default", "tracking with features, median: at most 33 ms",
           _metric("tracking_ms_median"), 33, "{:.1f} ms"),
    Target("redkitchen", "default", "ATE: at most 4.84 cm (ORB-SLAM2)", _metric("ate_rmse", 100),
           4.84, "{:.2f} cm"),
    Target("redkitchen", "default", "ATE: aim below 4 cm", _metric("ate_rmse", 100), 4.0,
           "{:.2f} cm"),
    Target("redkitchen", "default", "RPE a second: aim below 35 mm",
           _metric("rpe_trans_rmse_second", 1000), 35, "{:.1f} mm"),
    Target("redkitchen", "every 3rd frame", "10 Hz, frames tracked: all",
           _metric("tracked_share", 100), 100, "{:.1f} %", True),
    Target("office", "default", "ATE with sensor noise: at most 5 mm", _metric("ate_rmse", 1000),
           5, "{:.2f} mm"),
    Target("corridor", "default", "ATE with the loop closed: below 2 cm", _metric("ate_rmse", 100),
           2, "{:.2f} cm"),
    Target("corridor", "no loop closed", "drift without loop closing: below 1 % of the path",
           lambda run: 100 * run["drift_m"] / max(run["path_m"], 1e-9), 1, "{:.3f} %"),
)  # fmt: skip


def target_rows(results: dict[str, Any]) -> list[tuple[str, ...]]:
    """Sequence, what is asked, what was measured, and whether that is enough."""
    whole = [run for run in results["runs"] if "--max-frames" not in run["command"]]
    runs = {(run["sequence"], run["variant"]): run for run in whole}
    rows: list[tuple[str, ...]] = []
    for target in TARGETS:
        run = runs.get((target.sequence, target.variant))
        if run is None:
            continue
        value = target.value(run)
        met = value >= target.limit if target.at_least else value <= target.limit
        measured = target.form.format(value)
        rows.append((target.sequence, target.asked, measured, "yes" if met else "**no**"))
    for sequence, same in results["identical"].items():
        measured = "identical" if same else "different"
        asked = "trajectory.txt of two runs: the same bytes"
        rows.append((sequence, asked, measured, "yes" if same else "**no**"))
    return rows
