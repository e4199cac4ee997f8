"""Trajectory errors: against evo, published figures, and planted errors."""

import copy

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from repository import SHARED

from bmask_slam.graph.geometry import inverse, make_pose, se3_exp, so3_exp
from bmask_slam.graph.metrics import (
    ErrorStatistics,
    absolute_error,
    align,
    distance_pairs,
    frame_pairs,
    relative_error,
    time_pairs,
)
from bmask_slam.graph.trajectory import Trajectory, associate, read_tum

TRAJECTORIES = SHARED / "trajectories"
needs_shared = pytest.mark.skipif(
    not TRAJECTORIES.is_dir(), reason="no ../shared/data/trajectories here"
)
seeds = st.integers(0, 2**32 - 1)


def walk(count: int = 60, seed: int = 0, fps: float = 10.0) -> Trajectory:
    """A smooth random motion of about a metre."""
    rng = np.random.default_rng(seed)
    xi = np.cumsum(rng.normal(0, 0.08, (count, 6)), axis=0)
    return Trajectory(5 + np.arange(count) / fps, se3_exp(xi))


def noisy(t: Trajectory, seed: int = 1, sigma: float = 0.02) -> Trajectory:
    xi = np.random.default_rng(seed).normal(0, sigma, (len(t), 6))
    return Trajectory(t.timestamps_s, t.poses_world_camera @ se3_exp(xi))


def random_pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return se3_exp(np.r_[rng.uniform(-2, 2, 3), rng.uniform(-50, 50, 3)])


@given(seeds, st.floats(0.2, 5))
@settings(max_examples=40, deadline=None)
def test_align_recovers_the_frames(seed, scale):
    """p_reference = s R p_estimate + t: direction, sign and scale of the result."""
    T_reference_estimate = random_pose(seed)
    points_estimate = walk(seed=seed % 1000).positions_world
    rotated = points_estimate @ T_reference_estimate[:3, :3].T
    found = align(points_estimate, scale * rotated + T_reference_estimate[:3, 3], with_scale=True)
    assert found.scale == pytest.approx(scale, rel=1e-9)
    np.testing.assert_allclose(found.T_reference_estimate, T_reference_estimate, atol=1e-8)


def test_align_never_reflects():
    points = np.random.default_rng(0).normal(size=(30, 3))
    R = align(points, points * [1, 1, -1]).T_reference_estimate[:3, :3]
    assert np.linalg.det(R) == pytest.approx(1)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


def test_align_gives_the_least_squares_optimum():
    points = walk().positions_world
    target = noisy(walk(), sigma=0.1).positions_world
    found = align(points, target)

    def cost(T):
        return np.sum((points @ T[:3, :3].T + T[:3, 3] - target) ** 2)

    best = cost(found.T_reference_estimate)
    for xi in np.vstack([np.eye(6), -np.eye(6)]) * 1e-4:
        assert cost(found.T_reference_estimate @ se3_exp(xi)) > best


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_errors_do_not_depend_on_the_world_frames(seed):
    reference, T = walk(seed=3), random_pose(seed)
    estimate = noisy(reference)
    pairs = frame_pairs(len(reference), 7)
    moved = [(estimate.moved(T), reference), (estimate, reference.moved(T))]
    a, r = absolute_error(estimate, reference), relative_error(estimate, reference, pairs)
    for e, g in moved:
        b, s = absolute_error(e, g), relative_error(e, g, pairs)
        np.testing.assert_allclose(b.translation_m.errors, a.translation_m.errors, atol=1e-9)
        np.testing.assert_allclose(b.rotation_rad.errors, a.rotation_rad.errors, atol=1e-7)
        np.testing.assert_allclose(s.translation_m.errors, r.translation_m.errors, atol=1e-9)
        np.testing.assert_allclose(s.rotation_rad.errors, r.rotation_rad.errors, atol=1e-7)


def test_aligned_lies_in_the_reference_frame():
    reference = walk()
    estimate = reference.moved(random_pose(4))
    error = absolute_error(estimate, reference)
    np.testing.assert_allclose(
        error.aligned.poses_world_camera, reference.poses_world_camera, atol=1e-8
    )
    assert error.translation_m.max < 1e-8
    assert error.rotation_rad.max < 1e-7


def test_scale_only_on_request():
    reference = walk()
    poses = reference.poses_world_camera.copy()
    poses[:, :3, 3] /= 1.1
    estimate = Trajectory(reference.timestamps_s, poses)
    assert absolute_error(estimate, reference, with_scale=True).translation_m.rmse < 1e-9
    spread = reference.positions_world - reference.positions_world.mean(axis=0)
    expected = (1 - 1 / 1.1) * np.sqrt(np.mean(np.sum(spread**2, axis=1)))
    assert absolute_error(estimate, reference).translation_m.rmse == pytest.approx(expected)


def test_statistics():
    error = ErrorStatistics(np.array([1.0, 2.0, 2.0, 7.0]))
    assert (error.rmse, error.mean, error.median, error.max) == (np.sqrt(58 / 4), 3.0, 2.0, 7.0)


def test_planted_distances():
    """Four corners of a square, the estimate's twice as far out: each is off by its radius."""
    corners = np.array([[1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0.0]])
    near, far = (make_pose(np.eye(3), k * corners) for k in (1, 2))
    stamps = np.arange(4.0)
    error = absolute_error(Trajectory(stamps, far), Trajectory(stamps, near))
    np.testing.assert_allclose(error.translation_m.errors, np.sqrt(2))
    np.testing.assert_allclose(error.rotation_rad.errors, 0, atol=1e-9)


def test_relative_error_of_planted_drift():
    """A metre forward a frame; the estimate moves 1.01 m and turns one degree more each time."""
    step_true, step = np.eye(4), np.eye(4)
    step_true[2, 3] = 1.0
    step[2, 3] = 1.01
    step[:3, :3] = so3_exp([0, np.deg2rad(1), 0])
    truth, estimate = [np.eye(4)], [random_pose(8)]
    for _ in range(20):
        truth.append(truth[-1] @ step_true)
        estimate.append(estimate[-1] @ step)
    stamps = np.arange(21) / 5
    e, g = Trajectory(stamps, np.stack(estimate)), Trajectory(stamps, np.stack(truth))
    error = relative_error(e, g, frame_pairs(21))
    np.testing.assert_allclose(error.translation_m.errors, 0.01, atol=1e-9)
    np.testing.assert_allclose(np.rad2deg(error.rotation_rad.errors), 1, atol=1e-9)
    per_second = relative_error(e, g, time_pairs(stamps))
    np.testing.assert_allclose(np.rad2deg(per_second.rotation_rad.errors), 5, atol=1e-9)
    np.testing.assert_allclose(per_second.timestamps_s, stamps[:16])


def test_relative_error_equals_a_loop():
    """The vectorised form against the definition, pair by pair."""
    g = walk(30)
    e = noisy(g)
    i, j = frame_pairs(30, 4)
    expected = [
        inverse(inverse(g.poses_world_camera[a]) @ g.poses_world_camera[b])
        @ (inverse(e.poses_world_camera[a]) @ e.poses_world_camera[b])
        for a, b in zip(i, j, strict=True)
    ]
    error = relative_error(e, g, (i, j))
    np.testing.assert_allclose(
        error.translation_m.errors, [np.linalg.norm(E[:3, 3]) for E in expected], atol=1e-12
    )
    angles = [np.arccos((np.trace(E[:3, :3]) - 1) / 2) for E in expected]
    np.testing.assert_allclose(error.rotation_rad.errors, angles, atol=1e-9)


def test_time_pairs_skip_gaps():
    stamps = np.r_[np.arange(0, 2, 0.1), np.arange(5.03, 7, 0.1)]
    i, j = time_pairs(stamps)
    assert np.abs(stamps[j] - stamps[i] - 1).max() < 0.1 + 1e-9
    assert not ((stamps[i] < 3) & (stamps[j] > 3)).any()
    assert (stamps[i] < 1.05).sum() == 11  # 0.0 to 1.0: the last finds 1.9, a tenth too near
    assert len(time_pairs(stamps[:5])[0]) == 0
    assert len(time_pairs(stamps[:0])[0]) == 0


@given(seeds, st.floats(0.05, 3))
@settings(max_examples=40, deadline=None)
def test_distance_pairs_equal_a_loop(seed, delta_m):
    """Each i with the later j nearest in path length, with stops on the way."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(0, 0.05, (50, 3)) * (rng.random((50, 1)) < 0.7)
    positions = np.cumsum(steps, axis=0)
    path_m = np.r_[0, np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))]
    expected = []
    for i in range(len(positions) - 1):
        off_m = np.abs(path_m[i + 1 :] - path_m[i] - delta_m)
        if off_m.min() <= 0.1 * delta_m:
            expected.append((i, i + 1 + int(off_m.argmin())))
    found = distance_pairs(positions, delta_m)
    assert list(zip(*(k.tolist() for k in found), strict=True)) == expected


def test_no_pairs_give_no_error():
    t = walk(1)
    assert relative_error(t, t, frame_pairs(1)) is None
    assert not len(distance_pairs(t.positions_world)[0])


@needs_shared
@pytest.mark.parametrize(
    ("estimate", "reference", "with_scale", "ate_cm"),
    [
        ("freiburg1_xyz-rgbdslam", "freiburg1_xyz-groundtruth", False, 1.35),
        ("fr2_desk_ORB", "fr2_desk_groundtruth", False, 0.81),
        ("freiburg1_xyz-ORB_kf_mono", "freiburg1_xyz-groundtruth", True, 0.98),
    ],
)
def test_published_trajectories(estimate, reference, with_scale, ate_cm):
    e, g = associate(
        read_tum(TRAJECTORIES / f"{estimate}.txt"), read_tum(TRAJECTORIES / f"{reference}.txt")
    )
    rmse_cm = 100 * absolute_error(e, g, with_scale).translation_m.rmse
    assert rmse_cm == pytest.approx(ate_cm, abs=0.006)


def evo_pair(estimate: Trajectory, reference: Trajectory):
    trajectory = pytest.importorskip("evo.core.trajectory")
    return tuple(
        trajectory.PoseTrajectory3D(
            poses_se3=list(t.poses_world_camera), timestamps=reference.timestamps_s
        )
        for t in (reference, estimate)
    )


def example(name: str) -> tuple[Trajectory, Trajectory]:
    if name == "synthetic":
        reference = walk(200)
        return noisy(reference.moved(random_pose(5))), reference
    if not TRAJECTORIES.is_dir():
        pytest.skip("no ../shared/data/trajectories here")
    return associate(
        read_tum(TRAJECTORIES / "freiburg1_xyz-rgbdslam.txt"),
        read_tum(TRAJECTORIES / "freiburg1_xyz-groundtruth.txt"),
    )


@pytest.mark.parametrize("name", ["synthetic", "freiburg1_xyz"])
@pytest.mark.parametrize("with_scale", [False, True])
def test_ate_agrees_with_evo(name, with_scale):
    metrics = pytest.importorskip("evo.core.metrics")
    e, g = example(name)
    reference, estimate = evo_pair(e, g)
    estimate = copy.deepcopy(estimate)
    estimate.align(reference, correct_scale=with_scale)
    error = absolute_error(e, g, with_scale)
    for relation, computed in (
        (metrics.PoseRelation.translation_part, error.translation_m),
        (metrics.PoseRelation.rotation_angle_rad, error.rotation_rad),
    ):
        ape = metrics.APE(relation)
        ape.process_data((reference, estimate))
        np.testing.assert_allclose(computed.errors, ape.error, atol=1e-6)
        for statistic in ("rmse", "mean", "median", "max"):
            from_evo = ape.get_statistic(metrics.StatisticsType[statistic])
            assert getattr(computed, statistic) == pytest.approx(from_evo, abs=1e-6)


@pytest.mark.parametrize("name", ["synthetic", "freiburg1_xyz"])
@pytest.mark.parametrize("delta", [1, 10])
def test_rpe_agrees_with_evo(name, delta):
    """On the synthetic walk at 10 Hz, ten frames are one second: both pairings must agree."""
    metrics = pytest.importorskip("evo.core.metrics")
    e, g = example(name)
    pair = evo_pair(e, g)
    pairings = [frame_pairs(len(e), delta)]
    if name == "synthetic" and delta == 10:
        pairings.append(time_pairs(e.timestamps_s, 1.0))
    for relation, part in (
        (metrics.PoseRelation.translation_part, "translation_m"),
        (metrics.PoseRelation.rotation_angle_rad, "rotation_rad"),
    ):
        rpe = metrics.RPE(relation, delta, metrics.Unit.frames, all_pairs=True)
        rpe.process_data(pair)
        for pairs in pairings:
            computed = getattr(relative_error(e, g, pairs), part)
            np.testing.assert_allclose(computed.errors, rpe.error, atol=1e-6)
            assert computed.rmse == pytest.approx(
                rpe.get_statistic(metrics.StatisticsType.rmse), abs=1e-6
            )


def recording(seed: int) -> tuple[Trajectory, Trajectory]:
    """An estimate with gaps and a reference at another rate that covers a part, both on one clock.

    Poses of the estimate are more than two limits (0.01 s) apart, so that evo, which may use a
    stamp twice, pairs one to one.
    """
    rng = np.random.default_rng(seed)
    step_s, truth_step_s = 1 / rng.uniform(5, 40), 1 / rng.uniform(20, 120)
    duration_s = 150 * step_s
    stamps = np.arange(150) * step_s + rng.uniform(-0.1, 0.1, 150) * step_s
    true_stamps = np.arange(0, duration_s, truth_step_s)
    true_stamps += rng.uniform(-0.2, 0.2, len(true_stamps)) * truth_step_s
    begin, end = rng.uniform(0, 0.3) * duration_s, rng.uniform(0.7, 1) * duration_s
    hole = rng.uniform(0.3, 0.5) * duration_s
    covered = (true_stamps > begin) & (true_stamps < end)
    covered &= (true_stamps < hole) | (true_stamps > hole + 0.1 * duration_s)
    xi = rng.normal(0, 1, (8, 6)) * [0.4, 0.4, 0.4, 1, 1, 1]
    phase, speed = rng.uniform(0, 6, 8), rng.uniform(0.2, 2, 8)
    speed *= 2 * np.pi / duration_s

    def poses(t):
        return se3_exp(np.sin(t[:, None] * speed + phase) @ xi)

    estimate = noisy(Trajectory(stamps, poses(stamps)), seed, 0.01).moved(random_pose(seed))
    kept = rng.random(150) < 0.9
    kept[60:80] = False
    return estimate.select(kept), Trajectory(true_stamps[covered], poses(true_stamps[covered]))


@pytest.mark.parametrize("seed", range(100))
def test_everything_agrees_with_evo(seed):
    """From two trajectories: association, ATE and RPE, translation and rotation."""
    sync = pytest.importorskip("evo.core.sync")
    metrics = pytest.importorskip("evo.core.metrics")
    estimate, reference = recording(seed)
    i, j = sync.matching_time_indices(estimate.timestamps_s, reference.timestamps_s, 0.01)
    assert len(set(j)) == len(j) >= 10
    e, g = associate(estimate, reference, 0.01)
    np.testing.assert_array_equal(e.timestamps_s, estimate.timestamps_s[i])
    np.testing.assert_array_equal(g.timestamps_s, reference.timestamps_s[j])
    truth, computed = evo_pair(estimate.select(np.array(i)), reference.select(np.array(j)))
    aligned = copy.deepcopy(computed)
    aligned.align(truth)
    absolute = absolute_error(e, g)
    per_metre = relative_error(e, g, distance_pairs(g.positions_world))
    per_frame = relative_error(e, g, frame_pairs(len(e)))
    relations = metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_rad
    for relation, part in zip(relations, ("translation_m", "rotation_rad"), strict=True):
        ape = metrics.APE(relation)
        ape.process_data((truth, aligned))
        assert getattr(absolute, part).rmse == pytest.approx(rmse(ape), abs=1e-6)
        for delta, unit, error in (
            (1, metrics.Unit.frames, per_frame),
            (1.0, metrics.Unit.meters, per_metre),
        ):
            rpe = metrics.RPE(relation, delta, unit, all_pairs=True, pairs_from_reference=True)
            rpe.process_data((truth, computed))
            assert len(rpe.error) == len(error.timestamps_s)
            assert getattr(error, part).rmse == pytest.approx(rmse(rpe), abs=1e-6)


def rmse(metric) -> float:
    statistics = pytest.importorskip("evo.core.metrics").StatisticsType
    return metric.get_statistic(statistics.rmse)
