"""A comparison as text for a terminal: a table of a metric, what failed, and the verdicts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from bmask_slam.comparison.experiment.result import CellStatus, Comparison
from bmask_slam.comparison.report.table import EMPTY, cell_name, metric_table
from bmask_slam.comparison.statistics import FEW_PAIRS, Verdict, too_few, verdicts
from bmask_slam.reporting.metric_table import BY_NAME
from bmask_slam.reporting.parts import TableRow

MAIN_METRIC = "ate_rmse"


def format_comparison(comparison: Comparison) -> str:
    """The table of the main metric, the verdicts, and every cell without figures.

    If all verdicts have too few pairs, one line states it; the report lists them.
    """
    found = verdicts(comparison)
    judged = format_verdicts(found)
    if too_few(found):
        judged = FEW_PAIRS
    parts = [format_table(comparison, MAIN_METRIC), judged]
    return "\n\n".join(filter(None, [*parts, format_problems(comparison)]))


def format_table(comparison: Comparison, metric: str) -> str:
    """Methods by sequences, median over seeds and range; "" where no cell has the metric."""
    table = metric_table(comparison, BY_NAME[metric])
    if table is None:
        return ""
    lines = [("", *table.columns), *(_cells(row) for row in table.rows)]
    return "\n".join([table.caption, *_aligned(lines)])


def format_verdicts(found: tuple[Verdict, ...]) -> str:
    """A line for each verdict, in columns; "" without any."""
    if not found:
        return ""
    lines = [_verdict(v, v.metric != before) for before, v in _with_previous(found)]
    head = (
        f"Against {found[0].baseline}: mean difference with 95 % bootstrap interval, pairs "
        "in which better : worse of all,\np of the exact sign test after Holm's correction"
    )
    return "\n".join([head, *_aligned(lines)])


def _with_previous(found: tuple[Verdict, ...]) -> Iterator[tuple[str, Verdict]]:
    """Each verdict after the metric of the one before it."""
    before = ""
    for verdict in found:
        yield before, verdict
        before = verdict.metric


def _verdict(v: Verdict, first: bool) -> tuple[str, ...]:
    """The columns of a verdict; its metric is named in the first line of each."""
    metric = BY_NAME[v.metric]
    shown = [f"{metric.scale * x:+.{metric.digits + 1}f}" for x in (v.difference, v.low, v.high)]
    if not v.pairs:
        shown = [EMPTY] * 3
    notes = [f"{v.incomplete} pairs without figures"] * bool(v.incomplete) + [v.note] * bool(v.note)
    return (
        f"{metric.title} ({metric.unit})" if first else "",
        v.method,
        v.judgement,
        f"{shown[0]} [{shown[1]}, {shown[2]}]",
        f"{v.wins} : {v.losses} of {v.pairs}",
        f"p = {v.p_value:.2g}",
        "; ".join(notes),
    )


def _aligned(lines: Sequence[tuple[str, ...]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    rows = ("  ".join(t.ljust(w) for t, w in zip(line, widths, strict=True)) for line in lines)
    return [row.rstrip() for row in rows]


def format_problems(comparison: Comparison) -> str:
    """Failed and pending cells, a line for each reason."""
    found: dict[tuple[str, ...], list[str]] = {}
    for cell in comparison.cells:
        if cell.status is not CellStatus.DONE:
            log = f" (log: {cell.log})" if cell.log else ""
            key = cell.status.value, cell.sequence, f"{cell.error or 'not run'}{log}"
            found.setdefault(key, []).append(cell_name(cell))
    return "\n".join(
        f"{status}: {sequence}: {'; '.join(dict.fromkeys(names))}: {error}"
        for (status, sequence, error), names in found.items()
    )


def _cells(row: TableRow) -> tuple[str, ...]:
    name = " ".join([row.label, *(f"({tag})" for tag in row.tags)])
    return (name, *(entry.plain for entry in row.entries))
