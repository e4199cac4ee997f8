"""The landmark table: growth, ids, and landmarks that move with their host keyframes."""

import errno
import os

import numpy as np
import pytest

from bmask_slam.graph.geometry import inverse, se3_exp, transform
from bmask_slam.world.landmark_table import LandmarkTable

RNG = np.random.default_rng(8)


def columns(count: int, host: int = 0) -> dict[str, np.ndarray]:
    return {
        "points_world": RNG.normal(size=(count, 3)),
        "colours": RNG.integers(0, 255, (count, 3), dtype=np.uint8),
        "host": np.full(count, host),
    }


def test_a_table_grows_and_keeps_its_rows() -> None:
    table, points = LandmarkTable(), []
    for count in (3, 0, 900, 500, 5000, 1):
        new = columns(count)
        ids = table.add(new)
        assert ids.tolist() == list(range(len(table) - count, len(table)))
        points.append(new["points_world"])
        np.testing.assert_array_equal(table.points_world, np.concatenate(points))
    assert len(table) == 6404
    for name in ("descriptors", "directions", "patches", "in_map", "in_graph", "visible"):
        assert len(getattr(table, name)) == len(table), name


def test_defaults_of_a_new_landmark() -> None:
    table = LandmarkTable()
    table.add(columns(2000, host=7))
    assert table.in_map.all()
    assert not table.in_graph.any()
    assert (table.visible == 1).all()
    assert (table.found == 1).all()
    assert (table.observations == 0).all()
    assert (table.host == 7).all()
    assert (table.last_keyframe == -1).all()
    assert np.isnan(table.patch_views).all()  # it has no patch yet


def test_patches_are_those_in_memory_once_the_disk_is_full(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    table = LandmarkTable()
    ids = table.add(columns(3))
    table.patches[ids] = np.full((3, 4, 17, 17), 7, np.uint8)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "pwrite", full)
    table.remove(ids[:2])
    again = table.add(columns(2))
    assert table.patches[again].max() == 0
    assert table.patches[ids[2]].min() == 7


def test_attributes_write_through_to_the_table() -> None:
    table = LandmarkTable()
    ids = table.add(columns(5))
    table.points_world[ids[2]] = [1.0, 2.0, 3.0]
    table.found[ids] += 4
    table.add(columns(3000))
    assert table.points_world[2].tolist() == [1.0, 2.0, 3.0]
    assert table.found[:6].tolist() == [5, 5, 5, 5, 5, 1]


def test_ids_of_removed_landmarks_are_not_reused() -> None:
    table = LandmarkTable()
    ids = table.add(columns(6))
    table.in_graph[ids] = True
    table.remove(np.array([1, 4]))
    requested = np.array([-1, 4, 0, 1, 5, -1, 0])
    assert table.remaining(requested).tolist() == [0, 5, 0]
    assert np.flatnonzero(table.in_graph).tolist() == [0, 2, 3, 5]
    assert table.add(columns(2)).tolist() == [6, 7]
    assert len(table.remaining(np.zeros(0, np.int64))) == 0


def test_a_table_with_copies_gives_reserved_ids_alone() -> None:
    table = LandmarkTable()
    table.reserved_only = True
    assert table.add(columns(2)).tolist() == [-1, -1]
    assert len(table) == 0
    given = np.array([1, -1, 4])
    table.reserve(0, 6, given)
    new = columns(3)
    ids = table.add(new, given)
    assert ids.tolist() == [1, 0, 4]
    np.testing.assert_array_equal(table.points_world[ids], new["points_world"])
    assert np.flatnonzero(table.in_map).tolist() == [0, 1, 4]
    restored = LandmarkTable()
    restored.restore(table.state())
    restored.reserved_only = True
    for other in (table, restored):
        more = columns(4)
        assert other.add(more).tolist() == [2, 3, 5, -1]
        np.testing.assert_array_equal(other.points_world[[2, 3, 5]], more["points_world"][:3])
        other.reserve(9, 10, np.zeros(0, np.int64))  # 6 to 8 are of a keyframe that was lost
        assert other.add(columns(1)).tolist() == [9]
        assert len(other) == 10


def test_an_id_that_is_spare_and_in_the_map_is_refused() -> None:
    table = LandmarkTable()
    table.add(columns(3))
    with pytest.raises(ValueError, match="twice"):
        LandmarkTable().restore(table.state() | {"spare": np.array([1])})


def test_landmarks_move_rigidly_with_their_own_host() -> None:
    """In its host's frame a landmark does not move; other landmarks do not move at all."""
    table = LandmarkTable()
    for host in (3, 5, 9, 4):
        table.add(columns(4, host))
    before = table.points_world.copy()
    keyframes = np.array([3, 5, 9])
    T_old, T_new = se3_exp(RNG.normal(size=(2, 3, 6)))
    ids = np.array([0, 1, 5, 6, 7, 8, 12, 13])  # hosts 3, 3, 5, 5, 5, 9, and 4, which did not move
    table.move_with_hosts(ids, keyframes, T_old, T_new)
    for landmark in range(16):
        row = np.flatnonzero(keyframes == table.host[landmark])
        if landmark not in ids or not len(row):
            np.testing.assert_array_equal(table.points_world[landmark], before[landmark])
            continue
        k = row[0]
        in_host = transform(inverse(T_old[k]), before[[landmark]])
        now = transform(inverse(T_new[k]), table.points_world[[landmark]])
        np.testing.assert_allclose(now, in_host, atol=1e-12)


def test_an_unknown_column_raises() -> None:
    with pytest.raises(AttributeError):
        LandmarkTable().add({**columns(2), "colour_of_the_sky": np.zeros(2)})


def test_descriptor_rows_of_removed_landmarks_are_reused() -> None:
    table = LandmarkTable()
    first = table.add(columns(500))
    table.descriptors[first] = RNG.integers(0, 1 << 60, (500, 8), dtype=np.uint64)
    kept = table.descriptors[first[::2]]
    rows = len(table._appearance)
    for _ in range(20):
        dead = table.add(columns(200))
        table.descriptors[dead] = 5
        table.patch_views[dead] = 1.0
        table.remove(dead)
        table.descriptors[dead] = 7  # lost
        assert (table.descriptors[dead] == 0).all()
        assert np.isnan(table.patch_views[dead]).all()
    table.remove(first[1::2])
    newest = table.add(columns(300))
    assert (table.descriptors[newest] == 0).all()
    np.testing.assert_array_equal(table.descriptors[first[::2]], kept)
    assert len(table) == 4800
    assert len(table._appearance) <= 2 * rows


def test_a_copy_gets_the_current_landmarks() -> None:
    table = LandmarkTable()
    table.add(columns(6))
    table.extent[np.arange(6)] = np.arange(6.0)
    table.in_map[[1, 2]] = False  # for a moment
    table.set_in_map(np.array([1, 1, 0, 1, 1, 0], bool))
    assert table.extent[np.arange(6)].tolist() == [0, 1, 0, 3, 4, 0]
    table.extend_to(4)  # an owner that began anew
    table.extend_to(8)
    table.set_in_map(np.ones(8, bool))
    assert table.extent[np.arange(8)].tolist() == [0, 1, 0, 3, 0, 0, 0, 0]
    assert len(np.unique(table.row)) == 8
