"""Calibrations from some of the keyframes, evaluated on the others."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from calibration_scene import PRIORS, TRUTH, make_problem

from bmask_slam.graph.calibration.cross_validation import cross_validate
from bmask_slam.graph.calibration.model import OFFSET, SHUTTER, TIME

TIMES_ONLY = np.where(np.isin(np.arange(18), (TIME, SHUTTER)), PRIORS, 0.0)
ROLLING = np.where(np.arange(18) == SHUTTER, 0.020, TRUTH)


def _problem(truth, start, still_from=None):
    problem, _, _ = make_problem(
        truth=truth, start=start, noise=1.0, keyframes=20, still_from=still_from
    )
    return dataclasses.replace(problem, prior_sigmas=TIMES_ONLY)


@pytest.mark.parametrize("alternately", [False, True])
def test_both_halves_confirm_a_rolling_shutter(alternately: bool) -> None:
    none = np.where(np.arange(18) == SHUTTER, 0.0, ROLLING)
    found = cross_validate(_problem(ROLLING, none), alternately=alternately)
    assert found is not None and len(found.calibrations) == 2
    error = found.calibrations - ROLLING
    assert (np.abs(error)[:, SHUTTER] < 4 * found.sigmas[:, SHUTTER]).all()
    assert (found.calibrations[:, SHUTTER] > 0.018).all()  # and not -0.020
    assert (found.calibrations[:, OFFSET] == ROLLING[OFFSET]).all()
    assert len(found.gains) == 20 and found.gain_sigmas > 4


@pytest.mark.parametrize("alternately", [False, True])
def test_a_correct_camera_is_not_improved(alternately: bool) -> None:
    found = cross_validate(_problem(ROLLING, ROLLING), alternately=alternately)
    assert found is not None
    assert found.gain_sigmas < 2
    error = np.abs(found.calibrations - ROLLING)[:, SHUTTER]
    assert (error < 4 * found.sigmas[:, SHUTTER]).all()
    assert error.max() < (0.0015 if alternately else 0.001)


def test_a_delay_is_confirmed_although_it_hides_in_the_noise_of_depth() -> None:
    """With the wrong delay the noise that depths seem to have is larger."""
    on_time = np.where(np.arange(18) == TIME, TRUTH[TIME] - 0.004, TRUTH)
    found = cross_validate(_problem(TRUTH, on_time))
    assert found is not None
    error = np.abs(found.calibrations - TRUTH)[:, TIME]
    assert (error < 4 * found.sigmas[:, TIME]).all()
    z = 0.004 / found.sigmas[:, TIME]
    assert found.gains.sum() > 0.35 * (z**2).sum()  # each half's cost drops by z^2 / 2


@pytest.mark.parametrize(("alternately", "found"), [(False, [True, False]), (True, [True, True])])
def test_what_the_last_half_of_a_run_does_not_show(alternately: bool, found: list[bool]) -> None:
    """A readout time while the camera stands still is known to every second keyframe together."""
    none = np.where(np.arange(18) == SHUTTER, 0.0, ROLLING)
    proof = cross_validate(_problem(ROLLING, none, still_from=10), alternately=alternately)
    assert proof is not None
    assert (np.abs(proof.calibrations - ROLLING)[:, SHUTTER] < 0.002).tolist() == found
    assert (proof.gain_sigmas > 2) is alternately


def test_what_is_fitted_along_is_no_gain() -> None:
    """Focal lengths 2 % off, the times right: only the focal lengths are to be changed."""
    off = np.where(np.arange(18) < 2, 1.02 * ROLLING, ROLLING)
    problem, _, _ = make_problem(truth=ROLLING, start=off, noise=1.0, keyframes=20)
    along = np.where(np.arange(18) < 2, 0.02 * ROLLING, TIMES_ONLY)
    problem = dataclasses.replace(problem, prior_sigmas=along)
    whole, times = cross_validate(problem), cross_validate(problem, (TIME, SHUTTER))
    assert whole is not None and times is not None
    assert whole.gain_sigmas > 4 and abs(times.gain_sigmas) < 2
    assert np.abs(times.calibrations - ROLLING)[:, SHUTTER].max() < 0.001


def test_too_few_keyframes_give_no_result() -> None:
    assert cross_validate(make_problem(keyframes=8)[0]) is None
