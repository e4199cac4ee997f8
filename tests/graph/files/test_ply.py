"""PLY: round trip, bytes of the format, and rejected files."""

from pathlib import Path

import numpy as np
import pytest

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.ply import read_ply, write_ply

TYPES = [np.float32, np.float64, np.int8, np.uint8, np.int16, np.uint16, np.int32, np.uint32]


@pytest.mark.parametrize("count", [0, 1, 57])
def test_every_type_is_read_back(tmp_path: Path, count: int) -> None:
    rng = np.random.default_rng(0)
    columns = {f"c{i}": (100 * rng.random(count)).astype(t) for i, t in enumerate(TYPES)}
    write_ply(tmp_path / "a.ply", columns, "a comment")
    found = read_ply(tmp_path / "a.ply")
    assert list(found) == list(columns)
    for name, column in columns.items():
        assert found[name].dtype == column.dtype
        np.testing.assert_array_equal(found[name], column)
    assert [p.name for p in tmp_path.iterdir()] == ["a.ply"]


def test_the_bytes_are_those_of_the_format(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", {"x": np.float32([1.0]), "red": np.uint8([7])})
    header = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
    header += b"property float x\nproperty uchar red\nend_header\n"
    assert (tmp_path / "a.ply").read_bytes() == header + b"\x00\x00\x80\x3f\x07"


@pytest.mark.parametrize(
    "columns",
    [
        {"x": np.zeros(2), "y": np.zeros(3)},
        {"x": np.zeros((2, 3))},
        {"x": np.zeros(2, np.int64)},
        {},
    ],
)
def test_columns_that_do_not_fit(tmp_path: Path, columns: dict[str, np.ndarray]) -> None:
    with pytest.raises(ValueError, match="PLY"):
        write_ply(tmp_path / "a.ply", columns)
    assert list(tmp_path.iterdir()) == []


def test_broken_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    with pytest.raises(InputError, match="no such file"):
        read_ply(path)
    write_ply(path, {"x": np.zeros(5)})
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(InputError, match="39 bytes for 5 vertices; the file is cut off"):
        read_ply(path)
    path.write_text("ply\nformat ascii 1.0\nend_header\n")
    with pytest.raises(InputError, match="not a PLY file of"):
        read_ply(path)


HEADER = "ply\nformat binary_little_endian 1.0\n"


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("element face 1\nproperty list uchar int vertex_indices\n", "first element is 'face'"),
        ("element vertex 1\nproperty list uchar int x\n", "a list property"),
        ("element vertex many\nproperty float x\n", "'many'"),
        ("element vertex -1\nproperty float x\n", "no vertex"),
        ("element vertex 1\nproperty float\n", "out of range"),
        ("element vertex 1\nproperty float x\nproperty float x\n", "x"),
        ("element vertex 1\n\n", "no vertex with properties"),
    ],
)
def test_broken_headers_are_refused(tmp_path: Path, header: str, message: str) -> None:
    path = tmp_path / "a.ply"
    path.write_text(f"{HEADER}{header}end_header\n" + 20 * "x")
    with pytest.raises(InputError, match="its header cannot be read") as error:
        read_ply(path)
    assert message in str(error.value)


def test_data_after_the_vertices_is_skipped(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    header = HEADER + "element vertex 2\nproperty uchar x\n"
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_bytes(header.encode() + b"\x05\x07" + b"\x03abcdefghijkl")
    assert {name: column.tolist() for name, column in read_ply(path).items()} == {"x": [5, 7]}


def test_a_column_that_is_needed(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", {"x": np.zeros(2, np.float32), "y": np.ones(2, np.float32)})
    assert list(read_ply(tmp_path / "a.ply", ("x", "y"))) == ["x", "y"]
    with pytest.raises(InputError, match=r"a\.ply: has no column 'z'; make it again"):
        read_ply(tmp_path / "a.ply", ("x", "z"))
