"""``export --format nav2`` and ``octomap``: how the floor is found, options, what is refused."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from drive_map_files import load_nav2, load_octomap
from ruamel.yaml import YAML

from bmask_slam.cli import main
from bmask_slam.dense.drive_map import DriveFormat, DriveMapOptions, export_drive_map, map_frame
from bmask_slam.dense.saved_map import SavedMap, read_saved_map
from bmask_slam.dense.surface import lost_before
from bmask_slam.features.brisk import Features
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_update import GRAVITY, RelativePose, reference_frame_id
from bmask_slam.graph.files.array_file import nested, part, read_arrays, write_arrays
from bmask_slam.graph.geometry import inverse, make_pose, so3_exp, transform
from bmask_slam.graph.smoother.storage import graph_arrays
from bmask_slam.graph.trajectory import Trajectory, write_tum
from bmask_slam.mapping.inverse_depth.depth_map import InverseDepthMap, write_depth_map
from bmask_slam.mapping.products.cloud import Cloud
from bmask_slam.mapping.products.cloud_files import CloudWriter
from bmask_slam.mapping.products.occupancy import FREE, OCCUPIED
from bmask_slam.run_folder.landmark_file import DenseCloud
from bmask_slam.run_folder.map_file import MAP_FILE, write_map
from bmask_slam.world.frame_history import FrameHistory
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.map_state import world_of, world_state
from bmask_slam.world.world_map import WorldMap

CAMERA = Camera(80, 60, 50.0, 50.0, 39.5, 29.5)
NAMES = ("background", "floor", "table")
LOOKS_ALONG_X = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
TABLE_M = 0.72
FLOOR, TABLE = ((0.0, -1.5, 0.0), (3.0, 3.0)), ((1.2, -0.5, TABLE_M), (0.8, 1.0))


@pytest.mark.parametrize(
    ("form", "name", "written"), [("nav2", "a.txt", ".yaml"), ("octomap", "a.ot", ".bt")]
)
def test_a_file_of_another_name_is_not_written(
    tmp_path: Path, form: DriveFormat, name: str, written: str
) -> None:
    with pytest.raises(InputError, match=rf"{name}: .* let --out end with it") as found:
        export_drive_map(tmp_path, form, tmp_path / "out" / name, DriveMapOptions())
    assert written in str(found.value)


def camera_pose(pitch_deg: float) -> Array:
    """T_map_camera (4, 4) of a camera 1.2 m above the floor that looks along x and down."""
    R = so3_exp(np.array([0.0, np.deg2rad(pitch_deg), 0.0])) @ LOOKS_ALONG_X
    return make_pose(R, np.array([0.0, 0.0, 1.2]))


def level(corner: tuple[float, ...], size: tuple[float, ...], label: str, slope_deg=0) -> Cloud:
    """A rectangle that faces up, or is tilted about its edge at the corner; in the map's frame."""
    rng = np.random.default_rng(7)
    flat = rng.uniform(0, 1, (int(8000 * size[0] * size[1]), 3)) * [*size, 0.0]
    R = so3_exp(np.array([0.0, -np.deg2rad(slope_deg), 0.0]))
    n = len(flat)
    noise = rng.normal(0, 0.04, (n, 3))
    normals = R[:, 2] + noise
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    one = np.ones(n, np.float32)
    return Cloud(
        (flat @ R.T + corner).astype(np.float32), normals.astype(np.float32),
        np.full((n, 3), 9, np.uint8), one, np.full(n, NAMES.index(label), np.uint16), one,
        one.astype(np.uint16),
    )  # fmt: skip


def in_world(parts: list[Cloud], T_map_world: Array) -> Cloud:
    """The parts as one cloud in the run's world."""
    cloud, T = Cloud.concatenate(parts), inverse(T_map_world)
    points = transform(T, cloud.points.astype(float)).astype(np.float32)
    return replace(cloud, points=points, normals=cloud.normals @ T[:3, :3].T.astype(np.float32))


def found_frame(parts: list[Cloud], pitch_deg: float, gravity: Array | None) -> tuple[Array, str]:
    """T_found_map (4, 4) of what is found where the first camera's frame is the world, and how."""
    T_map_world = camera_pose(pitch_deg)
    cloud = in_world(parts, T_map_world)
    n = len(cloud)
    dense = DenseCloud(
        cloud.points.astype(float), cloud.normals.astype(float), cloud.colours,
        np.array(NAMES)[cloud.labels], np.ones(n), np.ones(n),
    )  # fmt: skip
    keyframes: Any = [
        SimpleNamespace(id=k, T_world_camera=T)
        for k, T in enumerate((np.eye(4), np.full((4, 4), np.nan)))
    ]
    up_world = None if gravity is None else T_map_world[:3, :3].T @ gravity
    saved = SavedMap(Path("run"), WorldMap(), keyframes, CAMERA, up_world=up_world)
    found, text = map_frame(saved, dense)
    return found @ inverse(T_map_world), text


def check_level(T_found_map: Array, floor_m: float = 0.0) -> None:
    """Up is the map's z, and 0 at the height of the floor."""
    assert np.linalg.norm(T_found_map[2, :2]) < 0.005
    assert T_found_map[2, 2] > 0
    assert T_found_map[2, 3] == pytest.approx(-floor_m, abs=0.01)
    assert np.linalg.det(T_found_map[:3, :3]) == pytest.approx(1)


def test_a_small_floor_with_a_label_below_a_large_table() -> None:
    """Without labels the lowest strong level is the table."""
    small = (0.0, 0.0, 0.0), (0.4, 0.4)
    large = (0.5, -1.5, TABLE_M), (3.0, 3.0)
    for label, floor_m in (("floor", 0.0), ("background", TABLE_M)):
        found, text = found_frame([level(*small, label), level(*large, "table")], 40.0, None)
        check_level(found, floor_m)
        by_labels = "up by the points labelled floor, the floor by its labels"
        guessed = "up by level surfaces and the cameras' attitude, the floor by the lowest level"
        assert text == (by_labels if label == "floor" else guessed)


def test_of_walls_alone_the_lowest_points_are_the_floor() -> None:
    """They begin 0.3 m above the floor, 0.9 m below the camera."""
    walls = [level((x, -1.0, 0.3), (1.5, 2.0), "background", slope_deg=90) for x in (2.0, 3.0)]
    found, text = found_frame(walls, 10.0, np.array([0.0, 0.0, 1.0]))
    assert np.linalg.norm(found[2, :2]) < 0.005
    assert found[2, 3] == pytest.approx(-0.32, abs=0.03)  # the lowest 8 cm of them
    assert text.endswith("the floor by the lowest points, since none faces up")


@pytest.mark.parametrize("label", ["floor", "background"])
def test_a_camera_held_at_40_degrees_gives_a_level_floor(label: str) -> None:
    check_level(found_frame([level(*FLOOR, label), level(*TABLE, "table")], 40.0, None)[0])


def test_a_labelled_floor_is_level_to_a_camera_that_looks_down() -> None:
    parts = [level(*FLOOR, "floor"), level(*TABLE, "table")]
    check_level(found_frame(parts, 70.0, None)[0])
    unlabelled = [level(*FLOOR, "background"), level(*TABLE, "table")]
    assert found_frame(unlabelled, 70.0, None)[0][2, 2] < 0.9  # nothing says where up is


def test_a_first_guess_of_up_is_gravity_or_the_mean_of_the_cameras() -> None:
    tilted, lost = camera_pose(90.0), np.full((4, 4), np.nan)
    keyframes: Any = [
        SimpleNamespace(id=k, T_world_camera=T) for k, T in enumerate((np.eye(4), lost, tilted))
    ]
    saved = SavedMap(Path("run"), WorldMap(), keyframes, CAMERA)
    mean = np.array([0.0, -1.0, 0.0]) - tilted[:3, 1]
    assert saved.up_guess() == pytest.approx(mean / np.linalg.norm(mean))
    measured = replace(saved, up_world=np.array([1.0, 0.0, 0.0]))
    assert measured.up_guess() == pytest.approx([1.0, 0.0, 0.0])
    sideways = replace(saved, sides={0: "left", 1: "left"})
    mean = np.array([-1.0, 0.0, 0.0]) - tilted[:3, 0]
    assert sideways.up_guess() == pytest.approx(mean / np.linalg.norm(mean))
    assert sideways.side == "left"
    mixed = replace(saved, sides={0: "left", 2: "bottom"})
    mean = np.array([-1.0, 0.0, 0.0]) + tilted[:3, 1]
    assert mixed.up_guess() == pytest.approx(mean / np.linalg.norm(mean))
    mounted = replace(saved, camera=replace(CAMERA, up="bottom"))
    assert mounted.side == "bottom"
    assert mounted.up_guess() == pytest.approx(-saved.up_guess())


def test_gravity_says_where_up_is() -> None:
    """Its error, here 3 degrees of a mounting, is mended by the plane of the floor."""
    gravity = so3_exp(np.deg2rad([2.0, -2.0, 0.0]))[:, 2]
    for label, by in (("floor", "its labels"), ("background", "the lowest level")):
        found, text = found_frame([level(*FLOOR, label)], 90.0, gravity)
        check_level(found)
        assert text == f"up by gravity, which was measured, the floor by {by}"


def test_a_slope_is_no_floor_where_gravity_was_measured() -> None:
    slope = level((0.0, -1.5, 0.0), (3.0, 3.0), "floor", slope_deg=20)
    parts = [slope, level((-2.0, -1.5, 0.0), (2.0, 3.0), "background")]
    up = np.array([0.0, 0.0, 1.0])
    check_level(found_frame(parts, 20.0, up)[0])
    assert found_frame(parts, 20.0, None)[0][2, 2] < 0.96
    found, _ = found_frame([slope], 20.0, up)  # nothing is level: up is gravity's as it stands
    assert found[2, 2] == pytest.approx(1)


def depth_of(T_map_camera: Array) -> Array:
    """z-depth (H, W) of the floor and the table; NaN beyond the floor's end."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(float)
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], -1)
    rays = rays @ T_map_camera[:3, :3].T
    found = np.full(u.shape, np.nan)
    for (x, y, z), (width, length) in (FLOOR, TABLE):
        depth = (z - T_map_camera[2, 3]) / rays[..., 2]
        at = T_map_camera[:3, 3] + depth[..., None] * rays
        hit = (depth > 0) & (at[..., 0] > x) & (at[..., 0] < x + width)
        hit &= (at[..., 1] > y) & (at[..., 1] < y + length)
        found = np.where(hit, depth, found)  # the table is the nearer one
    return found


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The folder of a run with a dense map of a floor and a table, and with measured gravity."""
    path, T_map_camera = tmp_path / "run", camera_pose(40.0)
    (path / "dense" / "depth").mkdir(parents=True)
    world, tables, reference = WorldMap(), FactorTables(), reference_frame_id(0)
    none = np.zeros(0)
    pixels, colours, image = (
        np.zeros((0, 2)),
        np.zeros((0, 3), np.uint8),
        np.zeros((0, 0), np.uint8),
    )
    descriptors, sigmas_px = np.zeros((0, 8), np.uint64), np.zeros((0, 3))
    features = Features(
        pixels, pixels, descriptors, none, none, none, none, sigmas_px, colours, image
    )
    world.add_keyframe(Keyframe(0, 0, 0.0, 0, np.eye(4), features, none.astype(np.int64)))
    T_world_map = inverse(T_map_camera)
    tables.keyframes.insert(np.array([0, reference]), np.array([np.eye(4), T_world_map]))
    factor = RelativePose(reference, 0, T_map_camera, np.eye(6), "huber", GRAVITY)
    tables.add_pose_factors([factor])
    state = nested(mapper=nested(world=world_state(world), graph=graph_arrays(tables)))
    write_map(path / "map", state, CAMERA)
    rho = torch.tensor(1 / depth_of(T_map_camera), dtype=torch.float32)
    write_depth_map(path / "dense" / "depth" / "000000", InverseDepthMap(rho, 0 * rho + 1e-4))
    with CloudWriter(path / "dense" / "cloud") as writer:
        writer.write(in_world([level(*FLOOR, "background"), level(*TABLE, "table")], T_map_camera))
    (path / "dense" / "legend.json").write_text(json.dumps({name: [0, 0, 0] for name in NAMES}))
    return path


def test_resolution_and_heights_of_the_grid(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cells = {}
    for name, options in {
        "usual": [],
        "low robot": ["--heights", "0.1", "0.5"],
        "coarse": ["--resolution", "0.1"],
    }.items():
        out = tmp_path / f"{name}.yaml"
        assert main(["export", str(run), "--format", "nav2", "--out", str(out), *options]) == 0
        how = "up by gravity, which was measured, the floor by the lowest level"
        assert how in capsys.readouterr().out
        assert out.read_text().startswith(f"# {how}\n")
        grid = load_nav2(out)
        assert grid.resolution_m == (0.1 if name == "coarse" else 0.05)
        T_map_world = np.array(YAML(typ="safe").load(out)["bmask_slam_T_map_world"])
        table = transform(T_map_world @ inverse(camera_pose(40.0)), np.array([[1.6, 0.0, TABLE_M]]))
        column, row = np.floor((table[0, :2] - grid.origin_m) / grid.resolution_m).astype(int)
        cells[name] = grid.cells[row, column], grid.cells.shape
    assert cells["usual"][0] == cells["coarse"][0] == OCCUPIED
    assert cells["low robot"][0] != OCCUPIED  # it drives under the table
    assert cells["low robot"][1] == cells["usual"][1]
    for fine, coarse in zip(cells["usual"][1], cells["coarse"][1], strict=True):
        assert fine / 2 <= coarse <= fine / 2 + 1
    usual = load_nav2(tmp_path / "usual.yaml").cells
    assert (usual == FREE).sum() > 1000
    arguments = ["export", str(run), "--format", "nav2", "--out", str(tmp_path / "a.yaml")]
    assert main([*arguments, "--resolution", "0.001"]) == 1
    assert main([*arguments, "--heights", "1", "0.5"]) == 1
    said = capsys.readouterr().err
    assert "--resolution 0.001: must be from 0.01 to 1 m" in said
    assert "--heights 1 0.5: must rise" in said


def test_the_command_writes_an_octomap(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "kitchen.bt"
    arguments = [
        "export",
        str(run),
        "--format",
        "octomap",
        "--out",
        str(out),
        "--resolution",
        "0.1",
    ]
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    nodes, resolution_m, voxels = load_octomap(out)
    assert resolution_m == 0.1
    assert f"{sum(voxels.values())} occupied, {len(voxels) - sum(voxels.values())} free" in printed
    assert f"in {nodes} nodes" in printed
    assert "up by gravity" in printed
    occupied = np.array([key for key, is_occupied in voxels.items() if is_occupied])
    assert set(occupied[:, 2]) <= {-1, 0, 7}  # the floor and the table, seen from above
    assert min(key[2] for key, is_occupied in voxels.items() if not is_occupied) >= 0


def test_a_run_without_a_map_is_not_sent_to_make_a_dense_one(run: Path) -> None:
    out, options = run.parent / "a.yaml", DriveMapOptions()
    shutil.rmtree(run / "dense")
    with pytest.raises(InputError, match="no dense map here; make it with bmask-slam map"):
        export_drive_map(run, "nav2", out, options)
    (run / "map").unlink()
    with pytest.raises(InputError, match="give a finished run, not one with --localise"):
        export_drive_map(run, "nav2", out, options)


def test_where_the_camera_was_lost_is_between_two_keyframes(tmp_path: Path) -> None:
    assert lost_before(tmp_path, [0.0, 1.0]).tolist() == []  # no trajectory
    stamps_s = np.concatenate([np.arange(30), 90 + np.arange(30)]) / 30
    poses = np.tile(np.eye(4), (len(stamps_s), 1, 1))
    write_tum(tmp_path / "trajectory.txt", Trajectory(stamps_s, poses))
    keyframes_s = [*stamps_s[[0, 10, 29]].tolist(), *stamps_s[[30, 45]].tolist()]
    assert lost_before(tmp_path, keyframes_s).tolist() == [3]
    assert lost_before(tmp_path, keyframes_s[:3]).tolist() == []


def test_the_map_is_of_the_segment_that_the_trajectory_is_of(run: Path) -> None:
    """That of most frames; not that of most keyframes, which has a world frame of its own."""
    header, state = read_arrays(run / "map", MAP_FILE)
    world, history = WorldMap(), FrameHistory()
    first = world_of(part(state, "mapper.world")).keyframes[0]
    for number, segment in enumerate((0, 1, 1)):
        world.add_keyframe(replace(first, id=number, segment=segment))
    for k, keyframe in enumerate((0, 0, 0, 1, 2)):
        history.append(float(k), keyframe, np.eye(4), np.eye(4))
    state |= nested(mapper=nested(world=world_state(world), history=history.state()))
    write_arrays(run / "map", MAP_FILE, header, state)
    assert world.largest_segment() == 1
    assert [k.id for k in read_saved_map(run).keyframes] == [0]
    history.append(5.0, 2, np.eye(4), np.eye(4))
    history.append(6.0, 2, np.eye(4), np.eye(4))
    state |= nested(mapper=nested(history=history.state()))
    write_arrays(run / "map", MAP_FILE, header, state)
    assert [k.id for k in read_saved_map(run).keyframes] == [1, 2]


def test_up_without_a_direction_is_refused(run: Path) -> None:
    header, state = read_arrays(run / "map", MAP_FILE)
    state["mapper.graph.poses_world_camera"][1, :3, 2] = 0
    write_arrays(run / "map", MAP_FILE, header, state)
    with pytest.raises(InputError, match="no direction"):
        read_saved_map(run)
