"""Adjustment with frames that are no keyframes: the optimum that GTSAM finds of all together."""

from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from synthetic_room import CAMERA, Room, circle, make_room

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.batch import joint_adjustment
from bmask_slam.graph.batch.joint_adjustment import Frames, adjust_jointly
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_update import GraphUpdate, Observations, PosePrior, RelativePose
from bmask_slam.graph.factors.keys import keyframe_keys
from bmask_slam.graph.factors.own_factors import own_factor
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.geometry import inverse, se3_exp, se3_log
from bmask_slam.graph.inertial.tables import InertialFactor, InertialUpdate
from bmask_slam.graph.sensors.imu import ImuConfig, readings_between
from bmask_slam.graph.sensors.streams import Measurements, SensorStreams
from bmask_slam.graph.smoother.isam2 import SolverError
from bmask_slam.graph.smoother.smoother import Smoother
from bmask_slam.rendering.sensors import imu

KEYFRAMES, FRAMES = np.arange(0, 12, 3), np.setdiff1d(np.arange(12), np.arange(0, 12, 3))
EXACT = SmootherConfig(least_decrease=1e-12)
NO_KERNEL = replace(EXACT, robust=False)
LOOP = np.diag([1e-4] * 3 + [2e-4] * 3) ** 2


def seen(room: Room, keyframes: Ints) -> Observations:
    """What these see of landmarks that keyframes see twice, so that a graph may hold them."""
    ids, counts = np.unique(
        room.observations.landmark_ids[np.isin(room.observations.keyframe_ids, KEYFRAMES)],
        return_counts=True,
    )
    used = np.isin(room.observations.keyframe_ids, keyframes)
    return room.observations.select(used & np.isin(room.observations.landmark_ids, ids[counts > 1]))


def tables_of(room: Room, keyframes: Ints, loops: tuple[RelativePose, ...] = ()) -> FactorTables:
    """A graph of these keyframes at their noisy initial values."""
    tables, observations = FactorTables(), seen(room, keyframes)
    landmarks = np.unique(observations.landmark_ids)
    tables.keyframes.insert(keyframes, room.initial_poses[keyframes])
    tables.landmarks.insert(landmarks, room.initial_points[landmarks])
    tables.observations.add(observations)
    tables.add_pose_factors([PosePrior(0, room.initial_poses[0], 1e-8 * np.eye(6)), *loops])
    return tables


def frames_of(room: Room) -> Frames:
    observations = seen(room, FRAMES)
    rows = np.searchsorted(FRAMES, observations.keyframe_ids)
    return Frames(room.initial_poses[FRAMES], replace(observations, keyframe_ids=rows))


def by_gtsam(room: Room, loops: tuple[RelativePose, ...]) -> tuple[Array, Array, Array]:
    """Keyframes, frames and points of one graph in which all are keyframes."""
    tables = tables_of(room, np.arange(12), loops)
    smoother = Smoother(CAMERA, EXACT)
    smoother._tables = tables
    smoother.optimise_batch()
    return tables.keyframes.get(KEYFRAMES), tables.keyframes.get(FRAMES), tables.landmarks.values


def apart(a: Array, b: Array) -> float:
    return float(np.abs(se3_log(inverse(a) @ b)).max())


def wrong_loop(room: Room) -> RelativePose:
    """A measured pose that moves the optimum, without a kernel."""
    T_a_b = inverse(room.poses_world_camera[3]) @ room.poses_world_camera[9]
    return RelativePose(3, 9, T_a_b @ se3_exp(np.full(6, 5e-3)), LOOP, None, "loop")


@pytest.fixture
def all_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    """No observation is left out, as in the other graph."""
    monkeypatch.setattr(joint_adjustment, "OBSERVATION_PROBABILITY", 1 - 1e-12)


@pytest.fixture
def converged(all_stay: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(joint_adjustment, "MAX_STEPS", (30, 30))
    monkeypatch.setattr(joint_adjustment, "LEAST_DECREASE", 1e-12)
    monkeypatch.setattr(joint_adjustment, "CG_STEPS", 1000)
    monkeypatch.setattr(joint_adjustment, "CG_TOLERANCE", 1e-10)


@pytest.mark.parametrize("with_loop", [False, True])
@pytest.mark.usefixtures("converged")
def test_the_optimum_is_that_of_one_graph(with_loop: bool) -> None:
    room = make_room(noise_px=0.5, mono_share=0.3)
    loops = (wrong_loop(room),) if with_loop else ()
    tables = tables_of(room, KEYFRAMES, loops)
    found = adjust_jointly(tables, frames_of(room), CAMERA, EXACT)
    keyframes, frames, points = by_gtsam(room, loops)
    assert apart(tables.keyframes.values, keyframes) < 2e-6
    assert apart(found.poses_world_camera, frames) < 2e-6
    np.testing.assert_allclose(tables.landmarks.values, points, atol=2e-5)
    assert found.outliers == 0
    if with_loop:  # it is not left out, nor does it go unnoticed
        assert apart(keyframes, by_gtsam(room, ())[0]) > 1e-3


def inertial(room: Room) -> InertialUpdate:
    """An IMU's factors between the keyframes, at states that are not known well."""
    hertz, interval_s = 200.0, 0.5
    config = ImuConfig(imu_in_camera=(0.2, -0.1, 0.05, 0.5, -0.5, 0.5, -0.5))
    steps = np.arange(len(room.poses_world_camera) * int(hertz * interval_s))
    path = circle(steps / (hertz * interval_s))
    streams = SensorStreams()
    streams.add(Measurements("imu", imu(path, hertz, config, np.random.default_rng(3))))
    factors = []
    for a, b in pairwise(KEYFRAMES.tolist()):
        readings = readings_between(streams, a * interval_s, b * interval_s, config)
        assert readings is not None
        factors.append(InertialFactor(a, b, 0, readings, config.model))
    states = {k: np.zeros(9) for k in KEYFRAMES.tolist()}
    return InertialUpdate(tuple(factors), states=states, down={0: np.array([0.6, 0.0, -0.8])})


@pytest.mark.usefixtures("converged")
def test_velocities_biases_and_gravity_are_found_with_it() -> None:
    room = make_room(noise_px=0.5)
    tables, together = tables_of(room, KEYFRAMES), tables_of(room, np.arange(12))
    for each in (tables, together):
        each.inertial.add(inertial(room))
    frames, smoother = frames_of(room), Smoother(CAMERA, EXACT)
    smoother._tables = together
    for _ in range(2):  # readings are integrated at the biases that were found before
        found = adjust_jointly(tables, frames, CAMERA, EXACT)
        frames = replace(frames, poses_world_camera=found.poses_world_camera)
        smoother.optimise_batch()
    assert apart(tables.keyframes.values, together.keyframes.get(KEYFRAMES)) < 2e-6
    for k in KEYFRAMES.tolist():
        state = tables.inertial.states[k]
        np.testing.assert_allclose(state, together.inertial.states[k], atol=1e-4)
        assert np.abs(state[:3]).max() > 0.1
    np.testing.assert_allclose(tables.inertial.down[0], together.inertial.down[0], atol=1e-5)
    np.testing.assert_allclose(tables.inertial.down[0], [0, 0, -1], atol=0.01)


@pytest.mark.usefixtures("all_stay")
def test_default_limits_come_close_to_it() -> None:
    room = make_room(noise_px=0.5, points=300)
    tables = tables_of(room, KEYFRAMES)
    found = adjust_jointly(tables, frames_of(room), CAMERA, SmootherConfig())
    keyframes, frames, _ = by_gtsam(room, ())
    assert apart(tables.keyframes.values, keyframes) < 2e-4
    assert apart(found.poses_world_camera, frames) < 2e-4
    assert found.cost_after <= found.cost_before


def test_frames_make_keyframes_more_accurate() -> None:
    errors = []
    for seed in range(5):
        room = make_room(noise_px=1.0, seed=seed)
        alone, tables = Smoother(CAMERA, EXACT), tables_of(room, KEYFRAMES)
        alone._tables = tables_of(room, KEYFRAMES)
        alone.optimise_batch()
        adjust_jointly(tables, frames_of(room), CAMERA, SmootherConfig())
        truth = room.poses_world_camera[KEYFRAMES]
        both = alone.tables.keyframes.values, tables.keyframes.values
        errors.append([np.linalg.norm(p[:, :3, 3] - truth[:, :3, 3], axis=1) for p in both])
    before, after = np.sqrt(np.mean(np.square(errors), axis=(0, 2)))
    assert after < 0.9 * before


def test_outliers_of_frames_are_left_out() -> None:
    room = make_room(noise_px=0.1, points=300)
    frames = frames_of(room)
    wrong = np.arange(0, len(frames.observations), 20)
    frames.observations.measurements[wrong, 0] += 30.0
    tables = tables_of(room, KEYFRAMES)
    found = adjust_jointly(tables, frames, CAMERA, SmootherConfig())
    assert len(wrong) <= found.outliers < 3 * len(wrong)
    assert apart(found.poses_world_camera, by_gtsam(room, ())[1]) < 1e-3


def test_damping_begins_anew_once_outliers_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """At an optimum no damping helps; the last one was kept, and the next steps were tiny."""
    monkeypatch.setattr(joint_adjustment, "LEAST_DECREASE", -1.0)  # until there is no better step
    costs = []
    for first_steps in (3, 60):
        monkeypatch.setattr(joint_adjustment, "MAX_STEPS", (first_steps, 4))
        room = make_room(noise_px=0.5, mono_share=0.3)
        frames = frames_of(room)
        frames.observations.measurements[::9, :2] += 40.0
        found = adjust_jointly(tables_of(room, KEYFRAMES), frames, CAMERA, EXACT)
        assert found.outliers > len(frames.observations) // 9
        costs.append(found.cost_after)
    assert costs[1] == pytest.approx(costs[0], rel=1e-4)


def test_without_frames_it_is_a_bundle_adjustment() -> None:
    room = make_room(noise_px=0.5)
    tables, smoother = tables_of(room, KEYFRAMES), Smoother(CAMERA, EXACT)
    smoother._tables = tables_of(room, KEYFRAMES)
    smoother.optimise_batch()
    none = Frames(np.zeros((0, 4, 4)), Observations())
    found = adjust_jointly(tables, none, CAMERA, EXACT)
    assert len(found.poses_world_camera) == 0
    assert apart(tables.keyframes.values, smoother.tables.keyframes.values) < 1e-4


@pytest.mark.usefixtures("converged")
def test_a_weight_of_other_factors_is_like_larger_sigmas_of_observations() -> None:
    room = make_room(noise_px=0.5)
    loops = (wrong_loop(room),)
    larger = replace(room.observations, sigmas_px=2 * room.observations.sigmas_px)
    less = replace(room, observations=larger)
    tables, other = tables_of(room, KEYFRAMES, loops), tables_of(less, KEYFRAMES, loops)
    found = adjust_jointly(tables, replace(frames_of(room), weight=4.0), CAMERA, NO_KERNEL)
    same = adjust_jointly(other, frames_of(less), CAMERA, NO_KERNEL)
    assert apart(tables.keyframes.values, other.keyframes.values) < 1e-6
    assert apart(found.poses_world_camera, same.poses_world_camera) < 1e-6
    assert found.cost_after == pytest.approx(4 * same.cost_after, rel=1e-6)
    alone = tables_of(room, KEYFRAMES, loops)
    adjust_jointly(alone, frames_of(room), CAMERA, NO_KERNEL)
    assert apart(alone.keyframes.values, tables.keyframes.values) > 1e-4


@pytest.mark.usefixtures("converged")
def test_users_factors_count() -> None:
    room = make_room(noise_px=0.5)
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 1e-5)
    (key,) = keyframe_keys(np.array([6]))
    T = room.poses_world_camera[6] @ se3_exp(np.full(6, 0.01))
    tables = tables_of(room, KEYFRAMES)
    tables.own_factors[0] = own_factor(gtsam.PriorFactorPose3(key, gtsam.Pose3(T), noise))
    adjust_jointly(tables, frames_of(room), CAMERA, SmootherConfig())
    assert apart(tables.keyframes.get(np.array([6])), T[None]) < 1e-3


def test_a_factor_that_cannot_be_evaluated_changes_nothing() -> None:
    def broken(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array]) -> Array:
        raise ZeroDivisionError("sensor unplugged")

    room = make_room(noise_px=0.5)
    tables, before = tables_of(room, KEYFRAMES), room.initial_poses[KEYFRAMES]
    noise, keys = gtsam.noiseModel.Unit.Create(6), keyframe_keys(np.array([3]))
    tables.own_factors[0] = own_factor(gtsam.CustomFactor(noise, keys, broken))
    with pytest.raises(SolverError, match="sensor unplugged"):
        adjust_jointly(tables, frames_of(room), CAMERA, SmootherConfig())
    np.testing.assert_array_equal(tables.keyframes.values, before)


def test_values_that_are_not_finite_are_refused() -> None:
    room = make_room(noise_px=0.5)
    tables, frames = tables_of(room, KEYFRAMES), frames_of(room)
    frames.poses_world_camera[0] = np.nan
    before = tables.keyframes.values.copy()
    with pytest.raises(SolverError):
        adjust_jointly(tables, frames, CAMERA, SmootherConfig())
    np.testing.assert_array_equal(tables.keyframes.values, before)


def test_frames_do_not_enter_the_graph() -> None:
    room = make_room(noise_px=0.5)
    smoother = Smoother(CAMERA, SmootherConfig())
    for update in room.updates()[:6]:
        smoother.update(update)
    observations = room.observations.select(room.observations.keyframe_ids == 7)
    known = smoother.tables.landmarks.contains(observations.landmark_ids)
    observations = replace(observations.select(known), keyframe_ids=np.zeros(known.sum(), int))
    adjust_jointly(
        smoother.tables, Frames(room.initial_poses[[7]], observations), CAMERA, SmootherConfig()
    )
    smoother.restart()
    estimate = smoother.update(GraphUpdate())
    assert len(estimate.keyframe_ids) == 6
