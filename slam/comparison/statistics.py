"""Statistics of a comparison: summaries over seeds, and tests whether a method is better.

Two methods are compared in pairs, on the same images. Each seed of a rendered sequence has other
images and gives a pair; the seeds of a recorded one share their images and give one pair, of the
medians. Verdicts hold for these sequences only.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from math import comb, isfinite, isnan, nan
from statistics import fmean, median

import numpy as np

from bmask_slam.comparison.experiment.experiment import VERDICT_METRICS
from bmask_slam.comparison.experiment.result import (
    MIN_COVERAGE,
    Cell,
    CellStatus,
    Comparison,
    Kind,
    Method,
)
from bmask_slam.graph.arrays import Array
from bmask_slam.reporting.metric_table import BY_NAME

LEVEL = 0.05
RESAMPLES = 10_000
FEWER_TRACKED = 0.01
BETTER, WORSE, NO_DIFFERENCE = "better", "worse", "no difference shown"
NOT_COMPARED = "not compared"
TRACKED = "tracked_share"
ERRORS = ("ate_", "rpe_", "drift_")
TOO_FEW = "too few pairs for a verdict"
FEW_PAIRS = f"Verdicts: {TOO_FEW}; more seeds or sequences give more pairs"


@dataclass(frozen=True)
class Summary:
    """Median, range and number of values of a metric over the cells that are done."""

    median: float
    low: float
    high: float
    count: int


@dataclass(frozen=True)
class Verdict:
    """A method compared with the baseline in a metric.

    Attributes:
        metric, method, baseline: names.
        judgement: BETTER or WORSE than the baseline, if the interval excludes 0 and the sign test
            agrees, else NO_DIFFERENCE; NOT_COMPARED if it covers too little of each sequence.
        difference: mean of method minus baseline over the pairs, in the unit of metrics.json;
            NaN without a pair.
        low, high: 95 % bootstrap interval of it.
        pairs: compared; wins: those in which the method is better; losses: worse.
        incomplete: pairs in which one method has no value, as when its run failed or lost the way.
        p_value: of the exact two-sided sign test, after Holm's correction for all that is judged.
        note: a remark to print with it.
    """

    metric: str
    method: str
    baseline: str
    judgement: str
    difference: float
    low: float
    high: float
    pairs: int
    wins: int
    losses: int
    incomplete: int
    p_value: float
    note: str = ""


def summarise(cells: Iterable[Cell], metric: str) -> Summary | None:
    """A metric's median and range; None where no cell that is done has it."""
    values = [v for v in (value_of(cell, metric) for cell in cells) if isfinite(v)]
    return Summary(median(values), min(values), max(values), len(values)) if values else None


def verdicts(comparison: Comparison, metrics: Sequence[str] | None = None) -> tuple[Verdict, ...]:
    """Compare every other method that was evaluated here with the first configuration.

    ``metrics`` None: those that the experiment names. Methods with another alignment (Sim(3)) are
    excluded, as are metrics that the two methods do not share.
    """
    if metrics is None:
        stated = comparison.provenance.get("experiment", {}).get("verdicts", VERDICT_METRICS)
        metrics = tuple(stated)
    rows = [m for m in comparison.methods if m.kind is not Kind.PUBLISHED]
    if not rows or rows[0].kind is not Kind.RUN:
        return ()
    others = [m for m in rows[1:] if m.with_scale == rows[0].with_scale]
    found = [_verdict(comparison, rows[0], m, metric) for metric in metrics for m in others]
    lost = (v for v in found if not v.pairs and v.note and v.metric.startswith(ERRORS))
    judged = _corrected([v for v in found if v.pairs])
    return (*judged, *(replace(v, judgement=NOT_COMPARED) for v in lost))


def too_few(found: Sequence[Verdict]) -> bool:
    """Whether there are verdicts, and each has too few pairs to be significant."""
    return bool(found) and all(TOO_FEW in v.note or v.judgement == NOT_COMPARED for v in found)


def pairs(
    comparison: Comparison, methods: tuple[str, str], metric: str
) -> tuple[Array, Array, int]:
    """Values (N,) of two methods on the same images, and the number of incomplete pairs."""
    values: list[tuple[float, float]] = []
    for sequence in comparison.sequences:
        cells = [list(comparison.of(sequence, method)) for method in methods]
        if not all(cells):
            continue
        if sequence in comparison.drawn:
            by_seed = [{c.seed: value_of(c, metric) for c in own} for own in cells]
            values += [(by_seed[0][s], by_seed[1][s]) for s in by_seed[0] if s in by_seed[1]]
        else:
            medians = [summarise(own, metric) for own in cells]
            values.append(tuple(s.median if s else nan for s in medians))  # type: ignore[arg-type]
    table = np.array(values, float).reshape(-1, 2)
    complete = np.isfinite(table).all(axis=1)
    return table[complete, 0], table[complete, 1], int((~complete).sum())


def value_of(cell: Cell, metric: str) -> float:
    """A cell's value to compare: NaN where it has none, is not done, or covers too little.

    A trajectory with less than MIN_COVERAGE of the sequence may lack just its hard parts: no error
    of it is compared.
    """
    lacks = metric.startswith(ERRORS) and cell.coverage < MIN_COVERAGE
    return cell.metrics.get(metric, nan) if cell.status is CellStatus.DONE and not lacks else nan


def bootstrap_interval(differences: Array, level: float = LEVEL) -> tuple[float, float]:
    """Percentile interval of the mean of differences (N,), by resampling the pairs.

    Efron & Tibshirani 1993, ch. 13. The same differences give the same interval.
    """
    count = len(differences)
    if not count:
        return nan, nan
    chosen = np.random.default_rng(0).integers(0, count, (RESAMPLES, count))
    means = differences[chosen].mean(axis=1)
    low, high = np.quantile(means, (level / 2, 1 - level / 2))
    return float(low), float(high)


def sign_test(wins: int, losses: int) -> float:
    """Two-sided p-value of the exact sign test for numbers of wins and losses, without ties."""
    count = wins + losses
    tail = sum(comb(count, k) for k in range(min(wins, losses) + 1))
    return float(min(1.0, 2 * tail / 2**count))


def holm(p_values: Sequence[float]) -> list[float]:
    """Corrected p-values (Holm 1979), in their order; they bound the family-wise error rate."""
    order = sorted(range(len(p_values)), key=lambda k: p_values[k])
    corrected, highest = [0.0] * len(p_values), 0.0
    for rank, k in enumerate(order):
        highest = max(highest, min(1.0, (len(p_values) - rank) * p_values[k]))
        corrected[k] = highest
    return corrected


def _verdict(comparison: Comparison, base: Method, method: Method, metric: str) -> Verdict:
    """A verdict with the uncorrected p-value, without a judgement."""
    base_values, values, incomplete = pairs(comparison, (base.name, method.name), metric)
    difference = values - base_values
    sign = -1 if BY_NAME[metric].lower_is_better else 1
    wins, losses = int((sign * difference > 0).sum()), int((sign * difference < 0).sum())
    low, high = bootstrap_interval(difference)
    return Verdict(
        metric,
        method.name,
        base.name,
        NO_DIFFERENCE,
        float(difference.mean()) if len(difference) else nan,
        low,
        high,
        len(difference),
        wins,
        losses,
        incomplete,
        sign_test(wins, losses),
        _note(comparison, base, method),
    )


def _corrected(found: list[Verdict]) -> tuple[Verdict, ...]:
    """The verdicts with corrected p-values and judgements."""
    corrected = holm([v.p_value for v in found])
    judged = (replace(v, p_value=p) for v, p in zip(found, corrected, strict=True))
    return tuple(replace(v, judgement=_judgement(v), note=_note_with_count(v)) for v in judged)


def _note_with_count(verdict: Verdict) -> str:
    """The note; it also states if no outcome of so few pairs could be significant."""
    few = sign_test(verdict.pairs, 0) > LEVEL
    return "; ".join(filter(None, [TOO_FEW if few else "", verdict.note]))


def _judgement(verdict: Verdict) -> str:
    """BETTER or WORSE if interval and sign test are significant in the same direction."""
    sign = -1 if BY_NAME[verdict.metric].lower_is_better else 1
    if verdict.p_value > LEVEL or isnan(verdict.low) or verdict.low <= 0 <= verdict.high:
        return NO_DIFFERENCE
    by_mean, by_signs = sign * verdict.low > 0, verdict.wins > verdict.losses
    if by_mean != by_signs:
        return NO_DIFFERENCE
    return BETTER if by_mean else WORSE


def _note(comparison: Comparison, base: Method, method: Method) -> str:
    """A remark if a method tracks less of a sequence, which may exclude its hard parts."""
    base_shares, shares, _ = pairs(comparison, (base.name, method.name), TRACKED)
    if not len(shares) or abs(fmean(shares) - fmean(base_shares)) < FEWER_TRACKED:
        return ""
    return f"tracks {100 * fmean(shares):.0f} % against {100 * fmean(base_shares):.0f} %"
