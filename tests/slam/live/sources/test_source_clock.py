"""Stamps of a source whose clock jumps."""

from __future__ import annotations

import math

import numpy as np
import pytest

from bmask_slam.graph.errors import InputError
from bmask_slam.live.sources.source_clock import SourceClock

STEP_S = 1 / 30


def used(stamps_s) -> dict[int, float]:
    """What becomes of the stamps that are not refused, by their place."""
    clock, kept = SourceClock(), {}
    for place, stamp_s in enumerate(stamps_s):
        try:
            kept[place] = clock.checked(stamp_s)
        except InputError:
            continue
        clock.used(kept[place])
    return kept


@pytest.mark.parametrize("wrong", [math.inf, math.nan, 1e4 + 3600.0, 1e4 - 3600.0, 0.0, "1"])
def test_one_wrong_stamp_costs_one_frame(wrong) -> None:
    right = (1e4 + STEP_S * np.arange(20)).tolist()
    kept = used([*right[:10], wrong, *right[11:]])
    assert kept == {k: stamp_s for k, stamp_s in enumerate(right) if k != 10}


@pytest.mark.parametrize("back_s", [0.2, 1.0, 3600.0])
def test_a_clock_that_is_set_back_costs_one_frame(back_s: float, caplog) -> None:
    before = 1e4 + STEP_S * np.arange(10)
    kept = used([*before, *(before + 10 * STEP_S - back_s)])
    assert set(range(20)) - kept.keys() == {10}
    assert list(kept.values())[10:] == pytest.approx((before + 10 * STEP_S)[1:], abs=1e-6)
    (warning,) = caplog.messages
    assert f"went back: {back_s:.3f} s are added" in warning


def test_a_pause_costs_one_frame_and_keeps_the_stamps() -> None:
    stamps = [0.0, STEP_S, 600.0, 600.0 + STEP_S, 600.0 + 2 * STEP_S]
    assert list(used(stamps).values()) == [*stamps[:2], *stamps[3:]]


def test_the_refusal_names_both_stamps() -> None:
    clock = SourceClock()
    clock.used(clock.checked(5.0))
    with pytest.raises(InputError, match=r"frame at 4.5: not later than the frame before, at 5.0"):
        clock.checked(4.5)
    with pytest.raises(InputError, match=r"frame at inf: the stamp is not a finite number"):
        clock.checked(math.inf)
