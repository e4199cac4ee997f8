"""Shift and delay of depth from score maps with planted ones."""

from __future__ import annotations

import numpy as np
import pytest

from bmask_slam.graph.calibration.registration import EdgeScores, register, strength_of

RADIUS, STEP_PX = 20, 2.0


def _scores(shift_px, delay_s, frames=24, flow_px_s=250.0, seed=0) -> EdgeScores:
    """Maps with a peak at shift - flow (lag + delay), and noise."""
    rng = np.random.default_rng(seed)
    flow = rng.normal(0, flow_px_s, (frames, 2))
    lags_s = rng.uniform(-0.01, 0.01, frames)
    peaks = (np.asarray(shift_px) - flow * (lags_s + delay_s)[:, None]) / STEP_PX
    v, u = np.indices((2 * RADIUS + 1,) * 2) - RADIUS
    square = (u - peaks[:, 0, None, None]) ** 2 + (v - peaks[:, 1, None, None]) ** 2
    scores = np.exp(-square / 4) + rng.normal(0, 0.2, (frames, *u.shape))
    return EdgeScores(scores, STEP_PX, flow, lags_s)


@pytest.mark.parametrize("delay_s", [-0.03, 0.0, 0.02])
def test_a_planted_shift_and_delay_are_found_within_their_bounds(delay_s: float) -> None:
    found = register(_scores((12.0, -5.0), delay_s))
    assert found is not None
    assert (np.abs(found.shift_px - (12.0, -5.0)) < np.maximum(4 * found.shift_sigma_px, 0.6)).all()
    assert found.delay_s == pytest.approx(delay_s, abs=max(4 * found.delay_sigma_s, 0.003))
    assert found.delay_sigma_s < 0.004 and found.strength > 6


def test_a_camera_at_rest_does_not_show_the_delay() -> None:
    found = register(_scores((3.0, 0.0), 0.03, flow_px_s=0.0))
    assert found is not None
    assert found.shift_px == pytest.approx((3.0, 0.0), abs=0.6)
    assert found.delay_s != pytest.approx(0.03, abs=0.01) or found.delay_sigma_s > 0.01


def test_few_frames_and_noise_alone_show_nothing() -> None:
    assert register(_scores((0.0, 0.0), 0.0, frames=5)) is None
    noise = np.random.default_rng(1).normal(0, 1, (2 * RADIUS + 1,) * 2)
    assert strength_of(noise) < 5
