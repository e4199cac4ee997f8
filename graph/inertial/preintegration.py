"""Inertial factors in GTSAM: preintegrated readings, their variables, and prediction.

The body is the camera, T_camera_imu GTSAM's ``body_P_sensor``. Factor and covariance: Forster et
al. 2017, "On-Manifold Preintegration for Real-Time Visual-Inertial Odometry", with random walks of
the biases (``CombinedImuFactor``); gravity is a direction of its own, since the world is that of
the first camera (``CombinedImuFactorWithGravityDirection``).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Protocol

import gtsam
import numpy as np

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.geometry import so3_exp
from bmask_slam.graph.inertial.tables import (
    BIAS,
    GRAVITY,
    ImuModel,
    InertialChange,
    InertialFactor,
    InertialState,
    InertialTables,
    Name,
)

_INTEGRATION = 1e-8
"""Variance of GTSAM's integration of a second, m^2."""
_RATE, _SPEED, _FORCE = 0.002, 0.02, 0.05
"""By how much a graph's rates (rad/s), velocities (m/s) and forces (m/s^2, with tilt) are wrong."""
_DOWN_RAD = 10.0
"""Sigma of the prior on the direction of gravity, which is there for the numbers only."""


class Poses(Protocol):
    """The keyframes' poses."""

    def get(self, ids: Ints) -> Array:
        """T_world_camera (N, 4, 4) of keyframes (N,)."""


def bias_key(keyframe: int) -> int:
    """The key of a keyframe's biases."""
    return int(gtsam.symbol("b", keyframe))


def velocity_key(keyframe: int) -> int:
    """The key of a keyframe's velocity."""
    return int(gtsam.symbol("v", keyframe))


def gravity_key(segment: int) -> int:
    """The key of a segment's direction of gravity."""
    return int(gtsam.symbol("g", segment))


def pose_key(keyframe: int) -> int:
    """The key of a keyframe's pose."""
    return int(gtsam.symbol("x", keyframe))


def preintegrated(
    readings: Array, bias: Array, model: ImuModel, down: Array | None = None
) -> gtsam.PreintegratedCombinedMeasurements:
    """Readings (N, 10) as one measurement, at a bias (6,); ``down`` (3,) for prediction alone.

    GTSAM takes the centripetal acceleration of a lever arm from the force; that of the turn's
    acceleration, ``alpha x r``, is taken from it here, r being the lever in the IMU's frame. GTSAM
    applies a force in the frame where its interval begins: a mean is of the middle.
    """
    gravity = model.gravity_m_s2 * (np.array([0.0, 0.0, -1.0]) if down is None else down)
    parameters = gtsam.PreintegrationCombinedParams(gravity)
    eye = np.eye(3)
    parameters.setGyroscopeCovariance(model.gyroscope**2 * eye)
    parameters.setAccelerometerCovariance(model.accelerometer**2 * eye)
    parameters.setBiasOmegaCovariance(model.gyroscope_walk**2 * eye)
    parameters.setBiasAccCovariance(model.accelerometer_walk**2 * eye)
    parameters.setIntegrationCovariance(_INTEGRATION * eye)
    parameters.setBodyPSensor(gtsam.Pose3(model.T_camera_imu))
    found = gtsam.PreintegratedCombinedMeasurements(parameters, _bias(bias))
    lever = model.T_camera_imu[:3, :3].T @ model.T_camera_imu[:3, 3]
    force = readings[:, 1:4] - np.cross(readings[:, 7:10], lever)
    half = so3_exp((readings[:, 4:7] - bias[3:]) * readings[:, :1] / 2)
    force = (half @ force[:, :, None])[:, :, 0]
    for f, rate, seconds in zip(force, readings[:, 4:7], readings[:, 0].tolist(), strict=True):
        found.integrateMeasurement(f, rate, seconds)
    return found


def predicted(
    T_world_a: Array, state: Array, down: Array, factor: InertialFactor
) -> tuple[Array, Array]:
    """T_world_b (4, 4) and the state (9,) of keyframe b by those of a."""
    measured = preintegrated(factor.readings, state[3:], factor.model, down)
    begin = gtsam.NavState(gtsam.Pose3(T_world_a), state[:3])
    end = measured.predict(begin, _bias(state[3:]))
    return end.pose().matrix(), np.concatenate([end.velocity(), state[3:]])


def predict_new_states(tables: InertialTables, keyframes: Poses) -> None:
    """Give the keyframes that are new in a chain the state that it leads to."""
    for (a, b), factor in sorted(tables.factors.items()):
        if b not in tables.states:
            (T_world_a,) = keyframes.get(np.array([a]))
            down = tables.down[factor.segment]
            tables.states[b] = predicted(T_world_a, tables.states[a], down, factor)[1]


def moved(
    state: InertialState, before: Array | None, readings: Array, model: ImuModel
) -> tuple[Array, Array]:
    """The motion T_b_e (4, 4) over readings (N, 10), and its covariance (6, 6) at e.

    b is the camera after ``before`` (M, 10), the readings since the keyframe of the state; None if
    it is that keyframe. To the readings' noise comes what velocity, tilt and biases are wrong by.
    """
    velocity, down = state.velocity, state.down
    if before is not None:
        measured = preintegrated(before, state.bias, model, down)
        end = measured.predict(gtsam.NavState(gtsam.Pose3(), velocity), _bias(state.bias))
        R_b_k = end.attitude().matrix().T
        velocity, down = R_b_k @ end.velocity(), R_b_k @ down
    measured = preintegrated(readings, state.bias, model, down)
    end = measured.predict(gtsam.NavState(gtsam.Pose3(), velocity), _bias(state.bias))
    T = end.pose().matrix()
    seconds = readings[:, 0].sum()
    turn_rad, shift_m = _RATE * seconds, _SPEED * seconds + _FORCE * seconds**2 / 2
    covariance = measured.preintMeasCov()[:6, :6]
    covariance += np.diag([turn_rad**2] * 3 + [shift_m**2] * 3)
    to_e = np.kron(np.eye(2), T[:3, :3].T)
    return T, to_e @ covariance @ to_e.T


def inertial_factors(tables: InertialTables, names: Iterable[Name]) -> list[gtsam.NonlinearFactor]:
    """The factors of these names, preintegrated at the present biases."""
    return [_factor(tables, name) for name in names]


def _factor(tables: InertialTables, name: Name) -> gtsam.NonlinearFactor:
    what, a, b = name
    if what == GRAVITY:
        loose = gtsam.noiseModel.Isotropic.Sigma(2, _DOWN_RAD)
        return gtsam.PriorFactorUnit3(gravity_key(a), gtsam.Unit3(tables.down[a]), loose)
    if what == BIAS:
        model = next(f.model for pair, f in sorted(tables.factors.items()) if pair[0] == a)
        sigmas = np.repeat([model.accelerometer_bias, model.gyroscope_bias], 3)
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        return gtsam.PriorFactorConstantBias(bias_key(a), _bias(np.zeros(6)), noise)
    factor = tables.factors[a, b]
    return gtsam.CombinedImuFactorWithGravityDirection(
        *(pose_key(a), velocity_key(a), pose_key(b), velocity_key(b), bias_key(a), bias_key(b)),
        gravity_key(factor.segment),
        preintegrated(factor.readings, tables.states[a][3:], factor.model),
        factor.model.gravity_m_s2,
    )


def insert_states(values: gtsam.Values, tables: InertialTables, change: InertialChange) -> None:
    """Add the variables of a change to values."""
    for k in change.keyframes:
        values.insertPoint3(velocity_key(k), tables.states[k][:3])
        values.insert(bias_key(k), _bias(tables.states[k][3:]))
    for segment in change.segments:
        values.insert(gravity_key(segment), gtsam.Unit3(tables.down[segment]))


def read_states(values: gtsam.Values, tables: InertialTables) -> bool:
    """Take the states and the directions of gravity from values; False if one is not finite."""
    states = {
        k: np.concatenate(
            [values.atPoint3(velocity_key(k)), values.atConstantBias(bias_key(k)).vector()]
        )
        for k in tables.states
    }
    if not all(np.isfinite(state).all() for state in states.values()):
        return False
    tables.states = states
    tables.down = {n: values.atUnit3(gravity_key(n)).point3() for n in tables.down}
    return True


def inertial_graph(tables: InertialTables) -> tuple[list[gtsam.NonlinearFactor], InertialChange]:
    """All factors, and a change with all variables."""
    names = tables.names
    everything = InertialChange(tuple(names), tuple(tables.states), tuple(tables.down))
    return inertial_factors(tables, names), everything


def _bias(bias: Array) -> Any:
    return gtsam.imuBias.ConstantBias(bias[:3], bias[3:])
