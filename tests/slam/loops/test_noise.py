"""The real noise of loops is learned from cycles; what drift of the map is possible."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic_view import CAMERA, T_NEW_OLD, add_keyframe, make_features

from bmask_slam.events import EventLog
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.factors.checks import chi2_quantile, mahalanobis
from bmask_slam.graph.geometry import inverse, make_pose, se3_exp, se3_log
from bmask_slam.loops.closing import LoopCloser, LoopClosingConfig
from bmask_slam.loops.drift import MapDrift
from bmask_slam.loops.noise import LoopNoise, NoiseConfig
from bmask_slam.loops.verification import LoopConstraint
from bmask_slam.world.covisibility import CovisiblePaths, Way
from bmask_slam.world.world_map import WorldMap

STATED = np.diag([2e-3, 1e-3, 1e-3, 2e-3, 4e-3, 6e-3]) ** 2
REAL_RATIO = 9.0
COUNT = 60
SHARED = 200
"""Landmarks that each two keyframes in turn have in common, unless a test says otherwise."""


def world_of(poses: Array, shared: int = SHARED) -> WorldMap:
    """A map whose keyframes share so many landmarks with the one before and the one after."""
    world, rows, before = WorldMap(), np.arange(shared), np.zeros(0, np.int64)
    points = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 4], (2 * shared, 3))
    for T_world_camera in poses:
        features = make_features(np.eye(4), points, np.zeros((2 * shared, 8), np.uint64))
        keyframe = add_keyframe(world, T_world_camera, features)
        world.attach(keyframe, rows[: len(before)], before)
        before = world.make_landmarks(keyframe, shared + rows, points[shared:])
    return world


def linked(poses: Array) -> Way:
    """A way whose links are as good as exact."""
    return Way(poses, np.full(max(len(poses) - 1, 0), 10**9))


def turning_world(step_m: float, T_move: Array | None = None) -> WorldMap:
    """An exact map of 2 x 60 keyframes that turn, where keyframe 60 + k is near keyframe k."""
    poses = [se3_exp([0.1, 0.05 * k, 0.3, step_m * k, 0, 0.1]) for k in range(2 * COUNT)]
    return world_of((np.eye(4) if T_move is None else T_move) @ poses)


def noisy_loops(world: WorldMap, ratio: float, count: int = COUNT) -> list[LoopConstraint]:
    """Loops k to 60 + k whose errors have ``ratio`` times the covariance that they state."""
    rng = np.random.default_rng(2)
    found = []
    for k in range(count):
        a, b = (world.keyframes[i].T_world_camera for i in (k, COUNT + k))
        xi = np.linalg.cholesky(ratio * STATED) @ rng.normal(size=6)
        T_a_b = inverse(a) @ b @ se3_exp(xi)
        none = np.zeros((0, 2), np.int64)
        found.append(LoopConstraint(k, COUNT + k, T_a_b, STATED, 50, 1.0, none))
    return found


@pytest.mark.parametrize("ratio", [1.0, REAL_RATIO])
def test_the_real_covariance_is_learned(ratio: float) -> None:
    world, noise = turning_world(0.01), LoopNoise(NoiseConfig())
    assert noise.ratio == NoiseConfig().prior_ratio
    loops = noisy_loops(world, ratio)
    noise.learn(loops, world)
    assert noise.ratio == pytest.approx(ratio, rel=0.2)
    keyframes = world.keyframes
    errors = np.array([
        se3_log(inverse(k.T_a_b) @ inverse(keyframes[k.keyframe_a].T_world_camera)
                @ keyframes[k.keyframe_b].T_world_camera)
        for k in loops
    ])  # fmt: skip
    S = noise.covariance(loops[0])
    nees = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(S), errors)
    low, high = chi2_quantile(0.025, 6 * COUNT), chi2_quantile(0.975, 6 * COUNT)
    assert low < nees.sum() < high


def test_moving_the_world_changes_nothing() -> None:
    plain, moved = (LoopNoise(NoiseConfig()) for _ in range(2))
    loops = noisy_loops(turning_world(0.01), REAL_RATIO)
    plain.learn(loops, turning_world(0.01))
    moved.learn(loops, turning_world(0.01, T_NEW_OLD))
    assert moved.ratio == pytest.approx(plain.ratio, rel=1e-6)


def test_few_loops_change_little_and_many_count_together() -> None:
    world, together, apart = turning_world(0.01), *(LoopNoise(NoiseConfig()) for _ in range(2))
    loops = noisy_loops(world, REAL_RATIO)
    together.learn(loops[:3], world)
    assert NoiseConfig().prior_ratio < together.ratio < REAL_RATIO
    for k in range(0, COUNT, 5):
        apart.learn(loops[k : k + 5], world)
    assert apart.ratio == pytest.approx(REAL_RATIO, rel=0.35)


def test_long_cycles_and_loops_with_a_common_keyframe_teach_nothing() -> None:
    """The first contain the map's own errors, the others lack those of the common keyframe."""
    far, near = turning_world(1.5), turning_world(0.01)
    loops = noisy_loops(near, REAL_RATIO)
    shared = [replace(loop, keyframe_b=COUNT) for loop in loops]
    for world, given in ((far, loops), (near, shared), (near, loops[:1]), (near, [])):
        noise = LoopNoise(NoiseConfig())
        noise.learn(given, world)
        assert noise.ratio == NoiseConfig().prior_ratio


def test_what_was_learned_is_state() -> None:
    world, noise, other = turning_world(0.01), *(LoopNoise(NoiseConfig()) for _ in range(2))
    noise.learn(noisy_loops(world, REAL_RATIO), world)
    other.restore(noise.state())
    assert other.ratio == noise.ratio


def test_right_loops_are_not_refused_for_errors_that_their_inliers_share() -> None:
    world = turning_world(0.01)
    closer = LoopCloser(CAMERA, LoopClosingConfig(), EventLog())
    right = noisy_loops(world, NoiseConfig().prior_ratio)
    assert all(closer._drift_allows(loop, world, CovisiblePaths(world)) for loop in right)


@pytest.mark.parametrize(("a", "b", "fits"), [(0, 60, True), (0, 3, False)])
def test_a_map_may_be_bent_by_turns_not_without(a: int, b: int, fits: bool) -> None:
    """50 mrad and 40 mm are much for a turn of 0.15 rad, and little for one of 3 rad."""
    world = turning_world(0.01)
    closer = LoopCloser(CAMERA, LoopClosingConfig(), EventLog())
    T_a_b = inverse(world.keyframes[a].T_world_camera) @ world.keyframes[b].T_world_camera
    T_bent = T_a_b @ se3_exp([0.03, 0.0, 0.04, -0.01, 0.04, 0.0])
    loop = replace(noisy_loops(world, 1.0, 1)[0], keyframe_a=a, keyframe_b=b, T_a_b=T_bent)
    assert closer._drift_allows(loop, world, CovisiblePaths(world)) == fits
    alias = replace(loop, T_a_b=T_a_b @ se3_exp([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]))
    assert not closer._drift_allows(alias, world, CovisiblePaths(world))


@pytest.mark.parametrize(("shared", "fits"), [(11, True), (90, False), (SHARED, False)])
def test_a_map_may_be_bent_at_keyframes_that_share_few_landmarks(shared: int, fits: bool) -> None:
    """2 degrees and 3 cm, as where freiburg1_rpy, played backward, turns by 170 degrees/s."""
    poses = [se3_exp([0, 0, 0, 0.1 * k, 0, 0]) for k in range(4)]
    closer = LoopCloser(CAMERA, LoopClosingConfig(), EventLog())
    T_bent = inverse(poses[0]) @ poses[3] @ se3_exp([0.0, 0.035, 0.0, 0.02, 0.0, 0.02])
    world = world_of(poses, shared)
    loop = replace(noisy_loops(turning_world(0.01), 1.0, 1)[0], keyframe_b=3, T_a_b=T_bent)
    assert closer._drift_allows(loop, world, CovisiblePaths(world)) == fits


def test_a_weak_link_bends_all_that_comes_after() -> None:
    """Sigmas of 0.01 rad at 3.5 m from the end move it sideways by 3.5 cm, and 1 cm are its own."""
    rules = replace(NoiseConfig(), drift_rad_per_m=0.0, drift_m_per_m=0.0, model_share=0.0)
    drift, exact = MapDrift(rules), linked(straight(4))
    weak = Way(exact.poses, np.array([rules.link_rad / 0.01, *exact.shared[1:]]))
    links = drift.covariance(weak) - drift.covariance(exact)
    sigmas = np.sqrt(np.diagonal(links))
    np.testing.assert_allclose(sigmas[:3], 0.01)
    np.testing.assert_allclose(sigmas[3:], [0.01 * np.hypot(1, 3.5)] * 2 + [0.01], rtol=1e-6)


def test_the_path_is_in_radians_and_metres() -> None:
    ids, travelled = turning_world(0.01).travelled()
    assert ids.tolist() == list(range(2 * COUNT))
    assert travelled[0].tolist() == [0, 0]
    assert travelled[-1, 0] == pytest.approx(0.05 * (2 * COUNT - 1), rel=0.01)
    steps = np.diff(travelled, axis=0)
    assert (steps[:, 1] > 0).all()
    assert steps[:, 1].max() < 0.02


def test_what_a_bent_map_adds_grows_with_the_change_and_has_units() -> None:
    """Sigmas of a turn of 1 rad: 23 mrad; of a move of 2 m: 45 mm."""
    noise = LoopNoise(NoiseConfig())
    poses = np.stack([se3_exp([0, 1.0, 0, 0, 0, 0]), se3_exp([0, 0, 0, 0, 2.0, 0])])
    sigmas = np.sqrt(np.diagonal(noise.bent(poses), axis1=1, axis2=2))
    np.testing.assert_allclose(sigmas[0], np.repeat([0.023, 0.005], 3))
    np.testing.assert_allclose(sigmas[1], np.repeat([0.003, 0.045], 3))


def straight(length_m: int) -> Array:
    """Poses (N, 4, 4) of steps of 1 m along the optical axis."""
    return se3_exp(np.arange(length_m + 1.0)[:, None] * [0, 0, 0, 0, 0, 1])


def sweeping(turns_rad: list[float]) -> Array:
    """Poses (N, 4, 4) of a camera that turns on the spot."""
    return se3_exp(np.cumsum([0.0, *turns_rad])[:, None] * [0, 1, 0, 0, 0, 0])


def walk() -> Array:
    """Poses (41, 4, 4): 40 steps of 0.6 m that turn at random."""
    turns = np.random.default_rng(3).normal(size=(40, 3)) * [0.05, 0.2, 0.05]
    poses = [np.eye(4)]
    for turn in turns:
        poses.append(poses[-1] @ se3_exp([*turn, 0, 0, 0.6]))
    return np.array(poses)


@pytest.mark.parametrize(
    ("way", "sigma_rad", "sigma_m"),
    [
        (straight(0), 0.003, (0.005, 0.005)),
        (
            straight(4),
            np.hypot(0.003, 0.02),
            (0.0895, np.hypot(0.005, np.hypot(0.08, 0.08))),
        ),  # alike all the way
        (straight(100), np.hypot(0.003, 0.1), (5.786, np.hypot(2.0, 0.4))),  # with the root
        (sweeping([1.0]), np.hypot(0.003, 0.02), (0.0206, 0.0206)),
        (sweeping([1.0, -1.0] * 50), 0.003, (0.005, 0.005)),  # turns to both sides cancel
        (sweeping([np.pi / 6] * 12), np.hypot(0.003, 0.04 * np.pi), (0.005, 0.005)),  # a circle
    ],
)
def test_how_drift_grows_on_a_way(
    way: Array, sigma_rad: float, sigma_m: tuple[float, float]
) -> None:
    """The sigmas of turns about y, and of moves sideways and ahead."""
    sigmas = np.sqrt(np.diagonal(MapDrift(NoiseConfig()).covariance(linked(way))))
    np.testing.assert_allclose(sigmas[1], sigma_rad, rtol=1e-3)
    np.testing.assert_allclose(sigmas[[3, 5]], sigma_m, rtol=1e-2)


def test_drift_is_that_of_simulated_ways() -> None:
    """A camera model that bends all turns alike, a scale, and errors that are alike for 4 m."""
    rules, way, rng = NoiseConfig(), walk(), np.random.default_rng(4)
    steps = se3_log(inverse(way[:-1]) @ way[1:])
    blocks = (np.arange(40) * 0.6 // 4).astype(int)
    per_m = np.repeat([rules.drift_rad_per_m, rules.drift_m_per_m], 3)
    bends = 0.1 * rules.model_share * rng.normal(size=(4000, 6, 3))
    walked = 0.1 * per_m * rng.normal(size=(4000, blocks[-1] + 1, 6))[:, blocks]
    errors = steps[:, :3] @ bends.swapaxes(1, 2) + 0.6 * walked
    errors[..., 3:] += 0.1 * rules.drift_m_per_m * rng.normal(size=(4000, 1, 1)) * steps[:, 3:]
    errors = se3_exp(errors)
    T = np.eye(4)
    for half, error in zip(se3_exp(steps / 2), errors.swapaxes(0, 1), strict=True):
        T = T @ half @ error @ half
    sampled = 100 * np.cov(se3_log(inverse(way[-1]) @ T).T)
    drift = MapDrift(replace(rules, model_sigma_rad=0.0, model_sigma_m=0.0))
    drift = drift.covariance(linked(way))
    sigmas = np.sqrt(np.diagonal(drift))
    unit = np.outer(sigmas, sigmas)
    np.testing.assert_allclose(sampled / unit, drift / unit, atol=0.07)


def test_drift_is_less_where_loops_have_shown_less_and_never_more_than_assumed() -> None:
    """Loops after 24 m of way: their implied drift is 1 % of what was possible, then all of it."""
    drift, way = MapDrift(NoiseConfig()), linked(walk())
    assumed = drift.covariance(way)
    root, rng = np.linalg.cholesky(assumed), np.random.default_rng(5)
    own, none = 1e-6 * np.eye(6), linked(np.zeros((0, 4, 4)))
    for _ in range(20):
        drift.learn(0.1 * rng.normal(size=(3, 6)) @ root.T, [own] * 3, [way] * 3)
    # (1 + 20 * 0.01) / 21, times 2
    np.testing.assert_allclose(drift.scale, 0.114, rtol=0.1)
    ratio = np.diagonal(drift.covariance(way)) / np.diagonal(assumed)
    assert (ratio < 0.13).all()
    before = drift.scale
    drift.places_look_alike = True
    np.testing.assert_allclose(drift.scale, before * 0.2**2)
    known = MapDrift(NoiseConfig())
    known.restore(drift.state())
    assert known.places_look_alike
    drift.places_look_alike = False
    drift.learn(root[:1], [assumed], [way])  # no more precise than the drift
    drift.learn(root[:1], [own], [none])
    assert drift.scale == before
    again = MapDrift(NoiseConfig())
    again.restore(drift.state())
    assert again.scale == before
    for _ in range(40):
        drift.learn(2 * rng.normal(size=(3, 6)) @ root.T, [own] * 3, [way] * 3)
    assert drift.scale == 1.0
    again.restore(MapDrift(NoiseConfig()).state())
    np.testing.assert_array_equal(again.covariance(way), assumed)


@pytest.mark.parametrize(
    ("length_m", "implied_m", "elsewhere"),
    [(20, 0.1, False), (20, 3.0, True), (100, 1.5, True), (100, 0.3, False), (250, 0.0, True)],
)
def test_a_look_alike_must_be_less_likely_than_the_drift(
    length_m: int, implied_m: float, elsewhere: bool
) -> None:
    """There and back, to a place beside where the map has it; after 250 m that tells nothing."""
    drift = MapDrift(NoiseConfig())
    way = linked(np.concatenate([straight(length_m // 2), straight(length_m // 2)[-2::-1]]))
    implied = np.array([0, 0, 0, implied_m, 0, 0])
    assert not drift.alike_elsewhere(implied, STATED + drift.covariance(way))
    drift.places_look_alike = True
    assert drift.alike_elsewhere(implied, STATED + drift.covariance(way)) == elsewhere


def test_a_room_that_looks_like_another_is_no_loop() -> None:
    """6 m beside where the camera is, after a walk of 26 m and 13 rad between the two.

    What lies far beyond the gate shows that places look alike; then less drift is allowed.
    """
    places_m = [k if k < 16 else 32 - k for k in range(27)]  # there and part of the way back
    world = world_of([
        se3_exp([0, 0, 0, x_m, 0, 0]) @ se3_exp([0, 0.5 * k, 0, 0, 0, 0])
        for k, x_m in enumerate(places_m)
    ])  # fmt: skip
    closer = LoopCloser(CAMERA, LoopClosingConfig(), EventLog())
    a, b = (world.keyframes[k].T_world_camera for k in (0, 26))
    paths, loop = CovisiblePaths(world), noisy_loops(turning_world(0.01), 1.0, 1)[0]
    tried = ((1.0, True), (3.0, False), (1.0, True), (20.0, False), (1.0, False), (0.2, True))
    for k, (apart_m, fits) in enumerate(tried):
        assert closer.drift.places_look_alike == (k > 3)
        T_a_b = inverse(a) @ se3_exp([0, 0, 0, 0, 0, apart_m]) @ b
        found = replace(loop, keyframe_a=0, keyframe_b=26, T_a_b=T_a_b)
        assert closer._drift_allows(found, world, paths) == fits


@pytest.mark.parametrize(
    ("length_m", "apart_m", "beyond"),
    [(30, 8.0, False), (30, 9.0, True), (100, 8.0, False), (100, 12.0, True), (250, 0.0, True)],
)
def test_places_out_of_reach_are_those_whose_every_loop_would_be_refused(
    length_m: int, apart_m: float, beyond: bool
) -> None:
    """There and back, to a place that is so far from where the walk began."""
    drift, gate = MapDrift(NoiseConfig()), LoopClosingConfig().gate
    there = straight(length_m // 2)
    way = np.concatenate([there, there[-2::-1]])
    way[:, 1, 3] += np.linspace(0, apart_m, len(way))
    world, ends = world_of(way), (0, len(way) - 1)
    paths = CovisiblePaths(world)
    assert not drift.out_of_reach(ends, paths, gate)
    drift.places_look_alike = True
    assert drift.out_of_reach(ends, paths, gate) == beyond
    if not beyond:
        return
    S = drift.covariance(paths.way(*ends))
    rng = np.random.default_rng(0)
    T_a_b = inverse(way[0]) @ way[-1]
    for direction in rng.normal(size=(200, 3)):
        near = make_pose(np.eye(3), 7.9 * direction / np.linalg.norm(direction))
        implied = se3_log(inverse(near) @ T_a_b)[None]
        refused = float(mahalanobis(implied, S[None])[0]) > gate
        assert refused or drift.alike_elsewhere(implied[0], S)
