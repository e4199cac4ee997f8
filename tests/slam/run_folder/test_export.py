"""``bmask-slam export``: each format is read back, and errors."""

import shutil
from pathlib import Path

import gtsam
import numpy as np
import pytest

from bmask_slam import cli
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_update import Observations
from bmask_slam.graph.factors.keys import key_of_keyframe
from bmask_slam.graph.factors.own_factors import own_factor
from bmask_slam.graph.files.ply import read_ply, write_ply
from bmask_slam.graph.g2o.landmark_reader import read_landmark_graph
from bmask_slam.graph.geometry import inverse, se3_exp, transform
from bmask_slam.graph.smoother.storage import read_graph, write_graph
from bmask_slam.graph.trajectory import Trajectory, write_tum
from bmask_slam.graph.trajectory_formats import read_times, read_trajectory

CAMERA = Camera(640, 480, 520.0, 525.0, 320.0, 240.0)
STAMPS_S = np.arange(6) / 10
POINTS = np.array([[0.1, 0.2, 3.0], [-0.4, 0.1, 2.5], [0.3, -0.2, 4.0]])


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run folder with the files that export reads: six frames, two keyframes, three landmarks."""
    folder = tmp_path / "run"
    folder.mkdir()
    poses = se3_exp(0.05 * np.random.default_rng(0).normal(size=(6, 6)))
    write_tum(folder / "trajectory.txt", Trajectory(STAMPS_S, poses))
    rows = "".join(f"{k},{stamp}\n" for k, stamp in enumerate(STAMPS_S))
    (folder / "frames.csv").write_text("index,timestamp\n" + rows)
    columns = dict(zip("xyz", POINTS.T.astype(np.float32), strict=True))
    write_ply(folder / "landmarks.ply", columns | {"id": np.arange(3, dtype=np.int32)})
    tables = FactorTables()
    tables.keyframes.insert(np.array([0, 4]), poses[[0, 4]])
    tables.landmarks.insert(np.array([0, 1, 2]), POINTS)
    measurements = CAMERA.project_stereo(transform(inverse(poses[[0, 4]]), POINTS)).reshape(6, 3)
    keyframes, landmarks = np.repeat([0, 4], 3), np.tile([0, 1, 2], 2)
    tables.observations.add(Observations(keyframes, landmarks, measurements, np.ones((6, 3))))
    write_graph(folder / "graph", tables, CAMERA)
    return folder


def export(*words: object) -> int:
    return cli.main(["export", *(str(word) for word in words)])


@pytest.mark.parametrize("form", ["tum", "euroc", "kitti"])
def test_a_trajectory_is_read_back_and_evaluated(capsys, run: Path, tmp_path: Path, form) -> None:
    out = tmp_path / "out.txt"
    assert export(run, "--format", form, "--out", out) == 0
    assert "6 poses T_world_camera" in capsys.readouterr().out
    times = tmp_path / "out_times.txt"
    assert times.is_file() == (form == "kitti")
    given = read_trajectory(run / "trajectory.txt")
    found = read_trajectory(out, read_times(times) if form == "kitti" else None)
    np.testing.assert_array_equal(found.timestamps_s, given.timestamps_s)
    np.testing.assert_allclose(found.poses_world_camera, given.poses_world_camera, atol=1e-9)
    # as a reference of the run, whose frames lend KITTI their stamps; the other way round: --times
    assert cli.main(["evaluate", str(run), "--reference", str(out)]) == 0
    assert "ate_rmse                      0.0000 m" in capsys.readouterr().out
    words = ["evaluate", str(out), "--reference", str(run / "trajectory.txt")]
    words += ["--times", str(times)] if form == "kitti" else []
    assert cli.main(words) == 0
    # and back to TUM
    words = ["--times", times] if form == "kitti" else []
    assert export(out, "--format", "tum", "--out", tmp_path / "b.txt", *words) == 0
    assert (tmp_path / "b.txt").read_bytes() == (run / "trajectory.txt").read_bytes()


def test_the_graph_is_read_back(capsys, run: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.g2o"
    assert export(run, "--format", "g2o", "--out", out) == 0
    printed = capsys.readouterr().out
    assert "2 keyframes (VERTEX_SE3:QUAT), 3 landmarks (VERTEX_TRACKXYZ), 6 observations" in printed
    assert "Not in the format: the robust kernels of observations, and" in printed
    tables, camera = read_graph(run / "graph")
    own = gtsam.GPSFactor(key_of_keyframe(0), np.zeros(3), gtsam.noiseModel.Unit.Create(3))
    tables.own_factors[0] = own_factor(own)
    write_graph(run / "graph", tables, camera)
    assert export(run, "--format", "g2o", "--out", out) == 0
    assert "kernels of observations, 1 factors of your own (add_factor), and" in (
        capsys.readouterr().out
    )
    tables, camera = read_landmark_graph(out)
    assert camera == CAMERA
    np.testing.assert_allclose(tables.landmarks.values, POINTS, atol=1e-12)
    assert export(out, "--format", "ply", "--out", tmp_path / "a.ply") == 0
    cloud = read_ply(tmp_path / "a.ply")
    np.testing.assert_allclose(np.stack([cloud[axis] for axis in "xyz"], axis=1), POINTS)
    assert cloud["id"].tolist() == [0, 1, 2]


def test_a_graph_of_several_map_segments_says_so(capsys, run: Path, tmp_path: Path) -> None:
    words = run, "--format", "g2o", "--out", tmp_path / "a.g2o"
    assert export(*words) == 0
    assert "a world of its own" not in capsys.readouterr().out
    shutil.copy(run / "trajectory.txt", run / "trajectory_segment_1.txt")
    assert export(*words) == 0
    assert "\n1 more map segments are in it, each in a world of its own" in capsys.readouterr().out


def test_points(run: Path, tmp_path: Path) -> None:
    assert export(run, "--format", "ply", "--out", tmp_path / "a.ply", "--quiet") == 0
    given, found = read_ply(run / "landmarks.ply"), read_ply(tmp_path / "a.ply")
    assert list(found) == list(given)
    np.testing.assert_array_equal(found["y"], given["y"])
    assert export(run / "trajectory.txt", "--format", "ply", "--out", tmp_path / "b.ply") == 0
    path = read_ply(tmp_path / "b.ply")
    np.testing.assert_allclose(path["t"], STAMPS_S)
    positions = read_trajectory(run / "trajectory.txt").positions_world
    np.testing.assert_allclose(np.stack([path[axis] for axis in "xyz"], axis=1), positions)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["none", "--format", "tum", "--out", "a"], "none: no such file or folder"),
        (["run", "--format", "tum", "--out", "no/a"], "the folder no does not exist"),
        (["run", "--format", "tum", "--out", "run"], "a folder; give the name of a file"),
        (["run", "--format", "tum", "--out", "run/trajectory.txt"], "is (in) the input"),
        (["run", "--format", "kitti", "--out", "."], ".: a folder; give the name of a file"),
        (
            ["run/trajectory.txt", "--format", "g2o", "--out", "a"],
            "has no graph, which g2o needs",
        ),
        (
            ["run/trajectory.txt", "--format", "g2o", "--out", "a"],
            "which g2o needs; give the folder of a finished run, not one with --localise",
        ),
        (["a.g2o", "--format", "tum", "--out", "a"], "a graph has no stamps, which tum needs"),
        (["kitti.txt", "--format", "tum", "--out", "a"], "has no stamps; give them with --times"),
    ],
)
def test_errors_are_one_line(
    capsys, run: Path, monkeypatch, words: list[str], message: str
) -> None:
    monkeypatch.chdir(run.parent)
    assert export("run", "--format", "g2o", "--out", "a.g2o") == 0
    assert export("run", "--format", "kitti", "--out", "kitti.txt") == 0
    capsys.readouterr()
    assert export(*words) == 1
    errors = capsys.readouterr().err
    assert message in errors
    assert errors.count("\n") == 1
    assert not Path("a").exists()


@pytest.mark.parametrize(
    ("words", "written"),
    [
        (["a_times.txt", "--format", "kitti", "--out", "a.txt"], "a_times.txt"),
        (["kitti.txt", "--times", "a_times.txt", "--format", "kitti", "--out", "a"], "a_times.txt"),
        (["kitti.txt", "--times", "a_times.txt", "--format", "tum", "--out", "a_times.txt"], ""),
    ],
)
def test_what_is_read_is_not_written(capsys, run: Path, monkeypatch, words, written: str) -> None:
    monkeypatch.chdir(run.parent)
    assert export("run", "--format", "kitti", "--out", "kitti.txt") == 0
    from_times = "--times" in words
    given = Path("kitti_times.txt" if from_times else "run/trajectory.txt").read_bytes()
    Path("a_times.txt").write_bytes(given)
    assert export(*words) == 1
    assert f"{written or words[-1]}: is (in) the input, which stays" in capsys.readouterr().err
    assert Path("a_times.txt").read_bytes() == given
    assert not Path("a").exists()
