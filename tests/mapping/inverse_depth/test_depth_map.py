"""Inverse-depth maps in files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from surface_scene import as_map

from bmask_slam.mapping.inverse_depth.depth_map import (
    RHO_STEP,
    SIGMA_STEP,
    read_depth_map,
    write_depth_map,
)


def test_a_map_is_read_back_to_half_a_step(tmp_path: Path) -> None:
    rho = np.random.default_rng(0).uniform(0.1, 4.0, (5, 7))
    rho[2, 3] = np.nan
    given = as_map(rho, np.where(rho > 1, 0.002, 0.05))
    write_depth_map(tmp_path / "a", given)
    found = read_depth_map(tmp_path / "a")
    np.testing.assert_allclose(found.rho, given.rho, atol=0.51 * RHO_STEP)
    np.testing.assert_allclose(found.variance.sqrt(), given.variance.sqrt(), atol=0.51 * SIGMA_STEP)


def test_what_is_too_near_for_the_file_is_unknown_in_it(tmp_path: Path) -> None:
    """Not at the nearest depth that the file holds."""
    write_depth_map(tmp_path / "a", as_map([[1 / 0.24, 1 / 0.25, 1 / 0.1, 1.0]], 0.01))
    depth_m = read_depth_map(tmp_path / "a").depth_m()
    np.testing.assert_allclose(depth_m, [[np.nan, 0.25, np.nan, 1.0]], rtol=1e-4)
