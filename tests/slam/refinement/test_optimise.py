"""``bmask-slam optimise`` from a g2o file to a g2o file and a picture."""

from pathlib import Path
from unittest.mock import Mock

import matplotlib.image
import numpy as np
import pytest

from bmask_slam import cli
from bmask_slam.graph.g2o.pose_graphs import read_g2o
from bmask_slam.refinement import optimise

SIDE = 8


def square_text(wrong: bool = False, vertices: bool = True) -> str:
    """Two laps round a square of eight poses, 2-D, the second tied to the first."""
    lines, count = [], 2 * SIDE
    for k in range(count):
        lines += [f"VERTEX_SE2 {k} {k} 0 0.1"] if vertices else []
    turn = np.pi / 4
    for k in range(count - 1):
        lines.append(f"EDGE_SE2 {k} {k + 1} 1 0 {turn} 100 0 0 100 0 400")
    lines += [f"EDGE_SE2 {k} {k + SIDE} 0 0 0 100 0 0 100 0 400" for k in range(SIDE)]
    lines += ["EDGE_SE2 1 12 5 5 1 100 0 0 100 0 400"] if wrong else []
    return "\n".join(lines) + "\n"


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "in.g2o"
    path.write_text(square_text())
    return path


@pytest.mark.parametrize("method", ["lm", "dogleg", "gnc"])
@pytest.mark.parametrize("vertices", [True, False])
def test_the_optimum_of_a_closed_walk_is_found(
    capsys, file: Path, tmp_path: Path, method: str, vertices: bool
) -> None:
    file.write_text(square_text(vertices=vertices))
    out, plot = tmp_path / "out.g2o", tmp_path / "out.png"
    words = ["optimise", file, "--out", out, "--method", method, "--plot", plot]
    assert cli.main([str(word) for word in words]) == 0
    graph = read_g2o(out)
    np.testing.assert_allclose(graph.poses[SIDE:, :2, 3], graph.poses[:SIDE, :2, 3], atol=1e-4)
    steps_m = np.linalg.norm(np.diff(graph.poses[:, :2, 3], axis=0), axis=1)
    np.testing.assert_allclose(steps_m, 1.0, atol=1e-4)
    printed = capsys.readouterr().out
    assert "vertices       16 (2-D)" in printed
    assert f"method         {method}" in printed
    assert "final cost" in printed
    assert str(plot) in printed
    assert matplotlib.image.imread(plot).std() > 0.02


def test_wrong_loops_are_not_in_the_output(capsys, file: Path, tmp_path: Path) -> None:
    file.write_text(square_text(wrong=True))
    out, plot = tmp_path / "out.g2o", tmp_path / "out.svg"
    words = ["optimise", file, "--out", out, "--method", "gnc", "--plot", plot]
    assert cli.main([str(word) for word in words]) == 0
    assert "outliers       1 edges" in capsys.readouterr().out
    assert len(read_g2o(out).edges) == len(read_g2o(file).edges) - 1
    assert plot.stat().st_size > 1000


def test_a_3d_picture(file: Path, tmp_path: Path) -> None:
    information = "100 0 0 0 0 0 100 0 0 0 0 100 0 0 0 100 0 0 100 0 100"
    steps = ["1 0 0", "0 1 0", "0 0 1"]
    file.write_text(
        "".join(
            f"EDGE_SE3:QUAT {k} {k + 1} {step} 0 0 0 1 {information}\n"
            for k, step in enumerate(steps)
        )
    )
    out, plot = tmp_path / "out.g2o", tmp_path / "out.png"
    assert cli.main(["optimise", str(file), "--out", str(out), "--plot", str(plot)]) == 0
    np.testing.assert_allclose(read_g2o(out).poses[3, :3, 3], [1, 1, 1], atol=1e-9)
    assert matplotlib.image.imread(plot).std() > 0.02


def test_quiet_prints_only_the_path(capsys, file: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.g2o"
    assert cli.main(["optimise", str(file), "--out", str(out), "--quiet"]) == 0
    assert capsys.readouterr() == (f"{out}\n", "")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["none.g2o", "--out", "b.g2o"], "none.g2o: no such file"),
        (["run", "--out", "b"], "holds no graph; give the folder of a run"),
        (["in.g2o", "--out", "./in.g2o"], "in.g2o: is the input, which stays as it is"),
        (["in.g2o", "--out", "no/b.g2o"], "the folder no is not there"),
        (["in.g2o", "--out", "."], "a folder; give the name of a file"),
        (["in.g2o", "--out", "b.g2o", "--plot", "b.gif"], "cannot draw '.gif'"),
        (["run", "--out", "b", "--certify"], "--certify: is of pose graphs"),
        (["in.g2o", "--out", "b.g2o", "--certify"], "--certify: is of 3-D graphs"),
        (["in.g2o", "--out", "b.g2o", "--overwrite"], "--overwrite: is of run folders"),
        (["run", "--out", "b", "--method", "gnc"], "--method gnc: is of pose graphs"),
    ],
)
def test_errors_are_one_line(
    capsys, file: Path, monkeypatch, words: list[str], message: str
) -> None:
    monkeypatch.chdir(file.parent)
    Path("run").mkdir()
    Path("run/metrics.json").touch()
    assert cli.main(["optimise", *words]) == 1
    errors = capsys.readouterr().err
    assert message in errors
    assert errors.startswith("error: ")
    assert errors.count("\n") == 1
    assert not Path("b.g2o").exists()


def test_a_certificate_of_a_2d_graph_is_refused_before_the_work(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = Mock(side_effect=AssertionError("optimised"))
    monkeypatch.setattr(optimise, "optimise_pose_graph", asked)
    assert cli.main(["optimise", str(file), "--out", str(tmp_path / "b.g2o"), "--certify"]) == 1
    asked.assert_not_called()
