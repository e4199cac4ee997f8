"""Research comparisons: sequences x methods x seeds, run, measured, tabulated, drawn.

    from bmask_slam.comparison import compare
    comparison = compare("rendered", "runs/rendered")
    comparison.to_pandas()

The names are imported when they are first used, so that the process of a job starts fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bmask_slam.comparison.comparing import compare as compare
    from bmask_slam.comparison.experiment.options import CompareOptions as CompareOptions
    from bmask_slam.comparison.experiment.result import Cell as Cell
    from bmask_slam.comparison.experiment.result import CellStatus as CellStatus
    from bmask_slam.comparison.experiment.result import Comparison as Comparison
    from bmask_slam.comparison.experiment.result import Kind as Kind
    from bmask_slam.comparison.experiment.result import Method as Method
    from bmask_slam.comparison.experiment.result import read_results as read_results
    from bmask_slam.comparison.statistics import Summary as Summary
    from bmask_slam.comparison.statistics import Verdict as Verdict
    from bmask_slam.comparison.statistics import summarise as summarise
    from bmask_slam.comparison.statistics import verdicts as verdicts

_RESULT = ("Cell", "CellStatus", "Comparison", "Kind", "Method", "read_results")
_HOME = {
    "compare": "comparing",
    "CompareOptions": "experiment.options",
    **dict.fromkeys(_RESULT, "experiment.result"),
    **dict.fromkeys(("Summary", "Verdict", "summarise", "verdicts"), "statistics"),
}
__all__ = list(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
