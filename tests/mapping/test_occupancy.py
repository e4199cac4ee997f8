"""Free space and obstacles; the files are read back as nav2 and OctoMap read them."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from drive_map_files import load_nav2, load_octomap

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse, make_pose, se3_exp, transform
from bmask_slam.mapping.products import occupancy
from bmask_slam.mapping.products.occupancy import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
    VoxelCarver,
    VoxelMap,
    grid_of,
)
from bmask_slam.mapping.products.occupancy_files import write_nav2, write_octomap

CAMERA = Camera(64, 48, 40.0, 40.0, 31.5, 23.5)
R = 0.1
# Camera z is the map's x, camera x its -y, camera y its -z.
LOOKS_ALONG_X = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])


@pytest.fixture
def carved() -> VoxelMap:
    """A camera 1 m above the floor that looks along x at a wall 2 m away; the world is turned."""
    T_map_world = se3_exp(np.array([0.3, -0.2, 0.5, 1.0, 2.0, -1.0]))
    T_map_camera = make_pose(LOOKS_ALONG_X, np.array([0.05, 0.05, 1.05]))
    carver = VoxelCarver(R, T_map_world)
    T_world_camera = inverse(T_map_world) @ T_map_camera
    depth_m = np.full((48, 64), 2.0, np.float32)
    depth_m[:, :16] = np.nan  # nothing is known to the left
    carver.carve(depth_m, CAMERA, T_world_camera)
    y, z = np.meshgrid(np.arange(-1.0, 1.0, 0.02), np.arange(0, 2.0, 0.02))
    wall = np.stack([np.full(y.size, 2.06), y.ravel(), z.ravel()], axis=1)
    carver.add_surface(transform(inverse(T_map_world), wall))
    carver.add_surface(transform(inverse(T_map_world), np.array([[1.0, 0, 1.0]])))  # a stray point
    return carver.voxels()


def test_rays_free_what_lies_before_a_surface(carved: VoxelMap) -> None:
    state = {
        tuple(k): o for k, o in zip(carved.keys.tolist(), carved.occupied.tolist(), strict=True)
    }
    for x in range(1, 17):
        assert state[x, 0, 10] is False
    assert state[20, 0, 10] is True
    assert (22, 0, 10) not in state  # behind the wall
    assert (15, 7, 10) not in state  # without depth; y points to the left
    assert state[15, -5, 10] is False
    heights = [z for x, y, z in state if (x, y) == (10, 0)]
    assert min(heights) == pytest.approx(10.5 - 23.5 / 40 * 10, abs=1)  # of the lowest ray


def test_a_grid_is_free_where_the_floor_or_the_space_above_it_was_seen(carved: VoxelMap) -> None:
    grid = grid_of(carved, 0.1, 1.5)
    row, column = (0 - round(o / R) for o in (grid.origin_m[1], grid.origin_m[0]))
    assert grid.cells[row, column + 20] == OCCUPIED
    assert grid.cells[row, column + 16] == FREE  # rays go down to the floor here
    assert grid.cells[row, column + 5] == UNKNOWN  # only what is high above the floor was seen
    assert grid_of(carved, 2.5, 3.0).cells[row, column + 20] == FREE  # not so high


@pytest.mark.parametrize(
    ("resolution_m", "heights_m", "layers"),
    [(0.1, (0.2, 0.5), 3), (0.05, (0.1, 1.5), 10), (0.03, (0.1, 1.5), 17)],
)
def test_half_of_the_lowest_layers_must_be_free(
    resolution_m: float, heights_m: tuple[float, float], layers: int
) -> None:
    """Their middles are above the low, and below the high and half a metre above the low."""
    middles_m = (np.arange(60) + 0.5) * resolution_m
    bottom = int(np.flatnonzero(middles_m > heights_m[0])[0])
    enough = -(-layers // 2)
    for free, state in ((enough, FREE), (enough - 1, UNKNOWN)):
        keys = np.array([[0, 0, bottom + k] for k in range(free)] + [[1, 0, 59]])
        voxels = VoxelMap(resolution_m, np.eye(4), keys, np.zeros(len(keys), bool))
        assert grid_of(voxels, *heights_m).cells[0, 0] == state


def test_nav2_reads_the_grid_back(tmp_path: Path) -> None:
    cells = np.array([[FREE, OCCUPIED, UNKNOWN], [UNKNOWN, FREE, FREE]], np.int8)
    grid = OccupancyGrid(0.05, np.array([-1.5, 2.25]), cells)
    yaml, pgm = write_nav2(tmp_path / "kitchen", grid, np.eye(4))
    assert (yaml.name, pgm.name) == ("kitchen.yaml", "kitchen.pgm")
    found = load_nav2(yaml)
    assert np.array_equal(found.cells, cells)
    assert np.array_equal(found.origin_m, grid.origin_m)
    assert found.resolution_m == 0.05


def test_octomap_reads_the_voxels_back(carved: VoxelMap, tmp_path: Path) -> None:
    block = np.stack(np.meshgrid(*[np.arange(8, 16)] * 3), axis=-1).reshape(-1, 3)
    for voxels in (carved, VoxelMap(0.2, np.eye(4), block, np.ones(len(block), bool))):
        nodes = write_octomap(tmp_path / "a.bt", voxels)
        size, resolution_m, found = load_octomap(tmp_path / "a.bt")
        assert (size, resolution_m) == (nodes, voxels.resolution_m)
        rows = zip(voxels.keys.tolist(), voxels.occupied.tolist(), strict=True)
        assert found == {tuple(key): occupied for key, occupied in rows}
    assert nodes == 14  # 512 voxels are one leaf below 13 nodes


def test_octomaps_own_library_writes_the_same_file(carved: VoxelMap, tmp_path: Path) -> None:
    library = pytest.importorskip("pyoctomap")
    keys = np.unique(np.random.default_rng(0).integers(-30, 30, (5000, 3)), axis=0)
    block = np.stack(np.meshgrid(*[np.arange(8, 16)] * 3), axis=-1).reshape(-1, 3)
    many = np.unique(np.concatenate([keys, block]), axis=0)
    random = VoxelMap(0.05, np.eye(4), many, many.sum(axis=1) % 5 > 2)
    for voxels in (carved, random, VoxelMap(0.2, np.eye(4), block, np.ones(len(block), bool))):
        ours, theirs = tmp_path / "ours.bt", tmp_path / "theirs.bt"
        nodes = write_octomap(ours, voxels)
        tree = library.OcTree(voxels.resolution_m)
        places = (voxels.keys + 0.5) * voxels.resolution_m
        for occupied in (False, True):
            tree.updateNodes(places[voxels.occupied == occupied], occupied)
        assert tree.writeBinary(str(theirs))
        assert ours.read_bytes() == theirs.read_bytes()
        read = library.OcTree(1.0)
        assert read.readBinary(str(ours))
        assert (read.size(), read.getResolution()) == (nodes, voxels.resolution_m)
        states = [read.isNodeOccupied(read.search(place)) for place in places]
        assert np.array_equal(states, voxels.occupied)


def test_what_is_seen_again_takes_no_more_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(occupancy, "UNITED", 1000)
    T = make_pose(LOOKS_ALONG_X, np.array([0.05, 0.05, 1.05]))
    carver, once, held = VoxelCarver(R, np.eye(4)), VoxelCarver(R, np.eye(4)), []
    depth_m = np.full((48, 64), 4.0, np.float32)
    once.carve(depth_m, CAMERA, T)
    tracemalloc.start()
    try:
        for _ in range(100):
            carver.carve(depth_m, CAMERA, T)
            held.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert max(held) < 4 * held[0]
    np.testing.assert_array_equal(carver.voxels().keys, once.voxels().keys)


def test_a_map_without_anything_is_refused() -> None:
    with pytest.raises(InputError, match="no surface"):
        VoxelCarver(R, np.eye(4)).voxels()
