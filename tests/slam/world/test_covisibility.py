"""The shortest way through a map over keyframes that see the same landmarks."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_view import add_keyframe, make_features

from bmask_slam.graph.geometry import se3_exp
from bmask_slam.world.covisibility import MIN_SHARED, CovisiblePaths, Neighbours
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.world_map import WorldMap

COUNT = 12


def out_and_back() -> tuple[WorldMap, list[Keyframe]]:
    """Six steps of 1 m along x, a turn of 180 degrees in two, and four steps back."""
    world = WorldMap()
    points = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 4], (60, 3))
    features = make_features(np.eye(4), points, np.zeros((60, 8), np.uint64))
    places = [0, 1, 2, 3, 4, 5, 5, 5, 4, 3, 2, 1]
    turns = np.clip(np.arange(COUNT) - 5, 0, 2) * np.pi / 2
    turned = [se3_exp([0, turn, 0, 0, 0, 0]) for turn in turns]
    poses = [se3_exp([0, 0, 0, x, 0, 0]) @ T for x, T in zip(places, turned, strict=True)]
    return world, [add_keyframe(world, T, features) for T in poses]


def test_without_common_landmarks_the_way_is_that_of_the_camera() -> None:
    world, keyframes = out_and_back()
    paths = CovisiblePaths(world)
    poses = np.array([k.T_world_camera for k in keyframes])
    np.testing.assert_array_equal(paths.way(0, COUNT - 1).poses, poses)
    np.testing.assert_array_equal(paths.way(COUNT - 1, 2).poses, poses[:1:-1])
    np.testing.assert_array_equal(paths.way(3, 3).poses, poses[3:4])
    assert paths.way(0, 4).shared.tolist() == [0] * 4
    assert [paths.length_m(*ends) for ends in ((0, COUNT - 1), (3, 3))] == [9, 0]


@pytest.mark.parametrize("shared", [MIN_SHARED - 1, MIN_SHARED])
def test_landmarks_that_were_seen_again_make_it_shorter(shared: int) -> None:
    world, keyframes = out_and_back()
    rows = np.arange(shared)
    ids = world.make_landmarks(keyframes[2], rows, np.ones((shared, 3)))
    world.attach(keyframes[10], rows, ids)  # where it was before, looking the other way
    taken = [0, 1, 2, 10, 11] if shared == MIN_SHARED else range(COUNT)
    way = CovisiblePaths(world).way(0, COUNT - 1)
    np.testing.assert_array_equal(way.poses, [keyframes[k].T_world_camera for k in taken])


@pytest.mark.parametrize("shared", [MIN_SHARED - 1, MIN_SHARED])
@pytest.mark.parametrize("turned", [1, -1])
def test_a_way_tells_how_many_landmarks_its_steps_share(shared: int, turned: int) -> None:
    world, keyframes = out_and_back()
    rows = np.arange(shared)
    ids = world.make_landmarks(keyframes[2], rows, np.ones((shared, 3)))
    world.attach(keyframes[3], rows, ids)
    counted = CovisiblePaths(world).way(*(1, 5)[::turned]).shared
    assert counted.tolist() == [0, shared, 0, 0][::turned]


def test_culled_keyframes_are_stepped_over() -> None:
    world, keyframes = out_and_back()
    world.remove_keyframe(keyframes[3], keyframes[2])
    assert CovisiblePaths(world).length_m(0, 5) == 5
    assert len(CovisiblePaths(world).way(0, 5).poses) == 5


def test_segments_have_no_way_between_them() -> None:
    world, keyframes = out_and_back()
    for keyframe in keyframes[4:8]:
        keyframe.segment = 1
    paths = CovisiblePaths(world)
    nowhere = paths.way(0, 5)
    assert (nowhere.poses.shape, nowhere.shared.shape) == ((0, 4, 4), (0,))
    assert np.isinf(paths.length_m(0, 5))
    assert [paths.length_m(*ends) for ends in ((4, 6), (3, 8))] == [1, 1]


def change_at_random(world: WorldMap, rng: np.random.Generator) -> None:
    """One of the changes that a map goes through, of keyframes chosen at random."""
    first, second = (world.keyframes[k] for k in rng.choice([*world.keyframes], 2, replace=False))
    mine, others = (np.flatnonzero(k.landmark_ids >= 0) for k in (first, second))
    match rng.integers(6):
        case 0:
            rows = np.flatnonzero(first.free)[:20]
            ids = world.make_landmarks(first, rows, rng.uniform(size=(len(rows), 3)))
            free = np.flatnonzero(second.free)[: len(ids)]
            world.attach(second, free, ids[: len(free)])
        case 1:
            world.detach(first, mine[: rng.integers(10)])
        case 2:
            world.landmarks.remove(world.landmarks.remaining(first.landmark_ids[mine[:3]]))
        case 3 if len(world.keyframes) > 6:
            world.remove_keyframe(first, second)
        case 4:
            first.T_world_camera = first.T_world_camera @ se3_exp(rng.normal(size=6))
        case 5:
            ids = np.setdiff1d(second.landmark_ids[others[:4]], first.landmark_ids)
            own = np.setdiff1d(first.landmark_ids[mine[:4]], second.landmark_ids)
            count = min(len(ids), len(own))
            world.replace_landmarks(ids[:count], own[:count])


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_neighbours_that_follow_a_map_are_those_of_a_new_look(
    share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bmask_slam.world.covisibility.FEW", share)
    world, _ = out_and_back()
    neighbours, rng = Neighbours(), np.random.default_rng(3)
    most = 0
    for _ in range(150):
        for _ in range(rng.integers(1, 4)):
            change_at_random(world, rng)
        steps = neighbours.steps(world)
        for name, new in vars(Neighbours().steps(world)).items():
            np.testing.assert_array_equal(getattr(steps, name), new)
        most = max(most, len(steps.pairs) - len(steps.ids) + 1)
    assert most > 1  # landmarks made neighbours of some that do not follow each other
