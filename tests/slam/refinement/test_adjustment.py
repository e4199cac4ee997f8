"""``bmask-slam optimise RUN``: frames move with keyframes; a real run does not get worse."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from repository import KITCHEN, shared

from bmask_slam import cli
from bmask_slam.features.brisk import FeatureConfig
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.batch.bundle_adjustment import Adjustment, Stage
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_update import Observations, reference_frame_id
from bmask_slam.graph.files.array_file import part
from bmask_slam.graph.files.ply import read_ply
from bmask_slam.graph.g2o.landmark_reader import read_landmark_graph
from bmask_slam.graph.geometry import inverse, make_pose, se3_exp, so3_exp
from bmask_slam.graph.smoother.storage import read_graph, write_graph
from bmask_slam.graph.trajectory import Trajectory, read_tum, write_tum
from bmask_slam.offline.runner import RunOptions, run
from bmask_slam.refinement import adjustment_plot
from bmask_slam.refinement.adjustment import AdjustOptions, adjust_run
from bmask_slam.refinement.adjustment_plot import (
    GraphSnapshot,
    View,
    draw_adjustment,
    draw_before_after,
)
from bmask_slam.refinement.carried_along import move_frames
from bmask_slam.run_folder.map_file import read_map, read_run, write_map
from bmask_slam.system_config import SystemConfig
from bmask_slam.world.map_state import world_of


def random_poses(count: int, seed: int) -> np.ndarray:
    return se3_exp(np.random.default_rng(seed).normal(size=(count, 6)))


# --- frames between keyframes ---------------------------------------------------------------------


def test_frames_move_with_the_world_when_all_keyframes_do() -> None:
    poses, T = random_poses(7, 0), random_poses(1, 1)[0]
    frames = Trajectory(np.arange(7.0), poses)
    carried = move_frames(frames, np.array([1.0, 4.0]), poses[[1, 4]], T @ poses[[1, 4]])
    np.testing.assert_allclose(carried.poses_world_camera, T @ poses, atol=1e-12)


def test_frames_move_with_their_keyframes_interpolated_between() -> None:
    """Two keyframes rotate about their centres and shift; the frame halfway moves by half."""
    poses = make_pose(np.eye(3), np.arange(5.0)[:, None] * [1.0, 0, 0])
    turn = so3_exp(np.array([0, 0.2, 0]))
    after = np.stack([poses[1], make_pose(turn, poses[3, :3, 3] + [0, 0.4, 0])])
    carried = move_frames(
        Trajectory(np.arange(5.0), poses), np.array([1, 3.0]), poses[[1, 3]], after
    )
    T = carried.poses_world_camera
    np.testing.assert_allclose(T[:2], poses[:2], atol=1e-12)  # rigid with the first keyframe
    np.testing.assert_allclose(T[3], after[1], atol=1e-12)
    np.testing.assert_allclose(T[4], after[1] @ inverse(poses[3]) @ poses[4], atol=1e-12)
    np.testing.assert_allclose(T[2, :3, :3], so3_exp(np.array([0, 0.1, 0])), atol=1e-12)
    by_second = after[1] @ inverse(poses[3]) @ poses[2]
    assert 0.45 < T[2, 1, 3] / by_second[1, 3] < 0.55


def test_keyframes_of_other_trajectories_do_not_count() -> None:
    poses, moved = random_poses(4, 2), random_poses(3, 3)
    stamps_s = np.array([1.0, np.nan, 2.5])  # of this run, of another one, of another segment
    before = np.stack([poses[1], poses[0], poses[2]])
    frames = Trajectory(np.arange(4.0), poses)
    carried = move_frames(frames, stamps_s, before, moved)
    expected = moved[0] @ inverse(poses[1]) @ poses
    np.testing.assert_allclose(carried.poses_world_camera, expected, atol=1e-12)
    assert move_frames(frames, stamps_s[1:], before[1:], moved[1:]) is frames


# --- a real run -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run over a part of the red kitchen, without the final adjustment."""
    out = tmp_path_factory.mktemp("runs") / "kitchen"
    config = SystemConfig(FeatureConfig(max_keypoints=500), final_adjustment=False)
    return run(
        RunOptions(shared("redkitchen"), config, out=out, max_frames=40, stride=2, quiet=True)
    ).folder


@pytest.fixture(scope="module")
def adjusted(kitchen: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The adjusted run, which is read alone."""
    out = tmp_path_factory.mktemp("adjusted") / "run"
    assert optimise(kitchen, "--out", out, "--quiet") == 0
    return out


def optimise(*words: object) -> int:
    return cli.main(["optimise", *(str(word) for word in words)])


def value(run_folder: Path, name: str) -> float:
    rows = json.loads((run_folder / "metrics.json").read_text())
    return {row["name"]: row["value"] for row in rows}[name]


def test_an_adjusted_run_folder_is_more_accurate(capsys, kitchen: Path, tmp_path: Path) -> None:
    before = {p.name: p.read_bytes() for p in kitchen.iterdir()}
    out = tmp_path / "adjusted"
    assert optimise(kitchen, "--out", out, "--reference", KITCHEN) == 0
    printed = capsys.readouterr().out
    assert "stage robust" in printed
    assert "wrong views" in printed
    assert str(out / "before_after.png") in printed
    assert {p.name: p.read_bytes() for p in kitchen.iterdir()} == before
    assert {p.name for p in out.iterdir()} >= {*before, "before_after.png"}
    assert value(out, "cost_final") < value(out, "cost_initial")
    assert value(out, "ate_rmse") < 1.05 * value(kitchen, "ate_rmse")
    old, new = (read_tum(folder / "trajectory.txt") for folder in (kitchen, out))
    np.testing.assert_array_equal(new.timestamps_s, old.timestamps_s)
    shift_m = np.linalg.norm(new.positions_world - old.positions_world, axis=1)
    assert 1e-5 < shift_m.max() < 0.05
    assert cli.main(["evaluate", str(out), "--reference", str(KITCHEN)]) == 0


def test_a_merged_run_is_compared_by_the_stamps_of_its_recordings(
    kitchen: Path, tmp_path: Path
) -> None:
    """As if merging had added 50 s."""
    run = shutil.copytree(kitchen, tmp_path / "run")
    stamps_s = read_tum(run / "trajectory.txt").timestamps_s
    part = {"sequence": "s", "begin_s": stamps_s[0] - 50, "end_s": stamps_s[-1] - 50}
    (run / "recordings.json").write_text(json.dumps({"recordings": [part | {"shift_s": 50.0}]}))
    truth = read_tum(KITCHEN / "groundtruth.txt")
    earlier = Trajectory(truth.timestamps_s - 50, truth.poses_world_camera)
    write_tum(tmp_path / "truth.txt", earlier)
    out = tmp_path / "out"
    assert optimise(run, "--out", out, "--reference", tmp_path / "truth.txt") == 0
    assert value(out, "ate_rmse") < 1.05 * value(kitchen, "ate_rmse")
    assert (out / "recordings.json").read_text() == (run / "recordings.json").read_text()


def from_keyframes(run: Path) -> Array:
    """The smoothed poses of the keyframes' frames (K, 4, 4), in the keyframes."""
    frames, keyframes = (read_tum(run / f"{name}.txt") for name in ("trajectory", "keyframes"))
    at = np.searchsorted(frames.timestamps_s, keyframes.timestamps_s)
    return inverse(keyframes.poses_world_camera) @ frames.poses_world_camera[at]


def test_keyframes_landmarks_and_graph_are_consistent(
    kitchen: Path, adjusted: Path, tmp_path: Path
) -> None:
    out = adjusted
    tables, _ = read_graph(out / "graph")
    frames, keyframes = (read_tum(out / f"{name}.txt") for name in ("trajectory", "keyframes"))
    np.testing.assert_allclose(keyframes.poses_world_camera, tables.keyframes.values, atol=2e-9)
    np.testing.assert_allclose(from_keyframes(out), from_keyframes(kitchen), atol=2e-8)
    old, cloud = read_ply(kitchen / "landmarks.ply"), read_ply(out / "landmarks.ply")
    points = np.stack([cloud[axis] for axis in "xyz"], axis=1)
    inside = tables.landmarks.contains(cloud["id"].astype(np.int64))
    np.testing.assert_allclose(
        points[inside], tables.landmarks.get(cloud["id"][inside]), rtol=1e-6, atol=1e-6
    )
    rows = np.searchsorted(old["id"], cloud["id"])
    moved = points - np.stack([old[axis] for axis in "xyz"], axis=1)[rows]
    assert 0 < np.abs(moved[~inside]).max() < 0.05  # the others moved too
    # a second adjustment changes nothing, and keeps the observations
    again = tmp_path / "again"
    assert optimise(out, "--out", again, "--quiet") == 0
    T = read_tum(again / "trajectory.txt").poses_world_camera
    assert np.abs(T - frames.poses_world_camera).max() < 5e-3


def test_the_saved_map_is_the_adjusted_one(kitchen: Path, adjusted: Path, tmp_path: Path) -> None:
    """Its poses equal the graph's; a run can be localised in it, or continue it."""
    out = adjusted
    state, camera = read_map(out)
    assert camera == read_map(kitchen)[1]
    tables, _ = read_graph(out / "graph")
    poses, given = (
        of["mapper.world.keyframes.T_world_camera"] for of in (state, read_map(kitchen)[0])
    )
    np.testing.assert_array_equal(poses, tables.keyframes.values)
    assert np.abs(poses - given).max() > 1e-5
    world = world_of(part(state, "mapper.world"))
    inside = np.flatnonzero(world.landmarks.in_graph)
    np.testing.assert_array_equal(inside, tables.landmarks.ids)
    np.testing.assert_array_equal(world.landmarks.points_world[inside], tables.landmarks.values)
    config = SystemConfig(final_adjustment=False)
    for name in ("localise", "map"):
        options = RunOptions(
            shared("redkitchen"),
            config,
            out=tmp_path / name,
            max_frames=12,
            quiet=True,
            **{name: out},
        )
        found = read_tum(run(options).folder / "trajectory.txt")
        expected = read_tum(out / "trajectory.txt")
        assert len(found) >= 10
        at = np.searchsorted(found.timestamps_s, expected.timestamps_s[:5])
        error_m = found.positions_world[at] - expected.positions_world[:5]
        assert np.linalg.norm(error_m, axis=1).max() < 0.02


def without_frames(kitchen: Path, folder: Path) -> Path:
    """A copy of the run that lacks what frames observe, as those of older versions do."""
    shutil.copytree(kitchen, folder)
    state, camera = read_map(folder)
    write_map(
        folder / "map", {k: a for k, a in state.items() if not k.startswith("frames.")}, camera
    )
    return folder


def test_frames_that_are_no_keyframes_count_too(
    capsys, kitchen: Path, adjusted: Path, tmp_path: Path
) -> None:
    """An adjusted run stays where it is; by keyframes alone it would move."""
    printed = {}
    for name, run_folder in (
        ("with", adjusted),
        ("without", without_frames(adjusted, tmp_path / "a")),
    ):
        assert optimise(run_folder, "--out", tmp_path / name) == 0
        printed[name] = capsys.readouterr().out
    assert "stage all frames" in printed["with"]
    assert "all frames" not in printed["without"]
    before = read_tum(adjusted / "keyframes.txt").positions_world
    moved_m = {
        name: np.linalg.norm(read_tum(tmp_path / name / "keyframes.txt").positions_world - before)
        for name in printed
    }
    assert moved_m["with"] < 0.5 * moved_m["without"]


def test_broken_columns_of_frames_are_refused(kitchen: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(kitchen, broken)
    state, camera = read_map(broken)
    write_map(broken / "map", {**state, "frames.columns": state["frames.columns"][:-3]}, camera)
    with pytest.raises(InputError, match="do not fit together"):
        adjust_run(AdjustOptions(broken, tmp_path / "out"))


def test_the_exported_graph_is_adjusted_to_the_same_cost(kitchen: Path, tmp_path: Path) -> None:
    adjusted = tmp_path / "adjusted"
    alone = without_frames(kitchen, tmp_path / "alone")  # as the exported graph is
    assert optimise(alone, "--out", adjusted, "--quiet") == 0
    file, out = tmp_path / "a.g2o", tmp_path / "b.g2o"
    words = ["export", kitchen, "--format", "g2o", "--out", file, "--quiet"]
    assert cli.main([str(word) for word in words]) == 0
    plot = tmp_path / "before_after.svg"
    assert optimise(file, "--out", out, "--plot", plot, "--quiet") == 0
    (tables, _), (read, _) = read_graph(adjusted / "graph"), read_landmark_graph(out)
    assert len(read.observations) == len(tables.observations)
    np.testing.assert_allclose(read.keyframes.values, tables.keyframes.values, atol=1e-6)
    np.testing.assert_allclose(read.landmarks.values, tables.landmarks.values, atol=1e-4)
    assert plot.stat().st_size > 1000


def test_only_the_graph_section_of_the_configuration_is_read(kitchen: Path, tmp_path: Path) -> None:
    """A run of another version with renamed settings is adjusted too."""
    other = tmp_path / "other"
    shutil.copytree(kitchen, other)
    (other / "config.yaml").write_text("tracking: {gone: 1}\ngraph: {huber_stereo: 5.5}\n")
    assert read_run(other).config.huber_stereo == 5.5
    (other / "config.yaml").write_text("graph: {gone: 1}\n")
    with pytest.raises(InputError, match="gone"):
        read_run(other)


def test_a_damaged_map_is_refused_before_the_output_is_replaced(
    kitchen: Path, tmp_path: Path, capsys
) -> None:
    run, out = (shutil.copytree(kitchen, tmp_path / name) for name in ("run", "out"))
    (run / "map").write_bytes((kitchen / "map").read_bytes()[:3000])
    assert optimise(run, "--out", out, "--overwrite") == 1
    assert f"{run / 'map'}: not a saved map" in capsys.readouterr().err
    assert {p.name for p in out.iterdir()} == {p.name for p in kitchen.iterdir()}


def test_impossible_options_are_refused(capsys, kitchen: Path, tmp_path: Path) -> None:
    def error(*words: object) -> str:
        assert optimise(*words) == 1
        return capsys.readouterr().err

    assert "is the input" in error(kitchen, "--out", kitchen, "--overwrite")
    out = tmp_path / "taken"
    out.mkdir()
    (out / "trajectory.txt").write_text("mine")
    assert "already holds a run" in error(kitchen, "--out", out)
    assert (out / "trajectory.txt").read_text() == "mine"
    assert optimise(kitchen, "--out", out, "--overwrite", "--quiet") == 0
    other = tmp_path / "other"
    shutil.copytree(kitchen, other)
    tables, camera = read_graph(other / "graph")
    tables.keyframes.values[1, 0, 3] += 0.1
    write_graph(other / "graph", tables, camera)
    assert "do not belong together" in error(other, "--out", tmp_path / "new")
    assert not (tmp_path / "new").exists()
    keyframes = read_tum(kitchen / "keyframes.txt")
    write_tum(
        other / "keyframes.txt",
        Trajectory(keyframes.timestamps_s + 99, keyframes.poses_world_camera),
    )
    assert "do not belong together" in error(other, "--out", tmp_path / "new")
    (other / "frames.csv").unlink()
    assert "frames.csv: no such file" in error(other, "--out", tmp_path / "new")


def test_the_picture_is_of_one_world_and_has_no_line_where_the_camera_was_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Keyframes 0 to 3 are of one map, where 2 shows nothing of 1; 7 and 8 are of another one.

    The pose that a sensor has in the graph is none of the camera.
    """
    tables, views = FactorTables(), list[View]()
    ids = np.array([0, 1, 2, 3, 7, 8, reference_frame_id(0)])
    tables.keyframes.insert(ids, random_poses(7, 5))
    tables.landmarks.insert(np.arange(4), np.arange(12.0).reshape(4, 3))
    pairs = [(0, 0), (1, 0), (1, 3), (3, 3), (2, 1), (3, 1), (7, 2), (8, 2)]
    keyframes, landmarks = np.array(pairs).T
    ones = np.ones((len(pairs), 3))
    tables.observations.add(Observations(keyframes, landmarks, ones, ones))
    before = GraphSnapshot.of(tables)
    monkeypatch.setattr(adjustment_plot, "draw_before_after", lambda _, *found: views.extend(found))
    none, stage = np.zeros((0, 2), np.int64), Stage("robust", 8, 5.0, 4.0, 1)
    wrong = np.array([[0, 3], [0, 8]])
    found = Adjustment((stage,), 2, wrong, 8, none, none[:, 0], 1.0)
    draw_adjustment(tmp_path / "a.png", before, before, found)
    for view in views:
        assert len(view.points) == 4 and len(view.cloud) == 3
        assert view.edges[0][0].tolist() == [[0, 1], [2, 3]]
    assert views[0].edges[2][0].tolist() == [[0, 3]]


def test_titles_are_inside_the_picture(tmp_path: Path) -> None:
    """The axes are square and as high as the picture allows."""
    points, edges = np.array([[0.0, 0.0], [-0.2, 3.2]]), np.array([[0, 1]])
    view = View("before, cost 1351.8", points, [(edges, "tab:blue", 0.9)], axes="xz")
    draw_before_after(tmp_path / "a.png", view, view)
    picture = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_GRAYSCALE)
    assert (picture[:4] > 128).all()
