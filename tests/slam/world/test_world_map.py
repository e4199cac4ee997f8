"""The map's observations remain consistent through attaching, fusing and removing."""

import numpy as np
import pytest
from synthetic_view import (
    CAMERA,
    T_NEW_OLD,
    add_keyframe,
    make_features,
    points_before,
    random_descriptors,
    render_plane,
)

from bmask_slam.features.brisk import BriskExtractor, FeatureConfig
from bmask_slam.features.patch_alignment import PATCH_PX, SubpixelConfig, cut_patches
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import inverse, se3_exp, transform
from bmask_slam.world.appearance import PATCHES
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.world_map import WorldMap

RNG = np.random.default_rng(12)
COUNT = 30


def make_world(keyframes: int = 3, keypoints: int = COUNT) -> WorldMap:
    """Keyframes in a row whose keypoint i observes point i, without landmarks."""
    points = points_before(np.eye(4), keypoints, RNG)
    world = WorldMap()
    for k in range(keyframes):
        T = se3_exp(np.array([0.0, 0.0, 0.0, 0.02 * k, 0.0, 0.01 * k]))
        add_keyframe(world, T, make_features(T, points, random_descriptors(keypoints, RNG)))
    return world


def points_of(keyframe: Keyframe, keypoints: Array) -> Array:
    f = keyframe.features
    camera_points = CAMERA.backproject(f.pixels[keypoints], f.depth_m[keypoints])
    return transform(keyframe.T_world_camera, camera_points)


def make(world: WorldMap, keyframe: int, keypoints: list[int]) -> Array:
    k = world.keyframes[keyframe]
    rows = np.array(keypoints)
    return world.make_landmarks(k, rows, points_of(k, rows))


def attach(world: WorldMap, keyframe: int, keypoints: list[int], ids: Array) -> None:
    world.attach(world.keyframes[keyframe], np.array(keypoints), ids)


def assert_counts_are_true(world: WorldMap) -> None:
    """``observations`` against a count over all keyframes; one keypoint a landmark and keyframe."""
    counted = np.zeros(len(world.landmarks), int)
    for keyframe in world.keyframes.values():
        _, ids = world.observed(keyframe)
        assert len(ids) == len(np.unique(ids)), f"keyframe {keyframe.id} sees a landmark twice"
        counted[ids] += 1
    in_map = world.landmarks.in_map
    np.testing.assert_array_equal(world.landmarks.observations[in_map], counted[in_map])


def test_a_landmark_has_its_first_and_last_keyframe() -> None:
    world = make_world()
    ids = make(world, 0, [0, 1, 2, 3])
    attach(world, 2, [0, 1], ids[:2])
    attach(world, 1, [1, 2], ids[1:3])  # an older keyframe than 2 does not refresh landmark 1
    table = world.landmarks
    assert table.host[ids].tolist() == [0, 0, 0, 0]
    assert table.observations[ids].tolist() == [2, 3, 2, 1]
    assert table.last_keyframe[ids].tolist() == [2, 2, 1, 0]
    for landmark, keyframe in zip(range(4), (2, 2, 1, 0), strict=True):
        k = world.keyframes[keyframe]
        np.testing.assert_array_equal(table.descriptors[landmark], k.features.descriptors[landmark])
        towards = k.T_world_camera[:3, 3] - table.points_world[landmark]
        np.testing.assert_allclose(
            table.directions[landmark], towards / np.linalg.norm(towards), atol=1e-12
        )
        z = (inverse(k.T_world_camera) @ np.append(table.points_world[landmark], 1.0))[2]
        assert table.extent[landmark] == pytest.approx(z * k.features.scales[landmark])
    assert_counts_are_true(world)


def test_observed_excludes_removed_landmarks() -> None:
    world = make_world()
    ids = make(world, 0, [5, 7, 9])
    world.landmarks.remove(ids[[1]])
    keypoints, landmark_ids = world.observed(world.keyframes[0])
    assert keypoints.tolist() == [5, 9]
    assert landmark_ids.tolist() == [0, 2]


def test_covisibility_counts_shared_landmarks() -> None:
    world = make_world(4)
    ids = make(world, 0, list(range(20)))
    attach(world, 1, list(range(12)), ids[:12])
    attach(world, 2, list(range(5, 17)), ids[5:17])
    attach(world, 3, [0], ids[:1])
    shared = [(n, k.id) for n, k in world.covisible(ids[:15], 5)]
    slow = []
    for keyframe in world.keyframes.values():
        n = len(set(keyframe.landmark_ids.tolist()) & set(ids[:15].tolist()))
        if n >= 5:
            slow.append((n, keyframe.id))
    assert shared == sorted(slow, key=lambda pair: (-pair[0], -pair[1]))
    assert shared == [(15, 0), (12, 1), (10, 2)]


def test_fused_landmarks_leave_one_observation_a_keyframe() -> None:
    """Keyframe 0 observes both, 1 only the old one, 2 only the new one."""
    world = make_world()
    new = make(world, 0, [0])
    old = make(world, 0, [1])
    attach(world, 1, [4], old)
    attach(world, 2, [6], new)
    world.landmarks.found[old] = 5
    world.landmarks.visible[old] = 8
    removed = world.replace_landmarks(old, new)
    assert removed.tolist() == old.tolist()
    assert not world.landmarks.in_map[old].any()
    assert [
        np.flatnonzero(k.landmark_ids == new[0]).tolist() for k in world.keyframes.values()
    ] == [[0], [4], [6]]
    assert not any((k.landmark_ids == old[0]).any() for k in world.keyframes.values())
    assert world.landmarks.found[new].tolist() == [6]
    assert world.landmarks.visible[new].tolist() == [9]
    assert_counts_are_true(world)


def test_two_duplicates_fused_into_one_keep_one_observation() -> None:
    """Two old landmarks of one keyframe are fused into one that it does not observe."""
    world = make_world()
    parent = make(world, 0, [0])
    twins = make(world, 1, [2, 3])
    attach(world, 2, [2], twins[:1])
    world.landmarks.found[twins] = [4, 7]
    world.replace_landmarks(twins, np.repeat(parent, 2))
    assert world.landmarks.found[parent].tolist() == [12]
    assert world.landmarks.observations[parent].tolist() == [3]
    assert np.count_nonzero(world.keyframes[1].landmark_ids == parent[0]) == 1
    assert_counts_are_true(world)


@pytest.mark.parametrize("seed", range(5))
def test_counts_are_correct_after_random_changes(seed: int) -> None:
    """Random attaching, fusing and removing of keyframes."""
    rng = np.random.default_rng(seed)
    world = make_world(6)
    ids = make(world, 0, list(range(COUNT)))
    for keyframe in list(world.keyframes.values())[1:]:
        rows = rng.permutation(COUNT)[:20]
        world.attach(keyframe, rows, rng.permutation(ids)[:20])
    for _ in range(4):
        in_map = world.landmarks.remaining(ids)
        chosen = rng.permutation(in_map)[:4]
        world.replace_landmarks(chosen[:2], chosen[2:])
        assert_counts_are_true(world)
    keyframes = list(world.keyframes.values())
    world.remove_keyframe(keyframes[0], parent=keyframes[3])
    assert_counts_are_true(world)
    assert (world.landmarks.host[ids] == 3).all()
    assert 0 not in world.keyframes


def test_patches_are_replaced_only_at_other_views() -> None:
    """A patch is cut, kept from a near view, and replaced from another view."""
    config = SubpixelConfig(max_angle_deg=20.0, max_zoom=1.3)
    frame = render_plane(np.eye(4))
    features = BriskExtractor(CAMERA, FeatureConfig()).extract(frame)
    world = WorldMap()
    keyframe = add_keyframe(world, np.eye(4), features)
    rows = np.arange(len(features))
    ids = world.make_landmarks(keyframe, rows, points_of(keyframe, rows))
    world.renew_patches(keyframe, config)
    table = world.landmarks
    first = cut_patches(features.gray, features.image_pixels)
    np.testing.assert_array_equal(table.patches[ids][:, 0], first)
    views = table.patch_views[ids]
    np.testing.assert_allclose(views[:, 0], -table.points_world[ids], atol=1e-12)
    assert np.isnan(views[:, 1:]).all()

    def observe_from(landmark: int, view: Array) -> None:
        table.patch_views[landmark] = [view, *[np.full(3, np.nan)] * (PATCHES - 1)]

    observe_from(0, -table.points_world[0] * 1.25)  # farther by less than 1.3
    observe_from(1, -table.points_world[1] * 1.35)  # by more
    observe_from(2, -table.points_world[2] / 1.35)
    for landmark, angle_deg in ((3, 18.0), (4, 22.0)):
        axis = np.cross(table.points_world[landmark], [1.0, 0.0, 0.0])
        axis *= np.deg2rad(angle_deg) / np.linalg.norm(axis)
        turn = se3_exp(np.r_[axis, 0, 0, 0])[:3, :3]
        observe_from(landmark, -turn @ table.points_world[landmark])
    before = table.patches[:5].copy()
    world.renew_patches(keyframe, config)
    patches = table.patches[:5]
    np.testing.assert_array_equal(patches[:, 0], before[:, 0])  # what there was stays
    patch_counts = np.isfinite(table.patch_views[:5]).all(axis=2).sum(axis=1) - 1
    assert patch_counts.tolist() == [0, 1, 1, 0, 1]
    np.testing.assert_array_equal(patches[[1, 2, 4], 1], first[[1, 2, 4]])


def test_the_least_similar_patch_is_replaced_and_the_most_similar_used() -> None:
    """Observed from 1, 2, 4 and 8 times the distance, then from half: the farthest is replaced."""
    world = make_world(1)
    keyframe = world.keyframes[0]
    ids = world.make_landmarks(keyframe, np.arange(COUNT), points_of(keyframe, np.arange(COUNT)))
    table, limits = world.landmarks, (0.3, 1.3)
    for slot, factor in enumerate((8.0, 1.0, 4.0, 2.0)):
        grey = np.full((COUNT, PATCH_PX, PATCH_PX), int(factor), np.uint8)
        views = -factor * table.points_world[ids]
        table.put_patches(ids, np.full(COUNT, slot), grey, views)
    half = -0.5 * table.points_world[ids]
    apart = table.patch_distances(ids, half, limits)
    slow = np.log([16.0, 2.0, 8.0, 4.0]) / np.log(1.3)
    np.testing.assert_allclose(apart, np.tile(slow, (COUNT, 1)), rtol=1e-6)
    assert set(apart.argmax(axis=1).tolist()) == {0}
    for landmark in ids.tolist():
        centre = table.points_world[landmark] * (1 - 2.6)  # 2.6 times as far
        patches, zooms = table.nearest_patches(np.array([landmark]), centre, limits)
        assert (patches == 2).all()
        np.testing.assert_allclose(zooms, 2 / 2.6)  # things look smaller from there


def test_the_map_moves_with_the_world() -> None:
    world = make_world()
    moved = WorldMap()
    for keyframe in world.keyframes.values():
        add_keyframe(moved, T_NEW_OLD @ keyframe.T_world_camera, keyframe.features)
    for w in (world, moved):
        ids = make(w, 0, list(range(20)))
        attach(w, 1, list(range(10)), ids[:10])
    a, b = world.landmarks, moved.landmarks
    np.testing.assert_allclose(b.points_world, transform(T_NEW_OLD, a.points_world), atol=1e-12)
    np.testing.assert_allclose(b.directions, a.directions @ T_NEW_OLD[:3, :3].T, atol=1e-12)
    np.testing.assert_allclose(b.extent, a.extent, atol=1e-12)


def test_segment_joining() -> None:
    world = make_world(2)
    other = add_keyframe(world, np.eye(4), world.keyframes[0].features, segment=1)
    here, there = make(world, 0, [0, 1]), make(world, 2, [2, 3, 4])
    assert [k.id for k in world.in_segment(0)] == [0, 1]
    assert world.in_segment(1) == [other]
    assert world.segment_of(np.concatenate([here, there])) == 1
    assert world.segment_of(np.concatenate([here, there[:1]])) == 0
    assert world.next_keyframe_id == 3


def test_the_largest_segment_is_one_with_landmarks() -> None:
    world = make_world(5)
    for keyframe in world.keyframes.values():
        keyframe.segment = int(keyframe.id >= 3)
    rows = np.arange(COUNT)
    assert world.mapped_segments() == set() and world.largest_segment() == 0
    first, other = world.keyframes[0], world.keyframes[3]
    ids = world.make_landmarks(first, rows, points_of(first, rows))
    assert world.mapped_segments() == {0} and world.largest_segment() == world.segment_of(ids) == 0
    world.make_landmarks(other, rows, points_of(other, rows))
    assert world.mapped_segments() == {0, 1} and world.largest_segment() == 0
    world.landmarks.remove(ids[1:])  # one is left over
    assert world.mapped_segments() == {1} and world.largest_segment() == 1
