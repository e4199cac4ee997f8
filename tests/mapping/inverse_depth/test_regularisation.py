"""Steps 3 and 5 against the formulas, pixel by pixel."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from surface_scene import as_map, compatible, largest_set, noisy_map, weighted

from bmask_slam.mapping.inverse_depth.depth_map import InverseDepthMap
from bmask_slam.mapping.inverse_depth.regularisation import OFFSETS, regularise, set_order

RNG = np.random.default_rng(3)


def reference(given: InverseDepthMap, fill_support: int):
    """Step 3 by its formulas."""
    rho, variance = (a.numpy().astype(float) for a in (given.rho, given.variance))
    out_rho, out_variance = np.full_like(rho, np.nan), np.full_like(rho, np.nan)
    height, width = rho.shape
    for v in range(height):
        for u in range(width):
            at = [(v + dy, u + dx) for dy, dx in OFFSETS]
            at = [(y, x) for y, x in at if 0 <= y < height and 0 <= x < width]
            r = [rho[v, u], *(rho[p] for p in at)]
            s = [variance[v, u], *(variance[p] for p in at)]
            if np.isfinite(rho[v, u]):
                chosen = [
                    k for k in range(1, len(r)) if np.isfinite(r[k]) and compatible(r, s, 0, k)
                ]
                chosen = [0, *chosen] if len(chosen) >= 2 else []
            else:
                chosen = [k + 1 for k in largest_set(r[1:], s[1:])]
                chosen = chosen if len(chosen) >= fill_support else []
            if chosen:
                out_rho[v, u] = weighted(r, s, chosen)
                out_variance[v, u] = min(s[k] for k in chosen)
    return out_rho, out_variance


@pytest.mark.parametrize("fill_support", [2, 5])
def test_the_result_equals_the_formulas(fill_support: int) -> None:
    given = noisy_map(RNG, np.eye(4), missing=0.25)
    rho, variance = reference(given, fill_support)
    result = regularise(given, fill_support)
    np.testing.assert_allclose(result.rho.numpy(), rho, rtol=1e-5)
    np.testing.assert_allclose(result.variance.numpy(), variance, rtol=1e-5)
    assert (np.isfinite(rho) & ~given.known.numpy()).sum() > 3
    assert (~np.isfinite(rho) & given.known.numpy()).sum() > 3


def test_noise_shrinks_and_the_variance_never_grows() -> None:
    truth = np.full((40, 50), 0.5)
    given = as_map(truth + RNG.normal(0, 0.004, truth.shape), 0.004)
    result = regularise(given)
    error = (result.rho.numpy() - truth)[2:-2, 2:-2]
    assert np.nanstd(error) < 0.6 * 0.004
    assert np.nanmax(result.variance.numpy()) <= 0.004**2 * (1 + 1e-5)


def test_a_step_stays_sharp() -> None:
    truth = np.full((20, 20), 0.5)
    truth[:, 10:] = 0.8
    result = regularise(as_map(truth, 0.005)).rho.numpy()
    np.testing.assert_allclose(result, truth, rtol=1e-6)


def test_an_isolated_pixel_is_removed_and_a_hole_is_filled() -> None:
    rho = np.full((9, 9), 0.5)
    rho[2, 2], rho[6, 6] = 0.9, np.nan
    result = regularise(as_map(rho, 0.005)).rho.numpy()
    assert np.isnan(result[2, 2])
    assert result[6, 6] == pytest.approx(0.5)


def test_an_empty_map_stays_empty() -> None:
    empty = torch.full((6, 7), torch.nan)
    assert not regularise(InverseDepthMap(empty, empty)).known.any()


def test_larger_sets_are_preferred_then_earlier_members() -> None:
    assert set_order(3) == [0b111, 0b011, 0b101, 0b110]
