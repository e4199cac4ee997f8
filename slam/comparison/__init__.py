"""Research comparisons: sequences x methods x seeds, run, measured, tabulated, drawn.

    from bmask_slam.comparison import compare
    comparison = compare("rendered", "runs/rendered")
    comparison.to_pandas()

The names are loaded when they are asked for, so that the process of a job starts at once.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bmask_slam.comparison.comparing import compare
    from bmask_slam.comparison.experiment.options import CompareOptions
    from bmask_slam.comparison.experiment.result import (
        Cell,
        CellStatus,
        Comparison,
        Kind,
        Method,
        read_results,
    )
    from bmask_slam.comparison.statistics import Summary, Verdict, summarise, verdicts

_MODULES = {
    "comparing": ("compare",),
    "experiment.options": ("CompareOptions",),
    "experiment.result": ("Cell", "CellStatus", "Comparison", "Kind", "Method", "read_results"),
    "statistics": ("Summary", "Verdict", "summarise", "verdicts"),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}

__all__ = [
    "Cell",
    "CellStatus",
    "CompareOptions",
    "Comparison",
    "Kind",
    "Method",
    "Summary",
    "Verdict",
    "compare",
    "read_results",
    "summarise",
    "verdicts",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
