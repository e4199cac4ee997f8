"""Files of named arrays: round trip, equal bytes, and errors for damaged files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.array_file import (
    FileKind,
    check_like,
    nested,
    part,
    read_arrays,
    split_rows,
    write_arrays,
)

KIND = FileKind("shoebox", 3)
ARRAYS = {
    "ids": np.arange(5),
    "a.points": np.array([[1.0, np.nan, -0.0]]),
    "a.b.names": np.array(["loop", ""]),
    "count": np.array(7),
    "nothing": np.zeros((0, 4, 4)),
}


@pytest.fixture
def file(tmp_path: Path) -> Path:
    write_arrays(tmp_path / "box", KIND, {"colour": "red"}, ARRAYS)
    return tmp_path / "box"


def test_what_was_written_is_read(file: Path) -> None:
    header, arrays = read_arrays(file, KIND)
    assert header["colour"] == "red"
    assert list(arrays) == list(ARRAYS)
    for name, array in ARRAYS.items():
        assert (arrays[name].dtype, arrays[name].shape) == (array.dtype, array.shape)
        assert arrays[name].tobytes() == array.tobytes()
    assert [path.name for path in file.parent.iterdir()] == ["box"]


def test_a_compressed_file_is_smaller_with_the_same_contents(file: Path, tmp_path: Path) -> None:
    arrays = {**ARRAYS, "room": np.zeros((1000, 3))}
    for kind, name in ((KIND, "plain"), (replace(KIND, compressed=True), "tight")):
        write_arrays(tmp_path / name, kind, {}, arrays)
        assert read_arrays(tmp_path / name, KIND)[1]["room"].shape == (1000, 3)
    assert (tmp_path / "tight").stat().st_size < 0.2 * (tmp_path / "plain").stat().st_size


def test_the_same_contents_are_the_same_bytes(file: Path) -> None:
    before = file.read_bytes()
    write_arrays(file, KIND, {"colour": "red"}, ARRAYS)
    assert file.read_bytes() == before


def test_every_damaged_byte_is_found(file: Path) -> None:
    """A changed byte that raises no error does not change the contents."""
    whole = file.read_bytes()
    for at in range(0, len(whole), 13):
        file.write_bytes(whole[:at] + bytes([whole[at] ^ 0x10]) + whole[at + 1 :])
        try:
            header, arrays = read_arrays(file, KIND)
        except InputError as error:
            assert str(file) in str(error)
            continue
        assert header["colour"] == "red"
        assert list(arrays) == list(ARRAYS)
        assert all(arrays[name].tobytes() == ARRAYS[name].tobytes() for name in ARRAYS)


@pytest.mark.parametrize("length", [0, 1, 100, 1000, -1, -22])
def test_a_truncated_file_is_refused(file: Path, length: int) -> None:
    file.write_bytes(file.read_bytes()[:length])
    with pytest.raises(InputError, match=r"box: not a saved shoebox, or a damaged one"):
        read_arrays(file, KIND)


def test_another_kind_another_version_and_a_missing_file(file: Path) -> None:
    with pytest.raises(InputError, match=r"box: holds 'bmask-slam shoebox' version 3, expected"):
        read_arrays(file, FileKind("shoebox", 4))
    with pytest.raises(InputError, match=r"expected 'bmask-slam hatbox' version 3"):
        read_arrays(file, FileKind("hatbox", 3))
    with pytest.raises(InputError, match=r"none: there is no saved shoebox here"):
        read_arrays(file.with_name("none"), KIND)
    np.save(file.with_name("plain"), np.zeros(3))
    with pytest.raises(InputError, match=r"plain\.npy: not a saved shoebox"):
        read_arrays(file.with_name("plain.npy"), KIND)


def test_a_pickle_is_never_executed(file: Path) -> None:
    np.savez(file.open("wb"), header=np.array([{}], object), allow_pickle=True)
    with pytest.raises(InputError, match=r"not a saved shoebox"):
        read_arrays(file, KIND)


def test_a_failed_write_keeps_the_old_file(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = file.read_bytes()

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(InputError, match=r"box: the shoebox cannot be written \(No space left"):
        write_arrays(file, KIND, {}, {})
    assert file.read_bytes() == before
    assert [path.name for path in file.parent.iterdir()] == ["box"]


def test_parts_are_read_back() -> None:
    inner = {"x": np.arange(2), "y.z": np.arange(3)}
    arrays = nested(a=inner, ab={"x": np.arange(4)})
    assert list(arrays) == ["a.x", "a.y.z", "ab.x"]
    assert part(arrays, "a") == inner
    assert part(part(arrays, "a"), "y")["z"] is inner["y.z"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"new": np.zeros(1)}, "array 'new' is unknown"),
        ({"ids": None}, "array 'ids' is missing"),
        ({"ids": np.zeros(5)}, "array 'ids' holds float64 of shape .'N',., not int64"),
        ({"nothing": np.zeros((0, 4))}, r"holds float64 of shape .'N', 4., not .*'N', 4, 4"),
    ],
)
def test_arrays_of_another_type_or_shape_are_rejected(change: dict, message: str) -> None:
    longer = {**ARRAYS, "ids": np.arange(9), "a.b.names": np.array(["bridge"])}
    check_like(longer, ARRAYS, Path("box"))
    found = {name: array for name, array in {**ARRAYS, **change}.items() if array is not None}
    with pytest.raises(InputError, match=f"box: .*{message}"):
        check_like(found, ARRAYS, Path("box"))


def test_columns_of_unequal_length_are_read_back() -> None:
    columns = [np.arange(3), np.zeros(0, int), np.arange(5, 7)]
    counts = np.array([len(column) for column in columns])
    for found, column in zip(split_rows(np.concatenate(columns), counts), columns, strict=True):
        np.testing.assert_array_equal(found, column)
    assert split_rows(np.zeros((0, 3)), np.zeros(0, np.int64)) == []
    for wrong in ([1, -1], [2, 2], [2**62, 2**62, 2**62, 2**62 + 3]):  # the last sum overflows to 3
        with pytest.raises(ValueError, match="3 rows where"):
            split_rows(np.zeros((3, 2)), np.array(wrong))
