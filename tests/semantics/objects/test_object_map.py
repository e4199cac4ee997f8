"""Objects from detections: cards before a wall, and a camera that moves sideways."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from bmask_slam.graph.arrays import Array, Arrays
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import se3_exp, transform
from bmask_slam.semantics.beliefs.label_store import LabelStore
from bmask_slam.semantics.beliefs.pixel_assignment import assign_pixels
from bmask_slam.semantics.beliefs.surface_geometry import Ground
from bmask_slam.semantics.beliefs.vote_config import VoteConfig
from bmask_slam.semantics.instances.instances import Instance, certain, mask_box
from bmask_slam.semantics.objects.association import AssociationConfig, Evidence, Overlap, assign
from bmask_slam.semantics.objects.config import ObjectConfig
from bmask_slam.semantics.objects.object_map import (
    KeyframeView,
    ObjectMap,
    pixel_rays,
)
from bmask_slam.semantics.objects.points import ObjectPoints, Sightings
from bmask_slam.semantics.objects.publication import MapObject
from bmask_slam.semantics.objects.revision import RevisionConfig, merges

CAMERA = Camera(320, 240, fx=260.0, fy=262.0, cx=160.5, cy=119.0)
SIZE = (240, 320)
C = 4
RAYS = pixel_rays(CAMERA, 2)
UP = np.array([0.0, -1.0, 0.0])
HERE = np.eye(4)


@dataclass(frozen=True)
class Card:
    """A rectangle at z = 2 m: x from left to right, y from top to bottom."""

    left: float
    right: float
    label: int = 1
    top: float = -0.3
    bottom: float = 0.3
    extra: float = 0.0


CHAIRS = [Card(-0.42, -0.01), Card(0.01, 0.42)]


class Scene:
    """An object map of views of the cards; ``T_world_scene`` moves everything."""

    def __init__(self, T_world_scene: Array = HERE, config: ObjectConfig | None = None) -> None:
        self.T_world_scene = T_world_scene
        self.map = ObjectMap(CAMERA, LabelStore(C), config)
        self.poses: dict[int, Array] = {}

    def show(self, x: float, cards: list[Card], score: float = 0.9) -> np.ndarray:
        """Add a keyframe at x with an instance for each card; returns their objects."""
        number = len(self.poses)
        T_scene_camera = se3_exp(np.array([0, 0.05 * x, 0, x, 0, 0]))
        self.poses[number] = self.T_world_scene @ T_scene_camera
        instances, depth_m = instances_of(T_scene_camera, cards, score)
        assignment = assign_pixels(instances, depth_m, SIZE, VoteConfig())
        own = self.poses[number]
        view = KeyframeView(number, number / 2, own, depth_m, RAYS, assignment, dict(self.poses))
        objects = self.map.add(view)
        order = [
            next(k for k, i in enumerate(assignment.instances) if i is given) for given in instances
        ]
        return objects[order]

    def objects(self) -> list[MapObject]:
        return self.map.objects(self.poses, Ground(self.T_world_scene[:3, :3] @ UP))


def instances_of(T: Array, cards: list[Card], score: float) -> tuple[list[Instance], np.ndarray]:
    """Instances of the cards that are in the image, and every second pixel of its depth."""
    rays = pixel_rays(CAMERA, 1) @ T[:3, :3].T
    instances, z_m = [], (3.0 - T[2, 3]) / rays[..., 2]
    at = T[:3, 3] + rays * ((2.0 - T[2, 3]) / rays[..., 2])[..., None]
    for card in cards:
        mask = (at[..., 0] > card.left) & (at[..., 0] < card.right)
        mask &= (at[..., 1] > card.top) & (at[..., 1] < card.bottom)
        z_m = np.where(mask, (2.0 - T[2, 3]) / rays[..., 2], z_m)
        if mask.any():
            own = score + card.extra
            p = certain(card.label, C, own)
            instances.append(Instance(mask, mask_box(mask), card.label, p, own, own))
    noise = np.random.default_rng(0).normal(0, 0.004, z_m.shape)
    return instances, (z_m + noise)[::2, ::2].astype(np.float32)


PATH = np.linspace(-0.6, 0.6, 7)


def test_two_adjacent_chairs_remain_two_objects() -> None:
    scene = Scene()
    for x in PATH:
        scene.show(x, CHAIRS)
    found = scene.objects()
    assert [o.label for o in found] == [1, 1]
    for o, chair in zip(found, CHAIRS, strict=True):
        middle = [(chair.left + chair.right) / 2, 0.0, 2.0]
        assert np.allclose(o.centroid_world, middle, atol=0.03)
        assert np.allclose(o.box.T_world_box[:3, 3], middle, atol=0.03)
        assert o.box.size_m[2] == pytest.approx(0.6, abs=0.04)  # the height
        assert o.box.size_m[:2].max() == pytest.approx(0.41, abs=0.04)
        assert o.keyframe_ids.tolist() == list(range(len(PATH)))
        assert (o.first_seen_s, o.last_seen_s) == (0.0, 3.0)


def test_objects_move_with_the_world() -> None:
    T = se3_exp(np.array([0.5, -1.2, 0.8, 4.0, 5.0, -6.0]))
    here, there = Scene(), Scene(T)
    for x in PATH:
        assert np.array_equal(here.show(x, CHAIRS), there.show(x, CHAIRS))
    for a, b in zip(here.objects(), there.objects(), strict=True):
        assert np.allclose(transform(T, a.centroid_world[None])[0], b.centroid_world, atol=1e-5)
        assert np.allclose((T @ a.box.T_world_box)[:3, 3], b.box.T_world_box[:3, 3], atol=0.01)


def test_objects_move_with_their_keyframes() -> None:
    scene = Scene()
    for x in PATH:
        scene.show(x, CHAIRS)
    before = [o.centroid_world for o in scene.objects()]
    moved = se3_exp(np.array([0.0, 0.0, 0.1, 0.5, -0.2, 0.3]))
    scene.poses = {k: moved @ T for k, T in scene.poses.items()}
    for old, o in zip(before, scene.objects(), strict=True):
        assert np.allclose(transform(moved, old[None])[0], o.centroid_world, atol=1e-6)


def test_point_covariances_follow_from_rays_and_depth_errors() -> None:
    scene = Scene(se3_exp(np.array([0.5, 0.2, -0.7, 1.0, 2.0, 3.0])))
    for x in (0.0, 0.2):
        scene.show(x, CHAIRS)
    points = scene.map.points
    before, rays = points.in_world(scene.poses)[1], points.rays_in_world(scene.poses)
    z = points._points[:, 2:].astype(float)
    points._points = (points._points * (1 + 1e-3 * z)).astype(np.float32)  # z to z + 1e-3 z^2
    after = points.in_world(scene.poses)[1]
    assert np.allclose(after - before, 1e-3 * rays, atol=1e-6)
    assert np.allclose(np.abs(rays).max(), 4.0, rtol=0.6)


def test_points_of_a_culled_keyframe_keep_their_position() -> None:
    scene = Scene()
    for x in PATH:
        scene.show(x, CHAIRS)
    before = [o.centroid_world for o in scene.objects()]
    T_parent_culled = np.linalg.inv(scene.poses[2]) @ scene.poses.pop(3)
    scene.map.points.reanchor(3, 2, T_parent_culled)
    after = scene.objects()
    assert np.allclose(before, [o.centroid_world for o in after], atol=1e-6)
    assert 3 in after[0].keyframe_ids  # it did see them


def test_parts_are_merged_when_one_mask_covers_them() -> None:
    sofa = Card(-1.4, 1.4)
    scene = Scene()
    first, second = (scene.show(x, [sofa])[0] for x in (-1.7, 1.7))
    assert first != second
    for x in (-0.2, 0.0, 0.2):
        scene.show(x, [sofa])
    (found,) = scene.objects()
    assert found.box.size_m[:2].max() == pytest.approx(2.8, abs=0.2)
    assert found.keyframe_ids.tolist() == [0, 1, 2, 3, 4]


def test_an_object_is_split_when_masks_separate_it() -> None:
    scene, both = Scene(), [Card(-0.42, 0.42)]
    for x in PATH[:3]:
        scene.show(x, both)
    assert len(scene.objects()) == 1
    for x in (*PATH[3:], *PATH[::-1][:5]):
        scene.show(x, CHAIRS)
    found = sorted(scene.objects(), key=lambda o: o.centroid_world[0])
    assert len(found) == 2
    assert [o.box.size_m[:2].max() for o in found] == pytest.approx([0.41, 0.41], abs=0.05)
    assert 0 in found[0].keyframe_ids
    assert 0 in found[1].keyframe_ids


def test_what_few_masks_show_beside_a_thing_is_not_in_its_box() -> None:
    scene, both = Scene(), [CHAIRS[0], Card(0.01, 0.42, 2)]
    for k, x in enumerate(PATH):
        scene.show(x, [Card(-0.42, 0.42)] if k in (2, 4) else both)  # the mask of a chair spills
    found = next(o for o in scene.objects() if o.label == 1)
    assert found.box.size_m[:2].max() == pytest.approx(0.41, abs=0.05)
    state = scene.map.state()
    restored = ObjectMap(CAMERA, LabelStore(C))
    restored.restore(state)
    (again,) = (o for o in restored.objects(scene.poses, Ground(UP)) if o.label == 1)
    assert np.array_equal(again.box.size_m, found.box.size_m)
    del state["points.covered"]  # as older versions wrote it
    restored.restore(state)
    (old,) = (o for o in restored.objects(scene.poses, Ground(UP)) if o.label == 1)
    assert old.box.size_m[:2].max() > 0.6


def test_a_count_of_views_that_is_not_of_the_points_is_refused() -> None:
    points = ObjectPoints()
    new = int(points.new_ids(1)[0])
    points.add(Sightings(0, 0.0, np.array([new])), np.ones((3, 3)), np.full(3, new))
    state = points.state()
    for covered in (np.ones(4, np.int64), np.zeros(6, np.int64)):
        with pytest.raises(ValueError, match="not how many views"):
            ObjectPoints().restore({**state, "covered": covered})
    with pytest.raises(ValueError, match="negative id"):
        ObjectPoints().restore({**state, "owners": -1 - state["owners"]})
    older = ObjectPoints()
    older.restore({name: array for name, array in state.items() if name != "covered"})
    assert older.covered_shares({0: np.eye(4)}).tolist() == [1.0, 1.0, 1.0]


def test_a_desk_under_two_things_is_no_evidence_that_they_are_one() -> None:
    in_view, alike = np.array([40, 40]), np.tile([0.0, 1.0], (2, 1))
    config, unassigned = RevisionConfig(), np.array([-1])
    covered = np.array([[0.9, 0.9]])
    for share, expected in ((0.4, [(0, 1, 1)]), (0.1, [])):  # of the detection that is on each
        overlap = Overlap(np.array([[share, share]]), covered, in_view)
        assert merges(overlap, unassigned, alike, config) == expected


def test_one_wrong_class_neither_makes_an_object_nor_changes_its_label() -> None:
    scene = Scene()
    for k, x in enumerate(PATH):
        scene.show(x, [Card(-0.4, 0.4, label=2 if k == 3 else 1)], 0.8)
    (found,) = scene.objects()
    assert found.label == 1
    assert found.distribution[1] > 0.95


def test_a_cup_on_a_desk_is_not_merged_with_the_desk() -> None:
    scene = Scene()
    for x in PATH:
        scene.show(x, [Card(-0.9, 0.9, 2), Card(-0.1, 0.1, 3, -0.1, 0.1, 0.05)], 0.9)
    assert sorted(o.label for o in scene.objects()) == [2, 3]


def test_objects_of_one_keyframe_are_not_reported() -> None:
    scene = Scene()
    scene.show(0.0, CHAIRS)
    assert scene.objects() == []
    scene.show(0.1, [])
    scene.show(0.1, CHAIRS[:1])
    assert len(scene.objects()) == 1


def test_early_views_keep_their_share_of_points() -> None:
    """One end of a table was seen first, ten times; since then a hundred views show the other."""
    points, poses = ObjectPoints(), {}
    points.new_ids(1)
    rng = np.random.default_rng(0)
    for view in range(110):
        shown = np.sort(rng.uniform(0, 1, (200, 3)), axis=0)
        shown[:, 0] += 2.0 if view < 10 else 0.0
        points.add(Sightings(view, float(view), np.array([0])), shown, np.zeros(200, np.int64))
        points.thin(1000)
        poses[view] = np.eye(4)
    kept = points.in_world(poses)[1]
    assert 500 <= len(kept) <= 1000
    early = kept[:, 0] >= 2
    assert early.mean() == pytest.approx(10 / 110, rel=0.5)
    assert abs(np.median(kept[~early, 0]) - 0.5) < 0.1  # no end of a view's list goes first


def test_the_number_of_points_is_bounded() -> None:
    scene = Scene(config=ObjectConfig(max_points=500))
    for x in (*PATH, *PATH):
        scene.show(x, CHAIRS)
    owners, _ = scene.map.points.in_world(scene.poses)
    assert np.bincount(owners).max() <= 500
    assert scene.objects()[0].box.size_m[2] == pytest.approx(0.6, abs=0.04)


def test_a_restored_map_continues_identically() -> None:
    scene, twin = Scene(), Scene()
    for x in PATH[:4]:
        scene.show(x, CHAIRS)
    state: Arrays = {name: a.copy() for name, a in scene.map.state().items()}
    twin.map.restore(state)
    twin.poses = dict(scene.poses)
    for x in PATH[4:]:
        assert np.array_equal(scene.show(x, CHAIRS), twin.show(x, CHAIRS))
    after = scene.map.state()
    assert all(np.array_equal(a, after[name]) for name, a in twin.map.state().items())


def test_landmarks_of_merged_objects_and_fused_landmarks() -> None:
    scene = Scene()
    for x in PATH[:2]:
        a, b = scene.show(x, CHAIRS)
    scene.map.place_landmarks(np.array([5, 3, 9]), np.array([a, a, b]))
    scene.map.place_landmarks(np.array([3]), np.array([b]))
    points = scene.map.points
    assert points.landmarks_of(a).tolist() == [5]
    assert points.landmarks_of(b).tolist() == [3, 9]
    points.rename_landmarks(np.array([9, 5]), np.array([-1, 4]))
    assert points.landmarks().tolist() == [3, 4]
    scene.map.merge(int(a), int(b))
    assert points.landmarks_of(a).tolist() == [3, 4]


def test_the_assignment_is_optimal_within_the_gate() -> None:
    """A greedy assignment would leave the second detection without an object."""
    of_detection = np.array([[0.9, 0.8], [0.85, 0.0], [0.1, 0.1]])
    overlap = Overlap(of_detection, of_detection, np.array([50, 50]))
    p = np.tile([0.0, 1.0, 0.0, 0.0], (3, 1))
    evidence = Evidence(p, p[:2], np.zeros(2))
    assert assign(overlap, evidence, AssociationConfig()).tolist() == [1, 0, -1]
    other = Evidence(p, np.roll(p[:2], 1, axis=1), np.zeros(2))
    strict = AssociationConfig(max_cost=0.3)
    assert assign(overlap, other, strict).tolist() == [-1, -1, -1]


def test_objects_of_another_map_become_those_that_are_where_they_are() -> None:
    scene = Scene()
    for x in (0.0, 0.05):
        scene.show(x, CHAIRS)
    points = scene.map.points
    owners, places = points.in_world(scene.poses)
    left, right = (places[owners == k] for k in (0, 1))
    other = points.new_ids(3)  # seen by a keyframe that is where the world is
    aside, below = np.array([0.01, 0.0, 0.0]), np.array([0.0, 0.9, 0.0])
    moved = [right + aside, left - aside, left + below]
    scene.poses[9] = np.eye(4)
    of = np.repeat(other, [len(p) for p in moved])
    points.add(Sightings(9, 9.0, other), np.concatenate(moved), of)
    points.place_landmarks(np.array([7, 8]), other[[0, 2]])
    assert scene.map.join(scene.poses, 2, 5) == 2
    owners, _ = points.in_world(scene.poses)
    assert np.unique(owners).tolist() == [0, 1, 4]
    assert np.count_nonzero(owners == 1) == 2 * len(right)
    assert points.landmarks_of(1).tolist() == [7]
    assert points.landmarks_of(4).tolist() == [8]
    assert scene.map.join(scene.poses, 4, 5) == 0


def test_what_covers_a_thing_wholly_and_is_of_another_class_is_another_thing() -> None:
    covers, own = np.array([[0.05]]), np.array([[1.0]])
    book, desk = np.array([[0.0, 1.0, 0.0]]), np.array([[0.0, 0.1, 0.9]])
    for detected, on, expected in ((desk, covers, -1), (book, covers, 0), (desk, own, 0)):
        overlap = Overlap(on, own, np.array([40]))
        found = assign(overlap, Evidence(detected, book, np.zeros(1)), AssociationConfig())
        assert found.tolist() == [expected]
