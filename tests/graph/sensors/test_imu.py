"""An IMU's factors: zero at the truth with lever and bias, honest covariances, a good beginning."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import gtsam
import numpy as np
import pytest

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse, make_pose, se3_log, so3_exp
from bmask_slam.graph.inertial.preintegration import (
    inertial_graph,
    insert_states,
    moved,
    pose_key,
    predicted,
)
from bmask_slam.graph.inertial.tables import (
    InertialFactor,
    InertialState,
    InertialTables,
    InertialUpdate,
    read_inertial,
)
from bmask_slam.graph.sensors.imu import ImuConfig, begin, readings_between
from bmask_slam.graph.sensors.streams import Measurements, SensorStreams, read_measurements
from bmask_slam.rendering.sensors import imu

MOUNTING = (0.2, -0.1, 0.05, 0.5, -0.5, 0.5, -0.5)
QUIET = dict.fromkeys([f for f in vars(ImuConfig()) if f.startswith("sigma")], 0.0)
CONFIG = ImuConfig(imu_in_camera=MOUNTING)
HERTZ = 200.0
R_WORLD_RENDERED = so3_exp(np.array([1.2, 0.7, -0.4]))
"""The world is not upright."""


def path(seconds: float) -> Array:
    """Poses (N, 4, 4) of a camera at 200 Hz that swings and turns, in a world with z up."""
    t = np.arange(int(seconds * HERTZ) + 1)[:, None] / HERTZ
    p = 0.5 * np.sin(t * [1.3, 0.9, 1.7] + [0.1, 0.4, 0.9])
    return make_pose(so3_exp(0.6 * np.sin(t * [0.8, 1.5, 1.1] + [1.0, 0.2, 0.5])), p)


POSES = path(6.0)
TILTED = make_pose(R_WORLD_RENDERED, np.array([4.0, 5.0, 6.0])) @ POSES
DOWN = R_WORLD_RENDERED @ [0.0, 0.0, -1.0]
BIAS = np.array([0.2, -0.3, 0.1, 0.03, -0.02, 0.04])


def stream(bias: Array | None = None) -> SensorStreams:
    rows = imu(POSES, HERTZ, replace(CONFIG, **QUIET), np.random.default_rng(1))
    if bias is not None:
        rows[:, 1:4] += bias[3:]
        rows[:, 4:7] += bias[:3]
    found = SensorStreams()
    found.add(Measurements("imu", rows))
    return found


def velocity(k: int) -> Array:
    return (TILTED[k + 1, :3, 3] - TILTED[k - 1, :3, 3]) * HERTZ / 2


def between(i: int, j: int, streams: SensorStreams) -> Array:
    found = readings_between(streams, i / HERTZ, j / HERTZ, CONFIG)
    assert found is not None
    return found


def test_prediction_follows_the_camera_with_lever_bias_and_gravity() -> None:
    """A wrong frame, sign or unit of any of them moves the end by centimetres."""
    factor = InertialFactor(3, 7, 0, between(100, 500, stream(BIAS)), CONFIG.model)
    state = np.concatenate([velocity(100), BIAS])
    T, end = predicted(TILTED[100], state, DOWN, factor)
    off = se3_log(inverse(TILTED[500]) @ T)
    assert np.abs(off[:3]).max() < 1e-3
    assert np.abs(off[3:]).max() < 4e-3
    np.testing.assert_allclose(end[:3], velocity(500), atol=4e-3)
    upside_down, _ = predicted(TILTED[100], state, -DOWN, factor)
    assert np.linalg.norm((inverse(TILTED[500]) @ upside_down)[:3, 3]) > 10


def test_a_factor_is_zero_at_the_truth_and_its_covariance_is_that_of_its_errors() -> None:
    """NEES of 100 drawn IMUs: 9 degrees of freedom each, those of motion; biases are zero."""
    i, j, errors = 200, 400, []
    noise = replace(CONFIG, sigma_gyroscope_bias=0.0, sigma_accelerometer_bias=0.0)
    for seed in range(100):
        rows = imu(POSES, HERTZ, noise, np.random.default_rng(seed))
        streams = SensorStreams()
        streams.add(Measurements("imu", rows))
        errors.append(2 * tables_of(between(i, j, streams), i, j).error(truth(i, j)))
    assert 8.17 < np.mean(errors) < 9.83  # chi-square of 900 degrees over 100, 95 %
    exact = 2 * tables_of(between(i, j, stream()), i, j).error(truth(i, j))
    assert exact < 0.5


def tables_of(readings: Array, i: int, j: int) -> gtsam.NonlinearFactor:
    tables = InertialTables()
    factor = InertialFactor(1, 2, 0, readings, CONFIG.model)
    states = {1: np.r_[velocity(i), np.zeros(6)], 2: np.r_[velocity(j), np.zeros(6)]}
    tables.add(InertialUpdate((factor,), states=states, down={0: DOWN}))
    factors, _ = inertial_graph(tables)
    return factors[0]


def truth(i: int, j: int) -> gtsam.Values:
    tables = InertialTables()
    factor = InertialFactor(1, 2, 0, np.zeros((1, 10)), CONFIG.model)
    states = {1: np.r_[velocity(i), np.zeros(6)], 2: np.r_[velocity(j), np.zeros(6)]}
    tables.add(InertialUpdate((factor,), states=states, down={0: DOWN}))
    values = gtsam.Values()
    for key, k in ((1, i), (2, j)):
        values.insert(pose_key(key), gtsam.Pose3(TILTED[k]))
    insert_states(values, tables, replace(tables.change()))
    return values


def test_gravity_velocities_and_the_gyroscopes_bias_are_found_from_keyframes() -> None:
    places = list(range(100, 700, 75))
    gyroscope = np.r_[np.zeros(3), BIAS[3:]]
    readings = [between(i, j, stream(gyroscope)) for i, j in pairwise(places)]
    found = begin(TILTED[places], readings, CONFIG)
    assert found is not None
    np.testing.assert_allclose(found.down, DOWN, atol=2e-3)
    np.testing.assert_allclose(found.states[:, :3], [velocity(k) for k in places], atol=0.02)
    np.testing.assert_allclose(found.states[:, 6:], np.tile(BIAS[3:], (len(places), 1)), atol=2e-3)
    assert begin(TILTED[places], [r * 2 for r in readings], CONFIG) is None


def test_a_blackout_is_bridged_from_the_newest_keyframe() -> None:
    streams, k = stream(BIAS), 300
    R = TILTED[k, :3, :3].T
    state = InertialState(4, k / HERTZ, R @ velocity(k), R @ DOWN, BIAS)
    for before, readings in ((None, between(300, 500, streams)),):
        T, covariance = moved(state, before, readings, CONFIG.model)
        off = se3_log(inverse(TILTED[500]) @ TILTED[300] @ T)
        assert np.abs(off).max() < 4e-3
        assert np.linalg.eigvalsh(covariance)[0] > 0
    T, _ = moved(state, between(300, 360, streams), between(360, 500, streams), CONFIG.model)
    assert np.abs(se3_log(inverse(TILTED[500]) @ TILTED[360] @ T)).max() < 4e-3


def test_readings_are_cut_to_any_times_and_a_gap_says_nothing() -> None:
    rows = stream().of("imu")
    found = readings_between(stream(), 0.5012, 0.9987, CONFIG)
    assert found is not None
    assert found[:, 0].sum() == pytest.approx(0.4975)
    holed = SensorStreams()
    holed.add(Measurements("imu", np.delete(rows, slice(120, 140), axis=0)))
    assert readings_between(holed, 0.5, 1.0, CONFIG) is None
    assert readings_between(holed, 5.9, 6.01, CONFIG) is None
    assert readings_between(holed, 5.9, 6.01, CONFIG, 0.05) is not None
    late = readings_between(stream(), 0.5, 1.0, replace(CONFIG, delay_s=0.1))
    assert late is not None
    np.testing.assert_allclose(late, between(120, 220, stream()), atol=1e-9)


def test_tables_are_the_same_after_a_file_and_broken_ones_are_refused() -> None:
    tables = InertialTables()
    readings = between(100, 110, stream())
    factors = tuple(InertialFactor(a, a + 1, 2, readings, CONFIG.model) for a in (4, 5))
    states = {k: np.full(9, float(k)) for k in (4, 5, 6)}
    tables.add(InertialUpdate(factors, states=states, down={2: DOWN}))
    arrays = tables.arrays()
    again = read_inertial(arrays, np.array([4, 5, 6]))
    for name, array in again.arrays().items():
        np.testing.assert_array_equal(array, arrays[name], name)
    assert not read_inertial({}, np.array([4])).arrays()
    with pytest.raises(ValueError, match="unknown keyframes"):
        read_inertial(arrays, np.array([4, 5]))
    with pytest.raises(ValueError, match="do not fit their readings"):
        read_inertial({**arrays, "imu_readings": readings}, np.array([4, 5, 6]))
    overflowing = {**arrays, "imu_factors": np.tile(arrays["imu_factors"][:1], (4, 1))}
    overflowing["imu_factors"][:, 3] = 2**62, 2**62, 2**62, 2**62 + len(arrays["imu_readings"])
    with pytest.raises(ValueError, match="do not fit their readings"):
        read_inertial(overflowing, np.array([4, 5, 6]))


def test_the_file_has_eurocs_columns_and_nanoseconds(tmp_path: Path) -> None:
    file = tmp_path / "imu.csv"
    file.write_text("#timestamp [ns],w,w,w,a,a,a\n1500000000,1,2,3,4,5,6\n1505000000,1,2,3,4,5,6\n")
    rows = read_measurements(file, "imu").rows
    np.testing.assert_allclose(rows[:, 0], [1.5, 1.505])
    np.testing.assert_array_equal(rows[0, 1:], [1, 2, 3, 4, 5, 6])
    file.write_text("1.5,1,2,3,4,5,6\n1.505,1,2,3,4,5,6\n1.51,1,2,3,4,5,6\n")
    with pytest.raises(InputError, match="not in nanoseconds"):
        read_measurements(file, "imu")
