"""Relations of boxes in space, in any world."""

from __future__ import annotations

import numpy as np
import pytest

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.semantics.objects.boxes3d import OrientedBox
from bmask_slam.semantics.objects.relations import Relation, distance_m, relations

UP = np.array([0.0, 0.0, 1.0])


def box(
    x: float, y: float, bottom_m: float, size_m: tuple[float, float, float], turn: float = 0.3
) -> OrientedBox:
    T = se3_exp(np.array([0, 0, turn, 0, 0, 0]))
    T[:3, 3] = x, y, bottom_m + 0.5 * size_m[2]
    return OrientedBox(T, np.array(size_m))


TABLE = box(0, 0, 0.3, (1.6, 0.9, 0.4))  # its top at 0.7
CUP = box(0.4, 0.1, 0.71, (0.1, 0.08, 0.1))
BIN = box(-0.3, 0.0, 0.0, (0.3, 0.3, 0.28))
CHAIR = box(0.2, 0.8, 0.0, (0.5, 0.5, 0.9))
SHELF = box(3.0, 0, 0.0, (0.4, 1.0, 2.0))
BOOK = box(3.0, 0.1, 1.0, (0.2, 0.05, 0.25))
LAMP = box(0.4, 0.1, 2.2, (0.3, 0.3, 0.3))
THINGS = [TABLE, CUP, BIN, CHAIR, SHELF, BOOK, LAMP]


@pytest.mark.parametrize("T_world_room", [np.eye(4), se3_exp(np.array([0.7, -1, 0.4, 3, 1, -2]))])
def test_things_on_under_inside_and_beside_others(T_world_room: Array) -> None:
    moved = [OrientedBox(T_world_room @ b.T_world_box, b.size_m) for b in THINGS]
    found = relations(moved, T_world_room[:3, :3] @ UP)
    table, cup, under, chair, shelf, book, lamp = range(7)
    assert Relation(cup, "on", table) in found
    assert Relation(under, "under", table) in found
    assert Relation(book, "inside", shelf) in found
    assert Relation(chair, "beside", table) in found
    assert Relation(table, "beside", chair) in found
    assert Relation(table, "under", lamp) not in found  # the lamp covers little of it
    assert Relation(cup, "under", lamp) in found
    pairs = {(r.subject, r.object) for r in found}
    assert len(pairs) == len(found)  # one relation a pair and direction
    assert not {(lamp, table), (table, cup), (shelf, book), (shelf, table)} & pairs


def test_the_distance_of_a_place_from_a_box() -> None:
    at = box(1, 2, 0.0, (2.0, 1.0, 1.0), turn=0.0)
    assert distance_m(at, np.array([1.2, 2.1, 0.3])) == 0
    assert distance_m(at, np.array([5.0, 2.0, 0.5])) == pytest.approx(3.0)
    assert distance_m(at, np.array([2 + 3.0, 2.5 + 4.0, 0.5])) == pytest.approx(5.0)
