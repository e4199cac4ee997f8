"""Arithmetic on images against loops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from surface_scene import CAMERA

from bmask_slam.graph.camera import DepthNoise
from bmask_slam.mapping.inverse_depth.depth_map import (
    MeasurementConfig,
    from_sensor,
)
from bmask_slam.mapping.inverse_depth.pixelwise import (
    COMPATIBLE,
    agreement,
    nan_where_negative,
    windowed,
)


def test_negative_margins_become_nan() -> None:
    margin = torch.tensor([2.0, 0.0, -0.0, -1e-6, torch.nan, -torch.inf])
    np.testing.assert_array_equal(nan_where_negative(margin).numpy(), [0, 0, 0, *[np.nan] * 3])


@pytest.mark.parametrize("radius", [1, 2])
@pytest.mark.parametrize(("combine", "slow", "beyond"), [
    (torch.add, np.sum, 0.0), (torch.maximum, np.max, -np.inf), (torch.minimum, np.min, 3.0),
])  # fmt: skip
def test_windows(radius: int, combine, slow, beyond: float) -> None:
    values = np.random.default_rng(0).normal(0, 1, (2, 7, 9)).astype(np.float32)
    padded = np.pad(values, ((0, 0), (radius,) * 2, (radius,) * 2), constant_values=beyond)
    size = 2 * radius + 1
    expected = [
        [[slow(p[r : r + size, c : c + size]) for c in range(9)] for r in range(7)] for p in padded
    ]
    found = windowed(combine, torch.from_numpy(values), radius, beyond)
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-5, atol=1e-5)


def test_two_estimates_agree_below_the_bound() -> None:
    bound = np.float32(COMPATIBLE)
    squared = torch.tensor([0.0, np.nextafter(bound, np.float32(0)), bound, 1e12, np.inf])
    found = agreement(torch.ones(5), squared, 8.0)
    np.testing.assert_array_equal(found.numpy(), [8, 8, 0, 0, 0])


def test_the_variance_is_that_of_the_cameras_depth() -> None:
    """sigma_rho = sigma_z / z^2 on a frontal plane, or by a constant error of the disparity."""
    camera = replace(CAMERA, depth_noise=DepthNoise(0.003, 0.002, 0.001))
    depth_m = np.full((5, 5), 2.0, np.float32)
    found = from_sensor(depth_m, camera, MeasurementConfig()).variance.numpy()
    np.testing.assert_allclose(found, ((0.003 + 0.004 + 0.004) / 4) ** 2, rtol=1e-6)
    by_disparity = MeasurementConfig(disparity_sigma_px=0.2)
    found = from_sensor(depth_m, camera, by_disparity).variance.numpy()
    np.testing.assert_allclose(found, (0.2 / camera.stereo_bf_px_m) ** 2, rtol=1e-6)


def test_sensor_depth_is_used_within_its_range() -> None:
    depth_m = np.full((5, 5), 2.0, np.float32)
    depth_m[0] = 0.0, 0.29, 8.01, np.nan, np.inf
    given = from_sensor(depth_m, CAMERA, MeasurementConfig())
    np.testing.assert_array_equal(given.known.numpy(), depth_m == 2)
    np.testing.assert_array_equal(np.isnan(given.variance.numpy()), depth_m != 2)
    np.testing.assert_allclose(given.rho.numpy()[1:], 0.5)
