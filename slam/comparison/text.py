"""A comparison as text for a terminal: a table of a metric, what failed, and the verdicts."""

from __future__ import annotations

from slam.comparison.metric_table import BY_NAME
from slam.comparison.report.table import TableRow, cell_name, metric_table
from slam.comparison.result import CellStatus, Comparison
from slam.comparison.statistics import NOTHING, Verdict, verdicts

MAIN_METRIC = "ate_rmse"


def format_comparison(comparison: Comparison) -> str:
    """The table of the main metric, the verdicts, and every cell without figures."""
    parts = [format_table(comparison, MAIN_METRIC), format_verdicts(verdicts(comparison))]
    return "\n\n".join(filter(None, [*parts, format_problems(comparison)]))


def format_table(comparison: Comparison, metric: str) -> str:
    """Methods by sequences, median over seeds and range; "" where no cell has the metric."""
    table = metric_table(comparison, BY_NAME[metric])
    if table is None:
        return ""
    lines = [("", *table.columns), *(_cells(row) for row in table.rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    rows = ["  ".join(t.ljust(w) for t, w in zip(line, widths, strict=True)) for line in lines]
    return "\n".join([table.caption, *(row.rstrip() for row in rows)])


def format_verdicts(found: tuple[Verdict, ...]) -> str:
    """A line for each; "" without any."""
    return "\n".join(format_verdict(verdict) for verdict in found)


def format_verdict(v: Verdict) -> str:
    """One sentence with the figures that it rests on."""
    metric = BY_NAME[v.metric]

    def shown(value: float) -> str:
        return f"{metric.scale * value:+.{metric.digits + 1}f}"

    said = NOTHING if v.judgement == NOTHING else f"{v.judgement} than {v.baseline}"
    interval = f"{shown(v.difference)} {metric.unit} [{shown(v.low)}, {shown(v.high)}]"
    text = f"{metric.title}: {v.method}: {said} ({interval}, better in {v.wins} and worse in "
    text += f"{v.losses} of {v.pairs} pairs, p = {v.p_value:.2g})"
    if v.left_out:
        text += f"; {v.left_out} pairs without figures left out"
    return f"{text}; {v.note}" if v.note else text


def format_problems(comparison: Comparison) -> str:
    """What failed or is not there, a line for each reason with all cells that it holds for."""
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
