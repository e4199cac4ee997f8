"""Tracking against a map: recovered poses, statuses, and search against a simple loop."""

from dataclasses import replace

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

from bmask_slam.features.brisk import BriskExtractor, FeatureConfig, Features
from bmask_slam.features.matching import WindowIndex, hamming
from bmask_slam.features.patch_alignment import SubpixelConfig
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import inverse, se3_exp, se3_log, transform
from bmask_slam.tracking.config import TrackingConfig
from bmask_slam.tracking.results import Tracked, TrackingStatus, best, lost, starting
from bmask_slam.tracking.tracker import Tracker
from bmask_slam.world.world_map import WorldMap

PLAIN = TrackingConfig(subpixel=SubpixelConfig(enabled=False))
T_WORLD_CAMERA = se3_exp(np.array([0.02, -0.03, 0.01, 0.06, -0.04, 0.05]))


def make_map(count: int, rng: np.random.Generator) -> tuple[WorldMap, Array]:
    """A map of a keyframe at the origin with a landmark for every point in its view."""
    points = points_before(np.eye(4), count, rng)
    world = WorldMap()
    keyframe = add_keyframe(
        world, np.eye(4), make_features(np.eye(4), points, random_descriptors(count, rng))
    )
    world.make_landmarks(keyframe, np.arange(count), points)
    return world, points


def observe(
    world: WorldMap, rng: np.random.Generator, clutter: int = 200, noise: float = 1.0
) -> Features:
    """Noisy keypoints of all landmarks with 40 changed bits, and this many other keypoints."""
    count = len(world.landmarks)
    flips = np.zeros((count, 512), np.uint8)
    for row in flips:
        row[rng.permutation(512)[:40]] = 1
    descriptors = world.landmarks.descriptors ^ np.packbits(flips, axis=1).view(np.uint64)
    others = points_before(T_WORLD_CAMERA, clutter, rng)
    points = np.concatenate([world.landmarks.points_world, others])
    descriptors = np.concatenate([descriptors, random_descriptors(clutter, rng)])
    noise_px = noise * rng.normal(size=(count + clutter, 3)) * [0.7, 0.7, 0.12]
    return make_features(T_WORLD_CAMERA, points, descriptors, noise_px)


def track(world: WorldMap, features: Features, T_predicted: Array, config: TrackingConfig = PLAIN):
    ids = np.arange(len(world.landmarks))
    return Tracker(CAMERA, config).track(features, T_predicted, ids, ids, world)


def off(angle_deg: float, shift_m: float, rng: np.random.Generator) -> Array:
    axes = rng.normal(size=(2, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return T_WORLD_CAMERA @ se3_exp(np.r_[np.deg2rad(angle_deg) * axes[0], shift_m * axes[1]])


@pytest.mark.parametrize(("angle_deg", "shift_m"), [(0.0, 0.0), (1.0, 0.02), (3.0, 0.05)])
def test_the_pose_is_recovered_among_other_landmarks(angle_deg: float, shift_m: float) -> None:
    rng = np.random.default_rng(1)
    world, _ = make_map(200, rng)
    features = observe(world, rng)
    tracked = track(world, features, off(angle_deg, shift_m, rng))
    assert tracked.status is TrackingStatus.OK
    xi = se3_log(inverse(T_WORLD_CAMERA) @ tracked.T_world_camera)
    assert xi @ tracked.information @ xi < 22.5  # chi-square with 6 degrees at 99.9 %
    np.testing.assert_array_equal(tracked.keypoints, tracked.landmark_ids)  # none mixed up
    assert len(tracked.keypoints) > 0.85 * 200
    assert tracked.matches >= len(tracked.keypoints)
    assert set(tracked.landmark_ids.tolist()) <= set(tracked.visible_ids.tolist())


def test_tracking_moves_with_the_world() -> None:
    results = []
    for T in (np.eye(4), T_NEW_OLD):
        rng = np.random.default_rng(2)
        world, _ = make_map(120, rng)
        features = observe(world, rng)
        T_predicted = off(1.0, 0.02, rng)
        world.landmarks.points_world[:] = transform(T, world.landmarks.points_world)
        world.landmarks.directions[:] = world.landmarks.directions @ T[:3, :3].T
        results.append(track(world, features, T @ T_predicted))
    here, there = results
    np.testing.assert_array_equal(there.landmark_ids, here.landmark_ids)
    np.testing.assert_allclose(there.T_world_camera, T_NEW_OLD @ here.T_world_camera, atol=1e-6)


@pytest.mark.parametrize(
    ("seen", "status"),
    [(60, TrackingStatus.OK), (22, TrackingStatus.WEAK), (8, TrackingStatus.LOST)],
)
def test_the_status_depends_on_the_inliers(seen: int, status: TrackingStatus) -> None:
    rng = np.random.default_rng(3)
    config = replace(PLAIN, min_inliers=30, weak_inliers=15)
    world, _ = make_map(200, rng)
    features = observe(world, rng, clutter=0, noise=0.1)
    hidden = features.descriptors.copy()
    hidden[seen:] = random_descriptors(200 - seen, rng)
    tracked = track(world, replace(features, descriptors=hidden), T_WORLD_CAMERA, config)
    assert tracked.status is status
    if status is TrackingStatus.LOST:
        assert len(tracked.keypoints) == len(tracked.landmark_ids) == 0


@pytest.mark.parametrize(("wrong", "status"), [(80, TrackingStatus.OK), (120, TrackingStatus.WEAK)])
def test_a_pose_that_most_matches_contradict_is_weak(wrong: int, status: TrackingStatus) -> None:
    rng = np.random.default_rng(5)
    world, _ = make_map(200, rng)
    features = observe(world, rng, clutter=0, noise=0.1)
    pixels = features.pixels.copy()
    turn = rng.uniform(0, 2 * np.pi, wrong)
    pixels[:wrong] += 25 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    config = replace(PLAIN, local_radius_px=30.0)
    tracked = track(world, replace(features, pixels=pixels), T_WORLD_CAMERA, config)
    assert tracked.matches > 190
    assert len(tracked.landmark_ids) == pytest.approx(200 - wrong, abs=15)
    assert tracked.status is status


def test_a_position_that_is_uncertain_is_weak() -> None:
    rng = np.random.default_rng(6)
    world, _ = make_map(200, rng)
    features = observe(world, rng, clutter=0, noise=0.1)
    near = track(world, features, T_WORLD_CAMERA)
    assert near.status is TrackingStatus.OK
    sigma_m = float(np.sqrt(np.trace(np.linalg.inv(near.information)[3:, 3:])))
    for share, status in ((0.9, TrackingStatus.WEAK), (1.1, TrackingStatus.OK)):
        config = replace(PLAIN, max_sigma_m=share * sigma_m)
        assert track(world, features, T_WORLD_CAMERA, config).status is status


@pytest.mark.parametrize("what", ["no keypoints", "no landmarks", "other place", "dead landmarks"])
def test_a_wrong_map_gives_lost(what: str) -> None:
    rng = np.random.default_rng(4)
    world, _ = make_map(150, rng)
    features = observe(world, rng)
    ids = np.arange(150)
    if what == "no keypoints":
        features = make_features(np.eye(4), np.zeros((0, 3)), np.zeros((0, 8), np.uint64))
    elif what == "no landmarks":
        ids = np.zeros(0, np.int64)
    elif what == "other place":
        features = replace(features, descriptors=random_descriptors(len(features), rng))
    else:
        world.landmarks.remove(ids)
    for config in (PLAIN, TrackingConfig()):
        in_map = world.landmarks.remaining(ids)
        tracked = Tracker(CAMERA, config).track(features, T_WORLD_CAMERA, ids, in_map, world)
        assert tracked.status is TrackingStatus.LOST


def test_with_a_recent_landmark_but_no_local_ones_it_is_lost() -> None:
    rng = np.random.default_rng(5)
    world, _ = make_map(100, rng)
    none = np.zeros(0, np.int64)
    features = observe(world, rng)
    for config in (PLAIN, TrackingConfig()):
        tracker = Tracker(CAMERA, config)
        tracked = tracker.track(features, T_WORLD_CAMERA, np.arange(100), none, world)
        assert tracked.status is TrackingStatus.LOST


def slow_in_view(world: WorldMap, T: Array, ids: Array, max_angle_deg: float) -> list[int]:
    """By loop: landmarks in front, inside the image, with a similar viewing direction."""
    kept = []
    for i in ids:
        x, y, z = (inverse(T) @ np.append(world.landmarks.points_world[i], 1.0))[:3]
        if z <= 0.1:
            continue
        u, v = CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy
        towards = T[:3, 3] - world.landmarks.points_world[i]
        cosine = towards @ world.landmarks.directions[i] / np.linalg.norm(towards)
        angle_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        if 0 < u < CAMERA.width - 1 and 0 < v < CAMERA.height - 1 and angle_deg < max_angle_deg:
            kept.append(int(i))
    return kept


def test_the_search_equals_a_loop() -> None:
    """From another position, so that some landmarks are outside the image, behind, or rotated."""
    rng = np.random.default_rng(6)
    world, _ = make_map(300, rng)
    random = rng.normal(size=(60, 3))
    world.landmarks.directions[40:100] = random / np.linalg.norm(random, axis=1, keepdims=True)
    T = se3_exp(np.array([0.05, 0.25, 0.3, 0.3, 0.1, -0.4]))
    world.landmarks.points_world[:40, 2] *= -1.0  # behind, and seen from there before
    towards = T[:3, 3] - world.landmarks.points_world[:40]
    world.landmarks.directions[:40] = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    features = observe(world, rng)
    ids = rng.permutation(300)[:250]
    tracker = Tracker(CAMERA, PLAIN)
    visible, matches = tracker.search(
        features, WindowIndex(features.pixels), T, ids, 25.0, world.landmarks
    )
    assert visible.tolist() == slow_in_view(world, T, ids, PLAIN.max_view_angle_deg)
    assert 50 < len(visible) < 200
    predicted = CAMERA.project(transform(inverse(T), world.landmarks.points_world[visible]))
    distance_px = np.linalg.norm(features.pixels[matches.train] - predicted[matches.query], axis=1)
    assert (distance_px < 25.0 * 3.0).all()
    bits = hamming(
        world.landmarks.descriptors[visible[matches.query]], features.descriptors[matches.train]
    )
    np.testing.assert_array_equal(bits, matches.distance)


def test_a_keypoint_of_another_scale_is_not_matched() -> None:
    rng = np.random.default_rng(7)
    world, _ = make_map(100, rng)
    features = observe(world, rng, clutter=0)
    scales = np.where(np.arange(100) < 50, 1.0, 3.0)
    index, ids = WindowIndex(features.pixels), np.arange(100)
    _, matches = Tracker(CAMERA, PLAIN).search(
        replace(features, scales=scales), index, T_WORLD_CAMERA, ids, 10.0, world.landmarks
    )
    assert matches.train.max() < 50
    assert len(matches) > 40


def map_of_plane(extractor: BriskExtractor) -> tuple[WorldMap, np.ndarray]:
    """A map of one keyframe of the rendered plane, and the ids of its landmarks with patches."""
    world = WorldMap()
    features = extractor.extract(render_plane(np.eye(4)))
    keyframe = add_keyframe(world, np.eye(4), features)
    good = np.flatnonzero(np.isfinite(features.depth_m))
    points = CAMERA.backproject(features.pixels[good], features.depth_m[good])
    ids = world.make_landmarks(keyframe, good, points)
    world.renew_patches(keyframe, SubpixelConfig())
    return world, ids


def test_rendered_images_are_tracked_with_subpixel_registration() -> None:
    """A rendered textured plane from end to end, moved by a few degrees and centimetres."""
    extractor = BriskExtractor(CAMERA, FeatureConfig())
    world, ids = map_of_plane(extractor)
    second = extractor.extract(render_plane(T_WORLD_CAMERA, 1))
    errors_px = {}
    for enabled in (False, True):
        config = TrackingConfig(subpixel=SubpixelConfig(enabled=enabled))
        tracked = Tracker(CAMERA, config).track(second, np.eye(4), ids, ids, world)
        assert tracked.status is TrackingStatus.OK
        assert len(tracked.landmark_ids) > 100
        pixels = tracked.features.pixels[tracked.keypoints]
        true = CAMERA.project(
            transform(inverse(T_WORLD_CAMERA), world.landmarks.points_world[tracked.landmark_ids])
        )
        errors_px[enabled] = np.sqrt(np.mean((pixels - true) ** 2))
        xi = se3_log(inverse(T_WORLD_CAMERA) @ tracked.T_world_camera)
        assert np.linalg.norm(xi[:3]) < np.deg2rad(0.1)
        assert np.linalg.norm(xi[3:]) < 0.004
    assert errors_px[True] < 0.2
    assert errors_px[True] < 0.6 * errors_px[False]


def test_images_at_another_distance_are_registered() -> None:
    """The camera is nearer by a fifth of the distance, where a patch can still be used."""
    extractor = BriskExtractor(CAMERA, FeatureConfig())
    world, _ = map_of_plane(extractor)
    T_nearer = se3_exp(np.array([0.0, 0.0, 0.0, 0.02, -0.01, 0.4]))
    tracked = track(world, extractor.extract(render_plane(T_nearer, 1)), T_nearer, TrackingConfig())
    pixels = tracked.features.pixels[tracked.keypoints]
    true = CAMERA.project(
        transform(inverse(T_nearer), world.landmarks.points_world[tracked.landmark_ids])
    )
    registered = tracked.features.sigmas_px[tracked.keypoints, 0] < 0.5
    assert registered.mean() > 0.7
    assert np.sqrt(np.mean((pixels - true)[registered] ** 2)) < 0.12


def test_registration_does_not_change_the_frames_features() -> None:
    extractor = BriskExtractor(CAMERA, FeatureConfig())
    world = WorldMap()
    features = extractor.extract(render_plane(np.eye(4)))
    keyframe = add_keyframe(world, np.eye(4), features)
    rows = np.arange(len(features))
    ids = world.make_landmarks(
        keyframe, rows, CAMERA.backproject(features.pixels, features.depth_m)
    )
    world.renew_patches(keyframe, SubpixelConfig())
    second = extractor.extract(render_plane(T_WORLD_CAMERA, 1))
    pixels, sigmas = second.pixels.copy(), second.sigmas_px.copy()
    tracked = track(world, second, T_WORLD_CAMERA, TrackingConfig())
    np.testing.assert_array_equal(second.pixels, pixels)
    np.testing.assert_array_equal(second.sigmas_px, sigmas)
    moved = (tracked.features.pixels != pixels).any(axis=1)
    assert moved.sum() > 100
    config = SubpixelConfig()
    np.testing.assert_array_equal(tracked.features.sigmas_px[moved, :2], config.sigma_px)
    np.testing.assert_array_equal(tracked.features.sigmas_px[:, 2], sigmas[:, 2])
    np.testing.assert_array_equal(tracked.features.pixels, tracked.features.image_pixels)
    assert len(ids) == len(rows)


def test_lost_and_untracked_hold_no_matches() -> None:
    features = make_features(np.eye(4), np.zeros((0, 3)), np.zeros((0, 8), np.uint64))
    assert lost(np.eye(4), features).status is TrackingStatus.LOST
    assert starting(np.eye(4), features).status is TrackingStatus.OK
    for tracked in (lost(T_WORLD_CAMERA, features), starting(T_WORLD_CAMERA, features)):
        assert len(tracked.keypoints) == len(tracked.landmark_ids) == len(tracked.visible_ids) == 0
        np.testing.assert_array_equal(tracked.T_world_camera, T_WORLD_CAMERA)


def found(firm: int, by_flow: int) -> Tracked:
    """A frame with landmarks that were matched, and with some that only the flow shows."""
    features = make_features(np.eye(4), np.ones((0, 3)), np.zeros((0, 8), np.uint64))
    ids = np.arange(firm + by_flow)
    return replace(starting(np.eye(4), features), landmark_ids=ids, flow_only=ids[firm:])


@pytest.mark.parametrize(
    ("guided", "plain", "better"),
    [
        ((9, 50), (20, 0), "guided"),  # a blurred image, of which twenty matches may all be wrong
        ((9, 50), (31, 0), "plain"),
        ((31, 50), (40, 0), "guided"),
        ((0, 15), (16, 0), "plain"),
        ((20, 0), (20, 0), "guided"),  # the first of equal ones
    ],
)
def test_of_two_results_the_firm_one_or_the_larger_is_taken(
    guided: tuple[int, int], plain: tuple[int, int], better: str
) -> None:
    results = {"guided": found(*guided), "plain": found(*plain)}
    assert best(results["guided"], results["plain"], 30) is results[better]
