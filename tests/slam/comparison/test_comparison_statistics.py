"""Verdicts on two methods: tests against simple references, and the rate of false ones."""

import re
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.stats import binomtest

from bmask_slam.comparison.experiment.result import Cell, CellStatus, Comparison, Kind, Method
from bmask_slam.comparison.statistics import (
    BETTER,
    NO_DIFFERENCE,
    NOT_COMPARED,
    WORSE,
    bootstrap_interval,
    holm,
    pairs,
    sign_test,
    summarise,
    verdicts,
)
from bmask_slam.comparison.text import format_verdicts

SEQUENCES = ("a", "b", "c", "d", "e", "f")
METHODS = (Method("default", Kind.RUN), Method("other", Kind.RUN))


def comparison(values: np.ndarray, drawn: tuple[str, ...] = SEQUENCES) -> Comparison:
    """ATE by method, sequence and seed (2, 6, S); NaN for a cell that failed."""
    cells = tuple(
        Cell(SEQUENCES[j], METHODS[i].name, k, CellStatus.DONE, {"ate_rmse": float(value)})
        if np.isfinite(value)
        else Cell(SEQUENCES[j], METHODS[i].name, k, CellStatus.FAILED)
        for (i, j, k), value in np.ndenumerate(values)
    )
    origin = {"experiment": {"verdicts": ["ate_rmse"]}}
    return Comparison("x", "", "", SEQUENCES, METHODS, cells, origin, drawn)


def noise(seed: int, seeds: int = 3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.lognormal(-4, 0.5, (1, 6, 1)) * rng.lognormal(0, 0.2, (2, 6, seeds))


def test_sign_test_equals_enumeration_and_scipy():
    for count in range(1, 9):
        for wins in range(count + 1):
            least = min(wins, count - wins)
            outcomes = [sum(signs) for signs in product((0, 1), repeat=count)]
            as_far = sum(min(o, count - o) <= least for o in outcomes) / 2**count
            assert sign_test(wins, count - wins) == pytest.approx(as_far)
            assert sign_test(wins, count - wins) == pytest.approx(binomtest(wins, count).pvalue)
    assert sign_test(0, 0) == 1
    assert sign_test(0, 5) > 0.05 >= sign_test(0, 6)


def test_bootstrap_equals_a_loop_and_is_near_the_normal_interval():
    rng = np.random.default_rng(3)
    differences = rng.normal(1.0, 2.0, 200)
    means = [rng.choice(differences, 200).mean() for _ in range(4000)]
    low, high = bootstrap_interval(differences)
    assert (low, high) == pytest.approx(np.quantile(means, (0.025, 0.975)), abs=0.03)
    sigma = differences.std(ddof=1) / np.sqrt(200)
    assert high - low == pytest.approx(2 * 1.96 * sigma, rel=0.05)
    assert bootstrap_interval(differences) == (low, high)


def test_bootstrap_covers_the_truth():
    rng = np.random.default_rng(4)
    covered = [
        low <= 0.5 <= high
        for low, high in (bootstrap_interval(rng.normal(0.5, 1, 18)) for _ in range(200))
    ]
    assert np.mean(covered) > 0.87  # the percentile interval of 18 is a little short of 0.95


def test_holm_equals_a_manual_result():
    assert holm([0.01, 0.04, 0.03, 0.5]) == pytest.approx([0.04, 0.09, 0.09, 0.5])
    assert holm([]) == []


def test_noise_gives_no_verdict():
    """Two methods with the same distribution: false verdicts are rarer than the level."""
    false = [verdicts(comparison(noise(seed)))[0].judgement != NO_DIFFERENCE for seed in range(300)]
    assert np.mean(false) <= 0.05


@pytest.mark.parametrize(("factor", "judgement"), [(0.7, BETTER), (1.5, WORSE)])
def test_a_difference_is_found(factor, judgement):
    values = noise(1)
    values[1] = values[0] * factor
    (verdict,) = verdicts(comparison(values))
    assert (verdict.judgement, verdict.pairs) == (judgement, 18)
    assert verdict.difference == pytest.approx((factor - 1) * values[0].mean())
    assert (verdict.wins, verdict.losses) == ((18, 0) if factor < 1 else (0, 18))


def test_one_outlier_gives_no_verdict():
    values = np.full((2, 6, 3), 0.01)
    values[0] += noise(2)[0] / 100
    values[1] = values[0]
    values[1, 0, 0] = 5.0
    assert verdicts(comparison(values))[0].judgement == NO_DIFFERENCE


def test_too_few_pairs_are_noted():
    given = comparison(noise(3, 1), drawn=())
    assert verdicts(given)[0].note == ""
    few = replace(given, sequences=SEQUENCES[:5])
    assert verdicts(few)[0].note == "too few pairs for a verdict"


def test_a_method_that_tracks_less_is_noted():
    given = comparison(noise(4))
    cells = tuple(
        replace(c, metrics=c.metrics | {"tracked_share": 0.6 if c.method == "other" else 1.0})
        for c in given.cells
    )
    (verdict,) = verdicts(replace(given, cells=cells))
    assert verdict.note == "tracks 60 % against 100 %"
    assert (verdict.judgement, verdict.pairs) == (NOT_COMPARED, 0), "60 % may be the easy ones"


def test_the_verdicts_as_text():
    values = noise(1)
    values[1] = values[0] * 1.5
    head, _, line = format_verdicts(verdicts(comparison(values))).splitlines()
    assert head.startswith("Against default")
    assert re.match(
        r"ATE \(cm\)  other  worse  \+\d\.\d{3} \[\+.*\]  0 : 18 of 18  p = 7.6e-06$", line
    )


def test_seeds_of_a_recording_are_one_pair():
    """Otherwise a deterministic system would gain significance from repeated runs."""
    values = np.repeat(noise(5, 1), 9, axis=2)
    assert verdicts(comparison(values, drawn=()))[0].pairs == 6
    base_values, other_values, _ = pairs(
        comparison(values, ("a",)), ("default", "other"), "ate_rmse"
    )
    assert len(base_values) == 9 + 5
    assert (base_values[0], other_values[0]) == (values[0, 0, 0], values[1, 0, 0])


def test_a_failed_cell_is_an_incomplete_pair():
    values = noise(6)
    values[1, 2, 1] = np.nan
    (verdict,) = verdicts(comparison(values))
    assert (verdict.pairs, verdict.incomplete) == (17, 1)
    found = summarise(comparison(values).of("c", "other"), "ate_rmse")
    assert found.count == 2
    assert found.median == pytest.approx(values[1, 2, [0, 2]].mean())
    assert (found.low, found.high) == (values[1, 2, [0, 2]].min(), values[1, 2, [0, 2]].max())


def test_other_alignments_and_published_figures_are_not_compared():
    given = comparison(noise(7))
    for other in (Method("other", Kind.RUN, with_scale=True), Method("other", Kind.PUBLISHED)):
        assert verdicts(replace(given, methods=(METHODS[0], other))) == ()


def test_metrics_where_higher_is_better():
    values = noise(8)
    values[1] = values[0] * 1.5
    given = comparison(values)
    cells = tuple(replace(c, metrics={"tracked_share": c.metrics["ate_rmse"]}) for c in given.cells)
    (verdict,) = verdicts(replace(given, cells=cells), ["tracked_share"])
    assert verdict.judgement == BETTER
