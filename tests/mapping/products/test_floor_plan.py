"""The floor plan of a box-shaped room with a table, and pictures of points."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import make_pose, so3_exp
from bmask_slam.mapping.products.cloud import Cloud
from bmask_slam.mapping.products.floor_plan import (
    FloorPlan,
    PlanFrame,
    floor_height,
    plan_frame,
    up_direction,
)
from bmask_slam.mapping.products.pictures import (
    EMPTY,
    nearest_points,
    painted,
    palette,
    with_legend,
)

RNG = np.random.default_rng(4)


def room(R: np.ndarray) -> Cloud:
    """A floor of 4 by 3 m at height 0, two walls, and a table (label 1) at 0.7 m; z is up."""
    parts = []
    for size, start, axes, normal, label in (
        ((4, 3), (0, 0, 0), (0, 1), (0, 0, 1), 0),
        ((4, 2.5), (0, 3, 0), (0, 2), (0, -1, 0), 0),
        ((3, 2.5), (0, 0, 0), (1, 2), (1, 0, 0), 0),
        ((1.2, 0.6), (1, 1, 0.7), (0, 1), (0, 0, 1), 1),
    ):
        count = int(3000 * size[0] * size[1])
        points = np.tile(np.array(start, float), (count, 1))
        points[:, axes] += RNG.uniform(0, size, (count, 2))
        parts.append((points, np.tile(np.array(normal, float), (count, 1)), np.full(count, label)))
    points, normals, labels = (np.concatenate(a) for a in zip(*parts, strict=True))
    n = len(points)
    one = np.ones(n, np.float32)
    return Cloud(
        (points @ R.T).astype(np.float32),
        (normals @ R.T).astype(np.float32),
        np.full((n, 3), 9, np.uint8),
        one,
        labels.astype(np.uint16),
        one,
        one.astype(np.uint16),
    )


NAMES = ("background", "table", "cup")
TURN = so3_exp(np.array([1.3, 0.2, -0.4]))


@pytest.mark.parametrize("noise", [0.0, 0.15])
def test_walls_do_not_tilt_the_up_direction(noise: float) -> None:
    """A camera pitched down by 37 degrees: walls are only 53 degrees from its up axis."""
    given = room(TURN)
    normals = given.normals + noise * RNG.standard_normal(given.normals.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    guess = TURN @ np.array([0.42, -0.43, 0.8])
    frame = plan_frame(given.points, normals, guess, 0.05)
    tilt_deg = np.degrees(np.arccos(min(frame.axes[2] @ TURN[:, 2], 1.0)))
    assert tilt_deg < (0.01 if noise == 0 else 0.2)
    assert frame.floor_m == pytest.approx(0.0, abs=0.01)


def test_the_lowest_part_of_walls_alone_is_the_floor() -> None:
    """Not the height of the camera, where the world begins."""
    given = room(np.eye(3))
    walls = given.select(np.abs(given.normals[:, 2]) < 0.5)
    points = walls.points + np.array([0, 0, -1.2], np.float32)
    frame = plan_frame(points, walls.normals, np.array([0.0, 0, 1]), 0.05)
    np.testing.assert_allclose(frame.axes[2], [0, 0, 1], atol=1e-9)
    assert frame.floor_m == pytest.approx(-1.2, abs=0.06)


def test_up_is_found_from_a_tilted_initial_guess() -> None:
    guess = TURN @ np.array([0.4, -0.3, 1.0])
    np.testing.assert_allclose(up_direction(room(TURN).normals, guess), TURN[:, 2], atol=1e-5)


def test_the_floor_is_below_the_table() -> None:
    heights = np.concatenate([RNG.normal(0, 0.005, 5000), np.full(4000, 0.7)])
    assert floor_height(heights) == pytest.approx(0, abs=0.01)
    assert floor_height(np.zeros(0)) == 0.0


def test_cells_have_the_labels_of_the_points_above() -> None:
    cloud = room(TURN)
    frame = plan_frame(cloud.points, cloud.normals, TURN @ np.array([0.2, 0.1, 1.0]), 0.1)
    plan = FloorPlan(frame, NAMES)
    plan.add(cloud)
    path = np.array([[0.5, 0.5, 1.2], [3.5, 0.5, 1.2]]) @ TURN.T
    grid, line = plan.grid(path)
    assert sorted(grid.shape) == pytest.approx([31, 41], abs=1)
    assert (grid == 1).sum() == pytest.approx(72, abs=20)
    assert 70 - 12 < (grid == 0).sum() < 2 * 70 + 12  # a wall may lie between two cells
    assert (grid == -1).sum() > 950
    length = np.linalg.norm(line[1] - line[0])
    assert length == pytest.approx(30, rel=0.01)
    for column, row in line:
        assert grid[int(row), int(column)] == -1


def test_the_picture_includes_a_path_outside_the_map() -> None:
    cloud = room(np.eye(3))
    plan = FloorPlan(plan_frame(cloud.points, cloud.normals, np.array([0, 0, 1.0]), 0.05), NAMES)
    plan.add(cloud)
    image = plan.picture(np.array([[1.0, 1, 1], [6.0, 1, 1]]))
    red = (image == (220, 30, 30)).all(axis=2)
    grid, line = plan.grid(np.array([[1.0, 1, 1], [6.0, 1, 1]]))
    scale = round(900 / max(grid.shape))
    length = max(np.ptp(np.flatnonzero(red.any(axis=k))) for k in (0, 1))
    assert length == pytest.approx(scale * np.linalg.norm(line[1] - line[0]), abs=4)


def test_no_line_leads_where_the_path_begins_again() -> None:
    cloud = room(np.eye(3))
    plan = FloorPlan(plan_frame(cloud.points, cloud.normals, np.array([0, 0, 1.0]), 0.05), NAMES)
    plan.add(cloud)
    path = np.array([[1.0, 1, 1], [2.0, 1, 1], [5.0, 1, 1], [6.0, 1, 1]])
    red = [
        int((plan.picture(path, begins) == (220, 30, 30)).all(axis=2).sum())
        for begins in (None, np.array([2]))
    ]
    assert red[1] == pytest.approx(0.4 * red[0], rel=0.1)


def test_the_nearer_point_is_on_top() -> None:
    camera = Camera(20, 16, fx=20, fy=20, cx=10, cy=8)
    points = np.array([[0, 0, 0.0], [0, 0, 1.0], [0.1, 0, 0.0], [0, 0, -2.0]])
    colours = np.array([[1, 0, 0], [2, 0, 0], [3, 0, 0], [4, 0, 0]], np.uint8)
    seen = nearest_points(points, camera, make_pose(np.eye(3), np.array([0, 0, -1.0])), 0.01)
    image = painted(seen, colours)[:, :, 0]
    assert image[8, 10] == 1
    assert image[8, 12] == 3
    assert (image != EMPTY).sum() == 2


def test_labels_have_different_colours_and_a_legend() -> None:
    colours = palette([f"class {k}" for k in range(24)])
    assert len(np.unique(colours, axis=0)) == 24
    picture = with_legend(np.zeros((40, 30, 3), np.uint8), ["none", "chair", "desk"], [0, 2])
    assert picture.shape[1] == 30 + 190
    assert (picture.reshape(-1, 3) == colours[2]).all(axis=1).any()


def test_walls_are_those_of_the_labels_and_their_gaps_are_closed() -> None:
    """A wall with a gap of 0.2 m; what is labelled floor or ceiling is no obstacle."""
    names = ("background", "table", "wall", "ceiling", "floor")
    x = np.arange(0.0, 3.0, 0.02)
    x = x[(x < 1.0) | (x > 1.2)]
    wall = np.column_stack([x, np.full(len(x), 2.02), np.full(len(x), 2.2)])  # above 1.9 m
    hanging = np.array([[1.0, 1.0, 1.8]] * 9)
    low = np.array([[2.0, 1.0, 0.15]] * 9)  # a fold of the carpet
    points = np.concatenate([wall, hanging, low]).astype(np.float32)
    labels = np.repeat([2, 3, 4], [len(wall), 9, 9])
    ones = np.ones(len(points), np.float32)
    colours, views = np.zeros((len(points), 3), np.uint8), ones.astype(np.uint16)
    cloud = Cloud(points, points, colours, ones, labels.astype(np.uint16), ones, views)
    plan = FloorPlan(PlanFrame(np.eye(3), 0.0, 0.05), names)
    plan.add(cloud)
    grid, _ = plan.grid(np.array([[0.0, 0.0, 1.0], [3.0, 2.0, 1.0]]))
    assert np.unique(grid).tolist() == [-2, 2]
    row = np.flatnonzero((grid == 2).any(axis=1))
    assert len(row) == 1
    assert (grid[row[0]] == 2)[: round(2.95 / 0.05)].all()


@pytest.mark.parametrize("cell_m", [0.05, 0.06])
def test_closing_gaps_of_any_number_of_cells_leaves_a_wall_as_thick_as_it_is(cell_m: float) -> None:
    """Two walls of one cell, each with a gap of 0.2 m, that cross."""
    along = np.arange(0.5, 20) * cell_m
    along = along[(along < 0.4) | (along > 0.6)]
    wide = np.full(len(along), 15.5 * cell_m)
    xy = np.concatenate([np.column_stack([along, wide]), np.column_stack([wide, along])])
    points = np.column_stack([xy, np.ones(len(xy))]).astype(np.float32)
    ones = np.ones(len(points), np.float32)
    labels, colours = ones.astype(np.uint16), np.zeros((len(points), 3), np.uint8)
    plan = FloorPlan(PlanFrame(np.eye(3), 0.0, cell_m), ("background", "wall"))
    plan.add(Cloud(points, points, colours, ones, labels, ones, labels))
    grid, _ = plan.grid(np.zeros((1, 3)))
    expected = np.full((20, 20), -2)
    expected[20 - 1 - 15], expected[:, 15] = 1, 1
    np.testing.assert_array_equal(grid, expected)


def test_a_plan_takes_memory_for_what_stands_there_not_for_all_cells_and_classes() -> None:
    """Two walls, 20 m apart, and ninety classes."""
    points = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (1000, 1))
    points[:, 0] = np.linspace(0, 20, 1000)
    points[500:, 1] = 20.0
    one = np.ones(1000, np.float32)
    labels = (np.arange(1000) % 90).astype(np.uint16)
    colours, views = np.zeros((1000, 3), np.uint8), one.astype(np.uint16)
    walls = Cloud(points, points, colours, one, labels, one, views)
    plan = FloorPlan(PlanFrame(np.eye(3), 0.0, 0.03), [f"class {k}" for k in range(90)])
    plan.add(walls)
    tracemalloc.start()
    try:
        grid, _ = plan.grid(np.zeros((1, 3)))
        peak_bytes = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert grid.shape == (667, 667)
    assert len(np.unique(grid)) > 80
    assert peak_bytes < 20 * grid.nbytes
