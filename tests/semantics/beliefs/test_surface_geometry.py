"""What heights and slopes tell about the class of a surface."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from bmask_slam.graph.geometry import se3_exp
from bmask_slam.semantics.beliefs.surface_geometry import (
    DOWN,
    SLANTED,
    UP,
    UPRIGHT,
    find_ground,
    log_likelihoods,
    slope,
    with_evidence,
)
from bmask_slam.semantics.labels import read_label_set

NAMES = read_label_set("nyu40")
WALL, FLOOR, TABLE, CEILING = (NAMES.number(n) - 1 for n in ("wall", "floor", "table", "ceiling"))


def room(T: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points that look like floor (on it, and fewer on a table), cameras, and up, moved by T."""
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-2, 2, (300, 2)), rng.normal(-1.5, 0.01, 300)])
    top = np.column_stack([rng.uniform(-1, 1, (400, 2)), rng.normal(-0.75, 0.01, 400)])
    cameras = np.column_stack([rng.uniform(-1, 1, (9, 2)), np.full(9, 0.1)])
    R = T[:3, :3]
    points = np.concatenate([floor, top]) @ R.T + T[:3, 3]
    return points, cameras @ R.T + T[:3, 3], R @ [0, 0, 1]


@pytest.mark.parametrize("turn", [np.zeros(6), np.array([0.4, -1.0, 2.0, 3.0, -1.0, 0.5])])
def test_the_ground_is_the_lowest_of_what_looks_like_it(turn: np.ndarray) -> None:
    points, cameras, up = room(se3_exp(turn))
    ground = find_ground(points, cameras, up)
    assert ground is not None
    heights = ground.heights_m(points)
    assert np.median(heights[:300]) == pytest.approx(0.0, abs=0.01)
    assert np.median(heights[300:]) == pytest.approx(0.75, abs=0.01)


@pytest.mark.parametrize("stray_m", [1e6, -1e6, 1e30, np.inf])
def test_stray_points_far_away_are_no_ground(stray_m: float) -> None:
    """Heights are counted in bins, of which a point at 1000 km would need millions."""
    points, cameras, up = room(np.eye(4))
    strays = np.column_stack([np.zeros((20, 2)), np.full(20, stray_m)])
    clean = find_ground(points, cameras, up)
    tracemalloc.start()
    ground = find_ground(np.concatenate([points, strays]), cameras, up)
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak_bytes < 1e6
    assert clean is not None
    assert ground is not None
    assert ground.floor_m == pytest.approx(clean.floor_m, abs=1e-9)


def test_a_table_below_the_camera_is_no_ground() -> None:
    points, cameras, up = room(np.eye(4))
    low = cameras - [0, 0, 0.4]
    assert find_ground(points[300:], low, up) is None
    assert find_ground(points[:10], cameras, up) is None


def test_a_table_top_that_looks_like_floor_is_a_table() -> None:
    p = np.full((3, 39), 0.15 / 37)
    p[:, FLOOR], p[:, TABLE] = 0.6, 0.25
    found = with_evidence(p, log_likelihoods(NAMES, np.array([0.0, 0.75, 2.0])))
    assert found.sum(axis=1) == pytest.approx(1.0)
    assert found[0].argmax() == FLOOR
    assert found[0, FLOOR] > 2.5 * found[0, TABLE]
    assert found[1].argmax() == TABLE
    assert found[2, FLOOR] < 0.2  # neither: not sure


def test_slopes_have_the_sign_of_up() -> None:
    cosines = np.array([1.0, 0.1, -1.0, 0.6])
    assert slope(cosines).tolist() == [UP, UPRIGHT, DOWN, SLANTED]
    p = np.full((4, 39), 1 / 39)
    found = with_evidence(p, log_likelihoods(NAMES, np.array([0.0, 1.5, 2.4, 1.5]), cosines))
    assert found[0].argmax() == FLOOR
    assert found[1, WALL] > 2 * found[1, CEILING]
    assert found[2, CEILING] > 1.5 * found[2, WALL]
