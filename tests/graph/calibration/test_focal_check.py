"""Focal lengths that contradict the motion."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from calibration_scene import TRUTH, make_problem

from bmask_slam.graph.calibration.focal_check import FocalCheck, check_focal

EXACT = np.where(np.isin(np.arange(18), (10, 11)), 0.0, TRUTH)
"""Without offset and delay, which the check does not estimate."""


def _problem(share: float, keyframes: int = 24):
    """Views by a camera whose focal lengths are larger by a share than the problem's."""
    start = EXACT.copy()
    start[:2] /= 1 + share
    problem, _, _ = make_problem(truth=EXACT, start=start, noise=1.0, keyframes=keyframes)
    views = dataclasses.replace(
        problem.views,
        inverse_depth_rate=np.zeros(len(problem.views.pixels)),
        lag_s=np.zeros(len(problem.views.pixels)),
    )
    return dataclasses.replace(problem, views=views)


@pytest.mark.parametrize("share", [0.03, -0.03])
def test_a_wrong_focal_length_is_found_with_its_sign(share: float) -> None:
    found = check_focal(_problem(share))
    assert found is not None
    assert found.change == pytest.approx(share, abs=max(4 * found.sigma, 0.003))
    assert np.sign(found.halves).tolist() == [np.sign(share)] * 2
    assert found.surely_beyond(0.015)


def test_a_right_focal_length_is_not_contradicted() -> None:
    found = check_focal(_problem(0.0))
    assert found is not None
    assert abs(found.change) < 0.003 and not found.surely_beyond(0.015)


def test_few_keyframes_show_nothing() -> None:
    assert check_focal(_problem(0.03, keyframes=10)) is None


@pytest.mark.parametrize(
    "check",
    [
        FocalCheck(0.03, 0.01, (0.03, 0.03)),  # its bounds reach the limit
        FocalCheck(0.05, 0.005, (0.11, -0.01)),  # one half says the opposite
        FocalCheck(0.05, 0.005, (0.05, float("nan"))),  # one half is too small
    ],
)
def test_what_is_not_sure_is_not_beyond(check: FocalCheck) -> None:
    assert not check.surely_beyond(0.015)
    assert FocalCheck(-0.05, 0.005, (-0.05, -0.04)).surely_beyond(0.015)
