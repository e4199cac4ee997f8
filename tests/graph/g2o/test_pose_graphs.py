"""g2o files: order of values, GTSAM's reader as a reference, round trips, errors."""

from pathlib import Path

import gtsam
import numpy as np
import pytest
from pose_graph_rings import ring

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.g2o.pose_graphs import read_g2o, write_g2o
from bmask_slam.graph.geometry import make_pose, rotation_from_quaternion
from bmask_slam.graph.pose_graph.factors import pose_graph_cost

EDGE_2D = "EDGE_SE2 3 7 1 2 0.5 11 12 13 22 23 33\n"
VERTICES_2D = "VERTEX_SE2 7 4 5 -0.5\nVERTEX_SE2 3 1 2 3\n"
# x y z qx qy qz qw, then rows of the upper triangle: translation first, rotation last
TRIANGLE = "101 2 3 4 5 6 102 8 9 10 11 103 13 14 15 104 17 18 105 20 106"
EDGE_3D = f"EDGE_SE3:QUAT 0 1 1 2 3 0 0 0.6 0.8 {TRIANGLE}\n"
VERTICES_3D = "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 1 2 3 0.5 0.5 0.5 0.5\n"


def read_text(tmp_path: Path, text: str):
    file = tmp_path / "a.g2o"
    file.write_text(text)
    return read_g2o(file)


def test_2d_values_are_read_in_order(tmp_path: Path) -> None:
    graph = read_text(tmp_path, "# a comment\n" + VERTICES_2D + "FIX 7\n" + EDGE_2D)
    assert graph.is_planar
    assert graph.ids.tolist() == [3, 7]
    assert graph.fixed.tolist() == [False, True]
    assert graph.edges.tolist() == [[0, 1]]
    np.testing.assert_allclose(graph.poses[1, :3, 3], [4, 5, 0])
    c, s = np.cos(0.5), np.sin(0.5)
    np.testing.assert_allclose(
        graph.measurements[0], [[c, -s, 0, 1], [s, c, 0, 2], [0, 0, 1, 0], [0, 0, 0, 1]]
    )
    np.testing.assert_array_equal(graph.information[0], [[11, 12, 13], [12, 22, 23], [13, 23, 33]])


def test_3d_information_is_reordered_to_rotation_first(tmp_path: Path) -> None:
    graph = read_text(tmp_path, VERTICES_3D + EDGE_3D)
    assert not graph.is_planar
    assert np.diagonal(graph.information[0]).tolist() == [104, 105, 106, 101, 102, 103]
    assert graph.information[0, 0, 3] == graph.information[0, 3, 0] == 4  # x of both kinds
    assert graph.information[0, 2, 4] == 11  # rotation z, translation y
    R = rotation_from_quaternion(np.array([0, 0, 0.6, 0.8]))
    np.testing.assert_allclose(graph.measurements[0], make_pose(R, np.array([1.0, 2, 3])))
    # a quarter turn of the axes about (1, 1, 1): x goes to y
    np.testing.assert_allclose(graph.poses[1, :3, 0], [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize("planar", [True, False])
def test_gtsam_reads_the_same_graph(tmp_path: Path, planar: bool) -> None:
    graph = ring(20, planar, seed=3, sigma=0.1)
    write_g2o(tmp_path / "a.g2o", graph)
    factors, values = gtsam.readG2o(str(tmp_path / "a.g2o"), not planar)
    assert factors.size() == len(graph.edges)
    assert pose_graph_cost(graph) == pytest.approx(factors.error(values), rel=1e-9)


@pytest.mark.parametrize("planar", [True, False])
def test_everything_is_read_back(tmp_path: Path, planar: bool) -> None:
    graph = ring(20, planar, seed=4, sigma=0.1)
    graph.fixed[[2, 5]] = True
    write_g2o(tmp_path / "a.g2o", graph)
    assert [p.name for p in tmp_path.iterdir()] == ["a.g2o"]
    found = read_g2o(tmp_path / "a.g2o")
    for name in ("ids", "edges", "fixed"):
        np.testing.assert_array_equal(getattr(found, name), getattr(graph, name))
    for name in ("poses", "measurements", "information"):
        np.testing.assert_allclose(getattr(found, name), getattr(graph, name), atol=1e-11)


def test_unknown_tags_are_counted_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    text = VERTICES_3D + "VERTEX_XY 1 2 3\nVERTEX_XY 2 2 3\nPARAMS 1\n" + EDGE_3D
    assert len(read_text(tmp_path, text).ids) == 2
    messages = [record.getMessage() for record in caplog.records]
    assert len(messages) == 2
    assert "2 lines of the unknown type VERTEX_XY" in messages[0]


def test_a_file_of_another_kind_is_not_told_line_by_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    text = "".join(f"{k}.5 rgb/{k}.png\n" for k in range(50))
    with pytest.raises(InputError, match="nothing to optimise"):
        read_text(tmp_path, text)
    messages = [record.getMessage() for record in caplog.records]
    assert len(messages) == 11
    assert "40 more unknown types" in messages[-1]


def test_the_largest_component_is_used(tmp_path: Path, caplog) -> None:
    def edge(i: int, j: int) -> str:
        return f"EDGE_SE2 {i} {j} {j - i} 0 0 1 0 0 1 0 1\n"

    vertices = "".join(f"VERTEX_SE2 {i} {i} 0 0\n" for i in range(7))
    graph = read_text(tmp_path, vertices + edge(0, 1) + edge(2, 4) + edge(4, 5) + edge(5, 2))
    assert graph.ids.tolist() == [2, 4, 5]
    assert graph.edges.tolist() == [[0, 1], [1, 2], [2, 0]]
    assert graph.poses[:, 0, 3].tolist() == [2, 4, 5]
    assert "4 parts that no edge connects" in caplog.text
    assert "4 vertices are left out" in caplog.text


def test_edges_without_vertices_give_a_graph_without_poses(tmp_path: Path) -> None:
    graph = read_text(tmp_path, EDGE_2D)
    assert graph.ids.tolist() == [3, 7]
    assert not graph.has_poses


def test_information_that_is_not_definite_is_counted_and_mended(tmp_path: Path, caplog) -> None:
    """xx and yy keep their 11 and 22, the angle's -5 becomes almost nothing."""
    bad = "EDGE_SE2 3 7 1 2 0.5 11 0 0 22 0 -5\n"
    text = VERTICES_2D + EDGE_2D.replace("33", "99") + 7 * bad
    with pytest.raises(
        InputError, match=r":4: .* 7 of 8 are not, .* 4 \(-5\), 5 .* 8 \(-5\), \.\.\.; "
    ):
        read_text(tmp_path, text)
    graph = read_g2o(tmp_path / "a.g2o", repair=True)
    assert "7 of 8 information matrices are not positive definite and were replaced" in caplog.text
    np.testing.assert_allclose(graph.information[1], np.diag([11, 22, 22e-9]), atol=1e-12)
    np.testing.assert_array_equal(np.diag(graph.information[0]), [11, 22, 99])


DIALECTS = {
    "TORO 2-D": (
        "VERTEX2 3 1 2 3\nVERTEX2 7 4 5 -0.5\nEDGE2 3 7 1 2 0.5 11 12 22 33 13 23\n",
        VERTICES_2D + EDGE_2D,
    ),
    "rows": (
        "ODOMETRY 3 7 1 2 0.5 11 0 0 22 0 33\n",
        "EDGE_SE2 3 7 1 2 0.5 11 0 0 22 0 33\n",
    ),
    "no information": ("EDGE2 3 7 1 2 0.5\n", "EDGE_SE2 3 7 1 2 0.5 1 0 0 1 0 1\n"),
    "quaternions": (
        VERTICES_3D.replace("_SE3:QUAT", "3") + EDGE_3D.replace("_SE3:QUAT", "3"),
        VERTICES_3D + EDGE_3D,
    ),
    "mixed": (VERTICES_3D.replace("_SE3:QUAT", "3") + EDGE_3D, VERTICES_3D + EDGE_3D),
}


@pytest.mark.parametrize(("text", "same"), DIALECTS.values(), ids=DIALECTS.keys())
def test_other_dialects_are_the_same_graph(tmp_path: Path, text: str, same: str) -> None:
    found = read_text(tmp_path, text)
    expected = read_text(tmp_path, same)
    for name in ("ids", "poses", "edges", "measurements", "information"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-12)


def test_angles_are_those_of_gtsam(tmp_path: Path) -> None:
    text = "VERTEX3 0 0 0 0 0 0 0\nVERTEX3 1 1 2 3 0.3 -0.5 1.1\nEDGE3 0 1 1 2 3 0.3 -0.5 1.1\n"
    graph = read_text(tmp_path, text)
    R = gtsam.Rot3.Ypr(1.1, -0.5, 0.3).matrix()
    np.testing.assert_allclose(graph.measurements[0], make_pose(R, np.array([1.0, 2, 3])))
    np.testing.assert_allclose(graph.poses[1], graph.measurements[0])
    np.testing.assert_array_equal(graph.information[0], np.eye(6))
    with pytest.raises(InputError, match=":1: 5 values after EDGE3"):
        read_text(tmp_path, "EDGE3 0 1 1 2 3\n")


GOOD_2D = "EDGE_SE2 3 7 1 2 0.5 1 0 0 1 0 1\n"
BAD = {
    "6 columns": (
        VERTICES_2D + "EDGE_SE2 3 7 1 2 0.5 1\n",
        ":3: 6 values after EDGE_SE2, expected 11",
    ),
    "nan": (VERTICES_2D + GOOD_2D.replace("0.5", "nan"), ":3: 'nan' is not a finite number"),
    "word": ("VERTEX_SE2 3 1 x 3\n", ":1: 'x' is not a finite number"),
    "id": ("VERTEX_SE2 -3 1 2 3\n", ":1: '-3' is no vertex id"),
    "huge id": (f"VERTEX_SE2 {2**63} 1 2 3\n", "is no vertex id"),
    "missing": (VERTICES_2D + GOOD_2D + GOOD_2D.replace("7", "8"), ":4: an edge to vertex 8"),
    "twice": (VERTICES_2D + "VERTEX_SE2 3 1 2 3\n" + GOOD_2D, ":3: vertex 3 is there twice"),
    "indefinite": (
        VERTICES_2D + "\n" + EDGE_2D.replace("33", "1"),
        ":4: an information matrix that is not positive",
    ),
    "self": (GOOD_2D.replace("7", "3"), ":1: an edge from vertex 3 to itself"),
    "mixed": (VERTICES_2D + GOOD_2D + VERTICES_3D, ":4: 3-D in a file that also has SE2"),
    "quaternion": ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 0\n", ":1: a zero quaternion"),
    "fix": (VERTICES_2D + "FIX 4\n" + GOOD_2D, ":3: FIX 4, a vertex that is not there"),
    "fix alone": ("FIX 3\nFIX 7\n" + GOOD_2D, ":2: several FIX without vertex lines"),
    "empty": ("", "no EDGE_SE2 or EDGE_SE3:QUAT line"),
}


@pytest.mark.parametrize(("text", "message"), BAD.values(), ids=BAD.keys())
def test_broken_files_are_refused_with_their_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError) as error:
        read_text(tmp_path, text)
    assert str(error.value).startswith(f"{tmp_path / 'a.g2o'}:")
    assert message in str(error.value)


def test_no_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_g2o(tmp_path / "none.g2o")
