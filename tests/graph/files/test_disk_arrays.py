"""Arrays in files without a name: equal to those in memory, also where the disk is full."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bmask_slam.graph.files import disk_arrays
from bmask_slam.graph.files.disk_arrays import DiskRecords, DiskRows, concatenated

RNG = np.random.default_rng(5)


def arrays(count: int) -> dict[str, Any]:
    return {
        "pixels": RNG.normal(size=(count, 2)),
        "bits": RNG.integers(0, 1 << 60, (count, 8), dtype=np.uint64),
        "colours": np.asfortranarray(RNG.integers(0, 255, (count, 3), np.uint8)),
        "none": np.zeros((0, 3)),
    }


def same(a: dict[str, Any], b: dict[str, Any]) -> bool:
    return all(
        a[name].dtype == b[name].dtype and np.array_equal(a[name], b[name]) for name in (*a, *b)
    )


def on_disk(array: Any) -> bool:
    return not array.flags.owndata and not array.flags.writeable


def own_bytes() -> int:
    """Resident memory that is no file's."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("RssAnon")) * 1024


def test_stored_arrays_are_equal_and_read_only() -> None:
    records, given = DiskRecords(), [arrays(count) for count in (1, 300, 0, 2000)]
    stored = [records.stored(group) for group in given]
    records.release()
    assert all(map(same, given, stored))
    assert on_disk(stored[1]["pixels"])
    with pytest.raises(ValueError, match="read-only"):
        stored[1]["pixels"][0] = 1.0


def test_arrays_are_stored_again_after_a_map_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    records, given = DiskRecords(), arrays(9)
    records.stored(given)

    def none_left(*_: Any) -> None:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    with monkeypatch.context() as patch:
        patch.setattr(disk_arrays._File, "map", none_left)
        records.stored({"a": np.ones(2_000_000)})
    large = {"a": np.full(1_200_000, 2.0)}
    assert same(records.stored(large), large)
    assert same(records.stored(given), given)


def test_memory_does_not_grow_with_what_is_stored() -> None:
    records, kept = DiskRecords(), []
    kept.append(records.stored({"a": np.zeros(100_000)}))
    before = own_bytes()
    for k in range(60):
        kept.append(records.stored({"a": np.full(100_000, k)}))  # 48 MB in all
        records.release()
    assert own_bytes() - before < 10e6
    assert all((group["a"] == k).all() for k, group in enumerate(kept[1:]))


def test_the_space_of_what_nobody_holds_is_used_again() -> None:
    records = DiskRecords()
    kept = [records.stored(arrays(500)) for _ in range(4)]
    end, view = records._end, kept[1]["pixels"][10:20].T
    expected = view.copy()
    del kept[1]  # a view of it is alive
    kept.append(records.stored(arrays(500)))
    assert records._end > end
    np.testing.assert_array_equal(view, expected)
    end = records._end
    del view
    new = arrays(490)
    assert same(records.stored(new), new)
    assert records._end == end


def test_rows_are_those_of_an_array_in_memory() -> None:
    rows, reference = DiskRows(1, (3, 2), np.uint8), np.zeros((1, 3, 2), np.uint8)
    for _ in range(30):
        more = int(RNG.integers(1, 40))
        rows.grow(more)
        reference = np.concatenate([reference, np.zeros((more, 3, 2), np.uint8)])
        at = RNG.permutation(len(reference))[: RNG.integers(0, len(reference))]
        values = RNG.integers(0, 255, (len(at), 3, 2), np.uint8)
        rows.write(at, values)
        reference[at] = values
        rows.write(at[:3], np.full((), 7, np.uint8))
        reference[at[:3]] = 7
        rows.release()
        np.testing.assert_array_equal(rows.rows, reference)


@pytest.mark.parametrize("least", [0, 1 << 30])
def test_concatenated_arrays_are_those_of_numpy(
    least: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(disk_arrays, "CHUNK", least)
    pieces = [RNG.normal(size=(count, 3)).astype(np.float32) for count in (4, 0, 7)]
    found = concatenated(iter(pieces), 11, np.zeros((0, 3), np.float32))
    assert on_disk(found) == (least == 0)
    np.testing.assert_array_equal(found, np.concatenate(pieces))
    assert concatenated([], 0, np.zeros((0, 3), np.float32)).shape == (0, 3)


@pytest.mark.parametrize("call", ["pwrite", "ftruncate"])
def test_a_full_disk_leaves_arrays_in_memory(
    call: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    records, rows, early = DiskRecords(), DiskRows(4, (2,), np.uint8), arrays(50)
    stored = records.stored(early)
    rows.write(np.array([1, 3]), np.array([[1, 2], [5, 6]], np.uint8))

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, call, full)
    monkeypatch.setattr(disk_arrays, "_failed", set())
    rows.grow(2)
    rows.write(np.array([0, 5]), np.array([[9, 9], [8, 8]], np.uint8))
    large = {"a": np.full(2_000_000, 3.0)}
    assert same(records.stored(large), large)
    assert same(stored, early)
    assert rows.rows.tolist() == [[9, 9], [1, 2], [0, 0], [5, 6], [0, 0], [8, 8]]
    assert [r.getMessage() for r in caplog.records] == [
        "temporary files: No space left on device; the map stays in memory"
    ]
