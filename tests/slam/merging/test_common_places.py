"""Places that two maps have in common, and rooms that only look alike."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from synthetic_view import (
    CAMERA,
    T_NEW_OLD,
    add_keyframe,
    make_features,
    points_before,
    random_descriptors,
)

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import se3_exp, transform
from bmask_slam.loops.closing import LoopClosingConfig
from bmask_slam.merging.common_places import (
    CommonPlaces,
    MergeConfig,
    PlaceSearch,
    T_older_newer,
)
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.world_map import WorldMap

HALF_TURN = se3_exp(np.array([0, np.pi, 0, 0, 0, 0.0]))
WALLS = (np.eye(4), HALF_TURN)
"""Cameras that look at the one wall and at the other."""


class Rooms:
    """A room with two walls of points, walked twice; the walls may change places in between."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng(5)
        self.walls = [points_before(T, 200, self.rng) for T in WALLS]
        self.descriptors = [random_descriptors(200, self.rng) for _ in WALLS]
        self.world = WorldMap()

    def walk(self, T_world_room: Array, moved: Sequence[Array], segment: int) -> list[Keyframe]:
        """Five keyframes before each wall; wall k is moved by ``moved[k]``."""
        found = []
        for wall, T_wall in enumerate(moved):
            points = transform(T_world_room @ T_wall, self.walls[wall])
            for step in range(5):
                shift = se3_exp(np.array([0, 0.02 * step, 0, 0.04 * step, 0, 0]))
                T = T_world_room @ T_wall @ WALLS[wall] @ shift
                features = make_features(T, points, self.descriptors[wall])
                keyframe = add_keyframe(self.world, T, features, segment)
                self.world.make_landmarks(keyframe, np.arange(200), points)
                found.append(keyframe)
        return found

    def search(self, moved: Sequence[Array]) -> CommonPlaces:
        """The common places of a first walk and a second one after the walls were moved."""
        older = self.walk(np.eye(4), (np.eye(4), np.eye(4)), 0)
        newer = self.walk(T_NEW_OLD, moved, 1)
        search = PlaceSearch(self.world, CAMERA, LoopClosingConfig(), MergeConfig())
        (found,) = search.between(older, newer)
        return found


def test_the_same_room_is_found_where_it_is() -> None:
    rooms = Rooms()
    found = rooms.search((np.eye(4), np.eye(4)))
    assert found.fault(MergeConfig()) == ""
    assert found.wrong == []
    assert found.confirmed == found.tested >= 8
    T_new_old = T_older_newer(rooms.world, found.loops)
    assert T_new_old @ T_NEW_OLD == pytest.approx(np.eye(4), abs=1e-3)


def test_a_room_with_the_walls_elsewhere_is_refused() -> None:
    aside = se3_exp(np.array([0, 0, 0, 1.5, 0, 0]))
    found = Rooms().search((np.eye(4), aside))
    assert found.contradicting > 3
    assert "recognised views put it at one place" in found.fault(MergeConfig())


def test_a_room_with_one_wall_alike_is_refused() -> None:
    rooms = Rooms()
    older = rooms.walk(np.eye(4), (np.eye(4), np.eye(4)), 0)
    rooms.descriptors[1] = random_descriptors(200, rooms.rng)
    newer = rooms.walk(T_NEW_OLD, (np.eye(4), np.eye(4)), 1)
    search = PlaceSearch(rooms.world, CAMERA, LoopClosingConfig(), MergeConfig())
    (found,) = search.between(older, newer)
    assert (found.confirmed, found.tested) == (5, 10)
    assert "of 10 views that both should have, 5 are the same" in found.fault(MergeConfig())


def test_few_loops_are_too_few() -> None:
    few = CommonPlaces((0, 1), [], [])
    assert few.fault(MergeConfig()).startswith("0 recognised views of 0 keyframes agree, 6 of 3")
