"""Which objects are reported: by size, place and views; the floor that places are measured from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import se3_exp, transform
from bmask_slam.semantics.beliefs.class_sizes import read_sizes
from bmask_slam.semantics.beliefs.label_store import LabelStore
from bmask_slam.semantics.beliefs.observation import ObservationModel
from bmask_slam.semantics.labels import LabelSet, label_set
from bmask_slam.semantics.objects.boxes3d import OrientedBox
from bmask_slam.semantics.objects.config import ObjectConfig, PublicationConfig
from bmask_slam.semantics.objects.gravity import GravityEstimator
from bmask_slam.semantics.objects.object_map import pixel_rays
from bmask_slam.semantics.objects.points import ObjectPoints, Sightings
from bmask_slam.semantics.objects.publication import (
    LARGEST_M,
    SMALLEST_M,
    Ground,
    MapObject,
    ObjectPublisher,
    judged,
    same_things,
    size_and_place,
    stands_still,
)

NAMES = label_set(("cup", "chair", "couch", "tv", "person", "laptop"))
SIZES = read_sizes(NAMES)
CONFIG = PublicationConfig()
T_WORLD_ROOM = se3_exp(np.array([0.4, -0.9, 1.3, 2.0, -5.0, 1.0]))
UP_ROOM = np.array([0.0, 0.0, 1.0])
GROUND = Ground(
    T_WORLD_ROOM[:3, :3] @ UP_ROOM, float(T_WORLD_ROOM[:3, :3] @ UP_ROOM @ T_WORLD_ROOM[:3, 3])
)


def box(size_m: tuple[float, float, float], bottom_m: float, x_m: float = 0.0) -> OrientedBox:
    """A box in the room, whose floor is at height 0, in world coordinates."""
    T = np.eye(4)
    T[:3, 3] = x_m, 1.0, bottom_m + 0.5 * size_m[2]
    return OrientedBox(T_WORLD_ROOM @ T, np.array(size_m))


def log_p(name: str, size_m: tuple[float, float, float], bottom_m: float) -> float:
    found = size_and_place(box(size_m, bottom_m), GROUND, SIZES, CONFIG)
    return float(found[NAMES.number(name)])


def test_sizes_tell_classes_apart() -> None:
    tails = np.sqrt(np.pi / 2) * (CONFIG.large_sigma + CONFIG.small_sigma)
    usual = np.log(np.log(LARGEST_M / SMALLEST_M) / (np.log(0.2 / 0.06) + tails))
    assert log_p("cup", (0.1, 0.08, 0.1), 0.75) == pytest.approx(usual)
    log_m = np.linspace(-12, 8, 20_001)  # densities of ln(longest side) integrate to 1
    likelihood = [np.exp(log_p("cup", (m, 0.01, 0.01), 0.75)) for m in np.exp(log_m[::20])]
    density = np.array(likelihood) / np.log(LARGEST_M / SMALLEST_M)
    assert density.sum() * (log_m[20] - log_m[0]) == pytest.approx(1, abs=0.05)
    assert log_p("cup", (1.0, 0.3, 0.3), 0.75) == -CONFIG.most  # a cup is not 1 m
    assert log_p("couch", (0.2, 0.2, 0.15), 0.0) < -5  # a couch is not 20 cm
    assert log_p("couch", (2.0, 0.9, 0.8), 0.0) > 0.5
    assert 0 < log_p("chair", (0.4, 0.2, 0.3), 0.6) < 1  # a part of a chair above a table
    beyond = np.log(0.3 / 0.2) / CONFIG.large_sigma
    assert log_p("cup", (0.3, 0.1, 0.1), 0.75) == pytest.approx(usual - 0.5 * beyond**2)


def test_heights_tell_classes_apart() -> None:
    screen, open_laptop = (0.4, 0.08, 0.4), (0.35, 0.25, 0.25)
    usual = log_p("laptop", open_laptop, 0.75)
    assert usual > log_p("tv", screen, 0.75) > 0
    beyond = np.log(0.4 / 0.28) / CONFIG.large_sigma
    assert log_p("laptop", screen, 0.75) == pytest.approx(usual - 0.5 * beyond**2)
    assert log_p("laptop", (0.4, 0.4, 0.08), 0.75) == usual  # only what stands up is tall


def test_places_tell_classes_apart_by_heights_above_the_floor() -> None:
    chair = (0.5, 0.5, 0.9)
    usual = log_p("chair", chair, 0.0)
    assert usual > 0.5
    assert log_p("chair", chair, 1.6) == -CONFIG.most  # below the ceiling
    screen = (0.9, 0.1, 0.5)
    assert log_p("tv", screen, -0.1) == pytest.approx(
        log_p("tv", screen, 1.2) - 0.5 * (0.4 / 0.15) ** 2
    )
    cup = (0.1, 0.1, 0.1)
    assert log_p("cup", cup, 0.0) == pytest.approx(log_p("cup", cup, 0.7) - 0.5 * (0.2 / 0.15) ** 2)
    nowhere = size_and_place(box(chair, 1.6), Ground(GROUND.up_world), SIZES, CONFIG)
    assert nowhere[2] == pytest.approx(usual)  # nothing is known without a floor
    p = judged(np.array([0.3, 0.0, 0.7, 0, 0, 0, 0]), np.array([0, 0, -2.0, 0, 0, 0, 0]))
    assert p[2] == pytest.approx(0.7 * np.exp(-2) / (0.3 + 0.7 * np.exp(-2)))
    assert stands_still(SIZES).tolist() == [True, True, True, True, True, False, True]


def thing(number: int, label: int, at: OrientedBox, keyframes: int) -> MapObject:
    p, none = np.eye(len(NAMES))[label], np.zeros(0, np.int64)
    return MapObject(number, label, p, at.T_world_box[:3, 3], at, np.arange(keyframes), none, 0, 1)


def test_a_part_of_a_thing_is_joined_to_it() -> None:
    whole, part = box((0.9, 0.1, 0.5), 1.2), box((0.4, 0.1, 0.3), 1.3, 0.2)
    beside = box((0.9, 0.1, 0.5), 1.2, 1.0)
    things = [thing(4, 4, part, 3), thing(7, 4, whole, 9), thing(8, 4, beside, 5)]
    assert same_things(things).tolist() == [1, 1, 2]
    things[0] = thing(4, 1, part, 3)  # of another class
    assert same_things(things).tolist() == [0, 1, 2]


def test_books_side_by_side_are_two() -> None:
    first, second = box((0.03, 0.2, 0.25), 1.2), box((0.03, 0.2, 0.25), 1.2, 0.035)
    books = [thing(1, 1, first, 6), thing(2, 1, second, 4)]
    assert same_things(books).tolist() == [0, 1]  # keyframes have a mask on each
    books[1] = replace(books[1], keyframe_ids=np.arange(5, 9))
    assert same_things(books).tolist() == [0, 0]  # now the one, now the other


CAMERA = Camera(320, 240, fx=250.0, fy=250.0, cx=159.5, cy=119.5)


def looking_down(height_m: float, T_world_room: Array) -> tuple[GravityEstimator, dict[int, Array]]:
    """An estimator that saw a level plane from ``height_m`` above it, 30 degrees downwards."""
    rays = pixel_rays(CAMERA, 1)
    T_room_camera = np.eye(4)
    down = np.deg2rad(30)
    forward = np.array([np.cos(down), 0, -np.sin(down)])
    right = np.array([0.0, -1, 0])
    T_room_camera[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T_room_camera[:3, 3] = 0.5, 0.2, height_m
    slope = (rays @ T_room_camera[:3, :3].T)[..., 2]
    depth_m = np.where(slope < -0.05, -height_m / np.minimum(slope, -0.05), np.nan)
    found = GravityEstimator()
    found.add(3, depth_m.astype(np.float32), rays)
    return found, {3: T_world_room @ T_room_camera}


@pytest.mark.parametrize("T_world_room", [np.eye(4), T_WORLD_ROOM])
def test_the_floor_is_found_in_any_world(T_world_room: Array) -> None:
    found, poses = looking_down(1.4, T_world_room)
    up = T_world_room[:3, :3] @ UP_ROOM
    assert np.allclose(found.up_world(poses), up, atol=1e-3)
    floor_world = transform(T_world_room, np.array([[5.0, -3.0, 0.0]]))[0]
    assert found.floor_m(poses, up) == pytest.approx(up @ floor_world, abs=0.02)
    again = GravityEstimator()
    again.restore(found.state())
    assert again.floor_m(poses, up) == found.floor_m(poses, up)


def test_a_table_below_the_camera_is_no_floor() -> None:
    found, poses = looking_down(0.6, np.eye(4))
    assert np.isnan(found.floor_m(poses, UP_ROOM))
    state = found.state()
    del state["points"]  # as older versions wrote it
    found.restore(state)
    assert np.isnan(found.floor_m(poses, UP_ROOM))


def test_landmarks_behind_a_thing_are_not_on_it() -> None:
    chair = box((0.5, 0.5, 0.8), 0.0)
    room = np.array([[0.2, 1.0, 0.4], [0.34, 1.0, 0.4], [0.0, 3.0, 0.4], [np.nan] * 3])
    ids = np.arange(4)
    none = np.zeros(0, np.int64)
    found = MapObject(7, 2, np.eye(6)[2], np.zeros(3), chair, none, ids, 0.0, 1.0)
    kept = found.with_landmarks_at(transform(T_WORLD_ROOM, room)).landmark_ids
    assert kept.tolist() == [0, 1]  # the second is 9 cm outside, the third 1.75 m behind


def reported_labels(names: LabelSet, views: list[int], score: float) -> list[int]:
    """Labels of what is reported of a flat box of 35 cm, called so in views of such a score.

    It looks like a telephone, which a laptop does in three of ten cases.
    """
    count = len(names)
    confused, none = np.zeros((count, count)), np.zeros(count)
    confused[1, 2] = 0.3
    model = ObservationModel(
        np.zeros(4), np.array([0.5, 0, 0]), np.zeros(2), np.zeros(4), none, none, none, none,
        confused, read_sizes(names),
    )  # fmt: skip
    corners = np.stack(np.meshgrid([0, 0.35], [0, 0.25], [0, 0.04], indexing="ij"), -1)
    room = corners.reshape(-1, 3) + np.array([1.0, 1.0, 0.75])
    points, labels = ObjectPoints(), LabelStore(count, model=model, of_objects=True)
    points.new_ids(1)
    for k, view in enumerate(np.eye(count, dtype=np.float32)[views]):
        scores = np.full(1, score, np.float32)
        labels.update(np.zeros(1, int), view[None], scores, np.array([k]))
        points.add(Sightings(k, float(k), np.zeros(1, int)), room, np.zeros(8, int))
    publisher = ObjectPublisher(points, labels, ObjectConfig(), read_sizes(names))
    ground = Ground(UP_ROOM, 0.0)
    return [o.label for o in publisher.objects({k: np.eye(4) for k in range(len(views))}, ground)]


def test_an_object_has_a_name_that_masks_gave_it() -> None:
    names = label_set(("cell phone", "laptop"))
    for named, expected in ((1, []), (2, [2])):
        assert reported_labels(names, [1, 1, named], 1.0) == expected


def test_a_name_counts_where_others_outvoted_it() -> None:
    names = label_set(("cell phone", "laptop", "mouse"))
    for views, expected in (([1, 1, 1], []), ([1, 1, 2], [2]), ([2, 1, 1, 1], [2])):
        assert reported_labels(names, views, 0.6) == expected
