"""Tables of a comparison, independent of the format in which they are printed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from math import isfinite
from statistics import median

from bmask_slam.comparison.experiment.result import (
    MIN_COVERAGE,
    Cell,
    CellStatus,
    Comparison,
    Kind,
    Method,
)
from bmask_slam.reporting.metric_table import METRICS, Metric
from bmask_slam.reporting.parts import Entry, Table, TableRow

EMPTY = "–"
FAILED = "failed"
PENDING = "pending"
RANGE = " (smallest to largest)"
ATE = METRICS[0]
MAX_COLUMNS = 9  # of figures of single cells


def metric_tables(comparison: Comparison) -> list[Table]:
    """A table of methods by sequences for each metric that a cell has."""
    tables = (metric_table(comparison, metric) for metric in METRICS)
    return [table for table in tables if table is not None]


def metric_table(comparison: Comparison, metric: Metric) -> Table | None:
    """Methods by sequences: median over seeds and range; None if no cell has the metric."""
    if not any(metric.name in cell.metrics for cell in comparison.cells):
        return None
    columns = [_column(comparison, sequence, metric) for sequence in comparison.sequences]
    rows = tuple(
        TableRow(method.name, tuple(entries), method_tags(method), method_note(comparison, method))
        for method, *entries in zip(comparison.methods, *columns, strict=True)
        if any(entry != Entry(EMPTY) for entry in entries)
    )
    unit = f" ({metric.unit})" if metric.unit not in ("", "1") else ""
    way = {True: "Lower is better.", False: "Higher is better.", None: ""}[metric.lower_is_better]
    caption = f"{metric.title}{unit}: median over seeds{RANGE}. {way}".strip()
    title = f"{metric.title}{unit}"
    return Table(metric.name, title, caption, comparison.sequences, rows)


def cell_tables(comparison: Comparison) -> list[Table]:
    """All figures of every cell, by sequence, with at most nine columns a table."""
    names = {name for cell in comparison.cells for name in cell.metrics}
    metrics = [metric for metric in METRICS if metric.name in names]
    groups = [metrics[k : k + MAX_COLUMNS] for k in range(0, len(metrics), MAX_COLUMNS)]
    return [_cell_table(comparison, s, group) for s in comparison.sequences for group in groups]


def cell_name(cell: Cell) -> str:
    """A cell's method and seed."""
    return cell.method if cell.seed is None else f"{cell.method}, seed {cell.seed}"


def values(cells: Iterable[Cell], metric: Metric) -> list[float]:
    """The finite values of a metric in the cells that are done, as printed (scaled)."""
    found = [
        c.metrics[metric.name]
        for c in cells
        if c.status is CellStatus.DONE and metric.name in c.metrics
    ]
    return [metric.scale * value for value in found if isfinite(value)]


def number(value: float, metric: Metric) -> str:
    """A value, scaled already, with the metric's digits."""
    return f"{value:.{metric.digits}f}" if isfinite(value) else EMPTY


def method_tags(method: Method) -> tuple[str, ...]:
    """Tags of a method's row: not run here, published, aligned with scale."""
    kind = {Kind.RUN: (), Kind.TRAJECTORY: ("trajectory file",), Kind.PUBLISHED: ("published",)}
    return (*kind[method.kind], *(("Sim(3)",) if method.with_scale else ()))


def method_note(comparison: Comparison, method: Method) -> str:
    """A method's note, and the sources of its figures."""
    sources = dict.fromkeys(c.source for c in comparison.cells if c.method == method.name)
    return "; ".join(text for text in (method.note, *sources) if text)


def _column(comparison: Comparison, sequence: str, metric: Metric) -> list[Entry]:
    """The entries of a sequence, one for each method, with the best marked."""
    groups = [list(comparison.of(sequence, method.name)) for method in comparison.methods]
    entries = [_entry(cells, metric) for cells in groups]
    middle = {
        k: median(found)
        for k, (cells, method) in enumerate(zip(groups, comparison.methods, strict=True))
        if method.kind is not Kind.PUBLISHED
        and not method.with_scale
        and not entries[k].failed
        and covered_share(cells) >= MIN_COVERAGE
        and (found := values(cells, metric))
    }
    if metric.lower_is_better is None or len(middle) < 2:
        return entries
    best = number((min if metric.lower_is_better else max)(middle.values()), metric)
    if all(number(value, metric) == best for value in middle.values()):
        return entries
    return [
        replace(entry, best=k in middle and number(middle[k], metric) == best)
        for k, entry in enumerate(entries)
    ]


def _entry(cells: list[Cell], metric: Metric) -> Entry:
    failed = sum(cell.status is CellStatus.FAILED for cell in cells)
    pending = sum(cell.status is CellStatus.PENDING for cell in cells)
    found = values(cells, metric)
    counts = ((failed, FAILED), (pending, PENDING))
    for count, word in counts:
        if count and count == len(cells):
            return Entry(word, failed=failed > 0)
    notes = [f"{count} of {len(cells)} {word}" for count, word in counts if count]
    if not found:
        return Entry(EMPTY, note=", ".join(notes), failed=failed > 0)
    low, high = (number(limit(found), metric) for limit in (min, max))
    notes += _share(cells) if metric is ATE else []
    spread = f"{low} to {high}" if low != high else ""
    return Entry(number(median(found), metric), spread, ", ".join(notes), failed=failed > 0)


def covered_share(cells: Iterable[Cell]) -> float:
    """The least share of the sequence that a cell which is done covers."""
    return min((c.coverage for c in cells if c.status is CellStatus.DONE), default=1.0)


def _share(cells: list[Cell]) -> list[str]:
    """The share of the sequence that has a pose, and that was evaluated, if not all of it."""
    coverage = covered_share(cells)
    covered = [f"covers {100 * coverage:.0f} %"] if coverage < MIN_COVERAGE else []
    shares = [c.metrics["evaluated_share"] for c in cells if "evaluated_share" in c.metrics]
    return covered + ([f"over {100 * min(shares):.0f} %"] if shares and min(shares) < 0.995 else [])


def _cell_table(comparison: Comparison, sequence: str, metrics: list[Metric]) -> Table:
    columns = tuple(f"{m.title} ({m.unit})" if m.unit else m.title for m in metrics)
    cells = [cell for cell in comparison.cells if cell.sequence == sequence]
    rows = tuple(TableRow(cell_name(c), tuple(_single(c, m) for m in metrics)) for c in cells)
    title = f"{sequence}: {metrics[0].title} to {metrics[-1].title}"
    return Table(f"cells-{sequence}", title, "Each run on its own.", columns, rows)


def _single(cell: Cell, metric: Metric) -> Entry:
    if cell.status is not CellStatus.DONE:
        return Entry(cell.status.value, failed=cell.status is CellStatus.FAILED)
    return Entry(number(metric.scale * cell.metrics.get(metric.name, float("nan")), metric))
