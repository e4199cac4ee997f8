"""Depth between two depth images."""

from __future__ import annotations

import numpy as np

from bmask_slam.sequences.images import depth_between


def test_a_plane_that_moves_is_between_its_depths() -> None:
    u = np.arange(8, dtype=np.float32)
    inverse = [0.5 + 0.01 * u, 0.52 + 0.01 * u]  # the plane's inverse depth, linear in u and t
    near_m, other_m = (np.float32(1)[None] / i[None].astype(np.float32) for i in inverse)
    between = depth_between(near_m, other_m, 0.25)
    np.testing.assert_allclose(between, 1 / (0.505 + 0.01 * u)[None], rtol=1e-6)


def test_where_the_surface_changes_the_depth_is_not_known() -> None:
    near_m = np.array([[1.0, 1.0, np.nan, 1.0]], np.float32)
    other_m = np.array([[3.0, np.nan, 1.0, 1.001]], np.float32)
    between = depth_between(near_m, other_m, 0.4)
    np.testing.assert_allclose(between, [[np.nan, 1.0, np.nan, 1.0004]], atol=1e-4)
