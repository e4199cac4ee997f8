"""Tables of the differences from the first configuration and of their significance."""

from __future__ import annotations

from math import isfinite

from bmask_slam.comparison.experiment.result import CellStatus, Comparison, Kind
from bmask_slam.comparison.report.table import ATE, EMPTY
from bmask_slam.comparison.statistics import (
    BETTER,
    FEW_PAIRS,
    LEVEL,
    NO_DIFFERENCE,
    RESAMPLES,
    WORSE,
    Verdict,
    summarise,
    too_few,
    verdicts,
)
from bmask_slam.reporting.metric_table import BY_NAME, Metric
from bmask_slam.reporting.parts import Entry, Table, TableRow

COLUMNS = ("judgement", "difference", "95 % interval", "better / worse of pairs", "p")
RULE = (
    f"A method is called better or worse only where the bootstrap interval of the mean difference "
    f"over paired images ({RESAMPLES} resamples) excludes 0 and the sign test agrees, "
    f"p < {LEVEL:g} after Holm's correction for all verdicts of this report. "
    f'"{NO_DIFFERENCE.capitalize()}" does not mean equal. Verdicts hold for these sequences only.'
)


def verdict_tables(comparison: Comparison) -> list[Table]:
    """A table for each judged metric: methods against the first configuration."""
    found = verdicts(comparison)
    metrics = dict.fromkeys(verdict.metric for verdict in found)
    return [_table(BY_NAME[name], [v for v in found if v.metric == name]) for name in metrics]


def verdict_sentences(comparison: Comparison) -> list[str]:
    """Significant differences in the main metric as sentences; one sentence if there are none."""
    found = [v for v in verdicts(comparison) if v.metric == ATE.name]
    sentences = [
        f"{ATE.title}: {v.method} is {v.judgement} than {v.baseline} by "
        f"{ATE.scale * abs(v.difference):.{ATE.digits}f} {ATE.unit} on the mean of {v.pairs} pairs."
        for v in found
        if v.judgement in (BETTER, WORSE)
    ]
    if too_few(found):
        return [f"{FEW_PAIRS}."]
    if found and not sentences:
        return [f"{ATE.title}: no difference from {found[0].baseline} is shown."]
    return sentences


def ablation_table(comparison: Comparison) -> Table | None:
    """By how much each configuration's median ATE is larger than the first one's, in per cent."""
    runs = [method for method in comparison.methods if method.kind is Kind.RUN]
    if len(runs) < 2:
        return None
    rows = tuple(
        TableRow(
            method.name,
            tuple(_change(comparison, s, runs[0].name, method.name) for s in comparison.sequences),
            note=method.note,
        )
        for method in runs[1:]
    )
    if all(entry.text == EMPTY for row in rows for entry in row.entries):
        return None
    caption = (
        f"Median ATE against that of {runs[0].name} (%): positive: larger error. "
        "Empty where a run of either failed, or covers too little of the sequence."
    )
    return Table("ablation", f"ATE against {runs[0].name} (%)", caption, comparison.sequences, rows)


def _change(comparison: Comparison, sequence: str, base: str, method: str) -> Entry:
    cells = [list(comparison.of(sequence, name)) for name in (base, method)]
    if any(cell.status is not CellStatus.DONE for own in cells for cell in own):
        return Entry(EMPTY)
    before, after = (summarise(own, ATE.name) for own in cells)
    if before is None or after is None or before.median <= 0:
        return Entry(EMPTY)
    return Entry(f"{100 * (after.median / before.median - 1):+.0f}")


def _table(metric: Metric, found: list[Verdict]) -> Table:
    unit = f" ({metric.unit})" if metric.unit not in ("", "1") else ""
    title = f"{metric.title}{unit} against {found[0].baseline}"
    rows = tuple(TableRow(v.method, _entries(metric, v), note=v.note) for v in found)
    way = "Lower is better." if metric.lower_is_better else "Higher is better."
    return Table(
        f"verdict-{metric.name}", title, f"Method minus {found[0].baseline}. {way}", COLUMNS, rows
    )


def _entries(metric: Metric, verdict: Verdict) -> tuple[Entry, ...]:
    def shown(value: float) -> str:
        return f"{metric.scale * value:+.{metric.digits + 1}f}" if isfinite(value) else EMPTY

    incomplete = f"{verdict.incomplete} incomplete" if verdict.incomplete else ""
    return (
        Entry(verdict.judgement, best=verdict.judgement in (BETTER, WORSE)),
        Entry(shown(verdict.difference)),
        Entry(f"{shown(verdict.low)} to {shown(verdict.high)}"),
        Entry(f"{verdict.wins} / {verdict.losses} of {verdict.pairs}", note=incomplete),
        Entry(f"{verdict.p_value:.2g}"),
    )
