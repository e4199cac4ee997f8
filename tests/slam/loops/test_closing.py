"""Loop closing from recognition to the optimised map; the camera turns once in a room."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from synthetic_view import CAMERA, add_keyframe, make_features, random_descriptors

import bmask_slam.back_end.mapper
from bmask_slam.back_end.config import BackEndConfig
from bmask_slam.back_end.landmark_management import MappingConfig
from bmask_slam.back_end.mapper import Mapper
from bmask_slam.events import EventLog
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.factors.graph_estimate import RelativePoseErrors
from bmask_slam.graph.geometry import inverse, make_pose, se3_exp, se3_log, so3_exp, transform
from bmask_slam.loops.closing import LoopCloser, LoopClosingConfig
from bmask_slam.loops.verification import LoopConstraint
from bmask_slam.tracking.config import TrackingConfig
from bmask_slam.tracking.results import starting
from bmask_slam.tracking.tracker import Tracker
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.world_map import WorldMap

STEP_RAD = np.deg2rad(10.0)
ONCE_ROUND = 36
STRETCHED = replace(CAMERA, fx=1.015 * CAMERA.fx)
"""A wrong focal length makes every turn too small, by 5 degrees in a circle."""


def pose_of(k: int) -> Array:
    """True poses: a metre from the middle, looking outwards."""
    R = so3_exp(np.array([0.0, STEP_RAD * k, 0.0]))
    return make_pose(R, R @ np.array([0.0, 0.0, 1.0]))


@dataclass
class Ring:
    """The mapper with keyframes whose landmarks are not matched again after five keyframes."""

    config: LoopClosingConfig = field(default_factory=LoopClosingConfig)
    memory: int = 5

    def __post_init__(self) -> None:
        rng = np.random.default_rng(3)
        angle = rng.uniform(0, 2 * np.pi, 1500)
        distance, height = rng.uniform(3.0, 4.5, 1500), rng.uniform(-1.3, 1.3, 1500)
        self.points = np.stack([distance * np.sin(angle), height, distance * np.cos(angle)], 1)
        self.descriptors = random_descriptors(1500, rng)
        tracker = Tracker(STRETCHED, TrackingConfig())
        mapping = MappingConfig(redundant_share=2.0)
        rules = BackEndConfig(mapping, loops=self.config)
        self.mapper = Mapper(STRETCHED, tracker, rules)
        self.landmark_of: dict[int, tuple[int, int]] = {}  # point: landmark, newest keyframe
        self.points_of: dict[int, Array] = {}
        self.noise = rng.normal(size=(60, 1500, 3)) * [0.2, 0.2, 0.05]

    def step(self) -> tuple[Keyframe, list[LoopConstraint]]:
        """Add a keyframe: landmarks, optimisation, loops."""
        world, k = self.mapper.world, self.mapper.world.next_keyframe_id
        camera_points = transform(inverse(pose_of(k)), self.points)
        pixels = CAMERA.project(np.where(camera_points[:, 2:] > 0.1, camera_points, [9e9, 0, 1]))
        observed = np.flatnonzero(
            (camera_points[:, 2] > 0.1) & (np.abs(pixels - [320, 240]) < [310, 230]).all(axis=1)
        )
        noise = self.noise[k, observed]
        features = make_features(
            pose_of(k), self.points[observed], self.descriptors[observed], noise
        )
        features = replace(features, depth_m=CAMERA.stereo_bf_px_m / features.disparity_px)
        T = pose_of(0)
        if k:
            T = world.keyframes[k - 1].T_world_camera @ inverse(pose_of(k - 1)) @ pose_of(k)
        keyframe = add_keyframe(world, T, features)
        self.points_of[k] = observed
        self._observe(keyframe, observed)
        self.mapper.loops.add(keyframe)
        self.mapper.optimise(keyframe)
        return keyframe, self.mapper.close_loops(keyframe)

    def _observe(self, keyframe: Keyframe, observed: Array) -> None:
        world, k = self.mapper.world, keyframe.id
        known = {p: self.landmark_of[p] for p in observed.tolist() if p in self.landmark_of}
        now = world.landmarks.current(np.arange(len(world.landmarks)))
        in_map = world.landmarks.in_map[now]
        tracked = {p: now[i] for p, (i, at) in known.items() if k - at <= self.memory and in_map[i]}
        rows = np.array([row for row, p in enumerate(observed.tolist()) if p in tracked], np.int64)
        ids = np.array([tracked[p] for p in observed[rows].tolist()], np.int64)
        world.attach(keyframe, rows, ids)
        free = np.setdiff1d(np.arange(len(observed)), rows)
        points = STRETCHED.backproject(
            keyframe.features.pixels[free], keyframe.features.depth_m[free]
        )
        new_ids = world.make_landmarks(keyframe, free, transform(keyframe.T_world_camera, points))
        for p, i in zip(np.r_[observed[rows], observed[free]], np.r_[ids, new_ids], strict=True):
            self.landmark_of[int(p)] = (int(i), k)

    def run(self, count: int) -> list[LoopConstraint]:
        return [loop for _ in range(count) for loop in self.step()[1]]

    def error_rad(self) -> float:
        """The rotation error of the newest keyframe against the first."""
        keyframes = self.mapper.world.keyframes
        newest = max(keyframes)
        T = inverse(keyframes[0].T_world_camera) @ keyframes[newest].T_world_camera
        T_true = inverse(pose_of(0)) @ pose_of(newest)
        return float(np.linalg.norm(se3_log(inverse(T_true) @ T)[:3]))


@pytest.fixture(scope="module")
def closed() -> tuple[Ring, list[LoopConstraint]]:
    ring = Ring()
    return ring, ring.run(ONCE_ROUND + 4)


def test_a_closed_loop_removes_the_drift(closed: tuple[Ring, list[LoopConstraint]]) -> None:
    drifting = Ring(LoopClosingConfig(enabled=False))
    assert drifting.run(ONCE_ROUND + 4) == []
    ring, loops = closed
    assert len(loops) >= 3
    assert drifting.error_rad() > 0.05
    assert ring.error_rad() < 0.1 * drifting.error_rad()


def test_a_closed_loop_fuses_the_landmarks_of_both_sides(
    closed: tuple[Ring, list[LoopConstraint]],
) -> None:
    ring, loops = closed
    world = ring.mapper.world
    a, b = (world.keyframes[getattr(loops[-1], f"keyframe_{end}")] for end in "ab")
    both, in_a, in_b = np.intersect1d(
        ring.points_of[a.id], ring.points_of[b.id], return_indices=True
    )
    same = a.landmark_ids[in_a] == b.landmark_ids[in_b]
    assert len(both) > 50
    assert same.mean() > 0.9


def test_map_and_graph_hold_the_same_landmarks(closed: tuple[Ring, list[LoopConstraint]]) -> None:
    ring, _ = closed
    landmarks = ring.mapper.world.landmarks
    estimate = ring.mapper.smoother.estimate()
    ids = np.flatnonzero(landmarks.in_graph & landmarks.in_map)
    assert np.array_equal(estimate.landmark_ids, ids)
    assert np.array_equal(estimate.points_world, landmarks.points_world[ids])


def test_an_accepted_wrong_loop_is_removed_later(monkeypatch: pytest.MonkeyPatch) -> None:
    ring, sound = Ring(), Ring()
    sound.run(20)
    ring.run(18)
    wrong = constraint(4, 18, se3_exp(np.array([0.1, 0.5, 0.0, 1.0, 0.0, 2.0])))
    monkeypatch.setattr(ring.mapper.loops, "loops_of", lambda *_: [wrong])
    assert ring.step()[1] == []
    monkeypatch.undo()
    ring.step()
    assert len(ring.mapper.smoother.relative_pose_errors("loop").chi2) == 0
    assert ring.error_rad() == pytest.approx(sound.error_rad(), rel=0.01)


@pytest.mark.parametrize(("count", "sigmas"), [(2, [0.3, 1.0]), (5, [0.5, 2.0])])
def test_wrong_loops_among_a_strong_set_are_removed(
    count: int, sigmas: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A strong set of loops is accepted against the path; contradictions within the set are not."""
    sound, ring = Ring(), Ring()
    right = sound.run(ONCE_ROUND)
    last = max(loop.keyframe_b for loop in right)
    rng = np.random.default_rng(5)
    noise = rng.normal(size=(count, 6)) * np.repeat(sigmas, 3)
    wrong = [constraint(4 + 3 * k, last, se3_exp(xi)) for k, xi in enumerate(noise)]
    monkeypatch.setattr(ring.mapper.loops, "loops_of", lambda *_: [])
    ring.run(last)
    monkeypatch.setattr(ring.mapper.loops, "loops_of", lambda *_: [*right, *wrong])
    kept = ring.step()[1]
    assert [loop.ends for loop in kept] == [loop.ends for loop in right]
    assert ring.error_rad() < 2 * sound.error_rad()


def constraint(a: int, b: int, T_a_b: Array) -> LoopConstraint:
    covariance = np.diag([1e-3] * 3 + [2e-3] * 3) ** 2
    return LoopConstraint(a, b, T_a_b, covariance, 50, 1.0, np.zeros((0, 2), np.int64))


def straight_world(count: int) -> WorldMap:
    """Keyframes half a metre apart, exact, without keypoints."""
    world = WorldMap()
    for k in range(count):
        features = make_features(np.eye(4), np.zeros((0, 3)), np.zeros((0, 8), np.uint64))
        add_keyframe(world, se3_exp(np.array([0, 0.01 * k, 0, 0.5 * k, 0, 0])), features)
    return world


def displaced(world: WorldMap, a: int, b: int, T_drift: Array) -> LoopConstraint:
    """The loop if b's part of the map is displaced by T_drift (in the world)."""
    T_a, T_b = (world.keyframes[k].T_world_camera for k in (a, b))
    return constraint(a, b, inverse(T_a) @ T_drift @ T_b)


T_DRIFT = se3_exp(np.array([0.0, 0.03, 0.02, 0.3, 0.1, -0.2]))


def test_consistent_loops_confirm_each_other() -> None:
    world, closer = straight_world(40), LoopCloser(CAMERA, LoopClosingConfig(), EventLog())
    first = [displaced(world, k, 36, T_DRIFT) for k in (2, 3)]
    third = displaced(world, 4, 37, T_DRIFT)
    assert closer.confirm(first, world) == []
    assert closer.confirm([third], world) == [*first, third]
    assert closer.waiting == []


def test_loops_of_one_keyframe_do_not_confirm_each_other() -> None:
    world, closer = straight_world(40), LoopCloser(CAMERA, LoopClosingConfig(), EventLog())
    loops = [displaced(world, k, 36, T_DRIFT) for k in (2, 3, 4, 5)]
    assert closer.confirm(loops, world) == []
    assert closer.waiting == loops


def test_random_loops_are_never_confirmed() -> None:
    """They show that places look alike, after which right ones may imply a drift of 1.5 %."""
    world, closer = straight_world(40), LoopCloser(CAMERA, LoopClosingConfig(), EventLog())
    rng = np.random.default_rng(8)
    T_drift = se3_exp(0.3 * se3_log(T_DRIFT))
    right = [displaced(world, k, 34 + k, T_drift) for k in range(3)]
    entered: list[LoopConstraint] = []
    for k in range(12):
        T = se3_exp(rng.normal(size=6) * [0.5, 0.5, 0.5, 3, 3, 3])
        a, b = int(rng.integers(0, 20)), int(rng.integers(25, 40))
        entered += closer.confirm([constraint(a, b, T)], world)
        if k in (3, 6, 9):
            entered += closer.confirm([right[k // 3 - 1]], world)
    assert entered == right
    assert closer.drift.places_look_alike


def test_loops_of_a_culled_keyframe_are_removed() -> None:
    world, closer = straight_world(40), LoopCloser(CAMERA, LoopClosingConfig(), EventLog())
    closer.confirm([displaced(world, k, 36, T_DRIFT) for k in (2, 3)], world)
    closer.remove(2)
    assert [loop.keyframe_a for loop in closer.waiting] == [3]
    closer.remove(36)
    assert closer.waiting == []


def test_an_inconsistent_old_loop_is_removed_with_its_fusions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ring = Ring()
    loops = ring.run(ONCE_ROUND + 2)
    a, b = (ring.mapper.world.keyframes[k] for k in loops[-1].ends)
    assert len(np.intersect1d(*(ring.mapper.world.observed(k)[1] for k in (a, b)))) > 50
    closer, smoother = ring.mapper.loops, ring.mapper.smoother
    errors = smoother.relative_pose_errors("loop")
    assert set(closer.closed) == set(zip(errors.keyframe_a, errors.keyframe_b, strict=True))
    closer.closed = dict.fromkeys(closer.closed, False)
    extra = constraint(20, 36, inverse(pose_of(20)) @ pose_of(36))
    monkeypatch.setattr(closer, "loops_of", lambda *_: [extra])
    relative_pose_errors = smoother.relative_pose_errors

    def old_ones_bad(kind: str, slack: object) -> RelativePoseErrors:
        assert slack == closer.noise.bent
        errors = relative_pose_errors(kind)
        return replace(errors, chi2=np.where(errors.keyframe_a < 20, 1e3, 0.0))

    monkeypatch.setattr(smoother, "relative_pose_errors", old_ones_bad)
    assert ring.step()[1] == [extra]
    assert list(closer.closed) == [extra.ends]
    assert len(np.intersect1d(*(ring.mapper.world.observed(k)[1] for k in (a, b)))) < 10


def test_a_loop_removed_with_its_keyframe_is_not_rejected() -> None:
    ring = Ring()
    loops = ring.run(ONCE_ROUND)
    mapper = ring.mapper
    assert refuted(mapper) == set()
    culled = loops[-1].keyframe_a
    mapper.world.remove_keyframe(mapper.world.keyframes[culled], mapper.world.keyframes[culled + 1])
    mapper._factor_selector.remove_keyframe(culled)
    mapper.loops.remove(culled)
    ring.step()
    in_graph = mapper.smoother.relative_pose_errors("loop")
    assert culled not in in_graph.keyframe_a
    assert refuted(mapper) == set()


def refuted(mapper: Mapper) -> set[tuple[int, int]]:
    return mapper.loops.refuted(mapper.smoother.relative_pose_errors("loop"), mapper.world)


def test_keyframes_at_the_ends_of_loops_are_never_culled(monkeypatch: pytest.MonkeyPatch) -> None:
    ring = Ring()
    loops = ring.run(ONCE_ROUND)
    offered: list[int] = []

    def record(_: WorldMap, candidates: list[Keyframe], __: MappingConfig) -> None:
        offered.extend(k.id for k in candidates)

    monkeypatch.setattr(bmask_slam.back_end.mapper, "redundant_keyframe", record)
    newest, _ = ring.step()
    world = ring.mapper.world
    ends = {end for loop in loops for end in loop.ends}
    near = {k.id for _, k in world.covisible(world.observed(newest)[1], 15)}
    assert ends & near - {0, newest.id - 1, newest.id - 2}
    assert offered
    assert not ends & set(offered)


def test_joining_a_segment_keeps_the_closed_loops_in_the_graph() -> None:
    """A missing loop would be rejected and undone at the next closure."""
    ring = Ring()
    assert ring.run(ONCE_ROUND + 4)
    mapper = ring.mapper
    before = mapper.smoother.relative_pose_errors("loop")
    newest = max(mapper.world.keyframes.values(), key=lambda k: k.id)
    wrong_pose = se3_exp(np.array([0.2, -0.1, 0.3, 1.0, 2.0, 3.0])) @ newest.T_world_camera
    other = add_keyframe(mapper.world, wrong_pose, newest.features, segment=1)
    keypoints, ids = mapper.world.observed(newest)
    features = newest.features
    observed = replace(
        starting(newest.T_world_camera, features), keypoints=keypoints, landmark_ids=ids
    )
    mapper.join(1, starting(wrong_pose, features), observed)
    assert other.segment == 0
    after = mapper.smoother.relative_pose_errors("loop")
    assert len(before.chi2) >= 3
    assert after.keyframe_a.tolist() == before.keyframe_a.tolist()
    assert after.keyframe_b.tolist() == before.keyframe_b.tolist()
    assert refuted(mapper) == set()
