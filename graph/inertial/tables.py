"""The inertial part of the graph in numpy: velocities, biases, gravity, and factors by keyframes.

GTSAM's factors are made of these in `graph.inertial.preintegration`. What is in ISAM2 is known by
name: a factor between two keyframes, a prior on the bias where a chain of factors begins, and one
on the direction of gravity in each map segment.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from bmask_slam.graph.arrays import Array, Arrays, Ints
from bmask_slam.graph.files.array_file import split_rows

Name = tuple[str, int, int]
"""("imu", keyframe_a, keyframe_b), ("bias", keyframe, 0) or ("gravity", segment, 0)."""
IMU, BIAS, GRAVITY = "imu", "bias", "gravity"
_REPLACED = "replaced"
"""In ISAM2 still, of two keyframes that have another factor now."""
STATE = 9
"""A keyframe's velocity in the world, m/s, and the biases of its accelerometer, m/s^2, and its
gyroscope, rad/s, in the IMU's frame."""
_MODEL = 7 + 16


@dataclass(frozen=True, eq=False)
class ImuModel:
    """How an IMU is mounted, and its noise; densities as a data sheet gives them.

    Attributes:
        T_camera_imu: (4, 4).
        gyroscope: rad/s/sqrt(Hz). accelerometer: m/s^2/sqrt(Hz).
        gyroscope_walk: rad/s^2/sqrt(Hz), accelerometer_walk: m/s^3/sqrt(Hz), of the biases.
        gyroscope_bias, accelerometer_bias: sigma of a bias that is not known yet, rad/s, m/s^2.
        gravity_m_s2: its size.
    """

    T_camera_imu: Array
    gyroscope: float
    accelerometer: float
    gyroscope_walk: float
    accelerometer_walk: float
    gyroscope_bias: float
    accelerometer_bias: float
    gravity_m_s2: float

    @property
    def numbers(self) -> Array:
        """All of it as (23,), for a file."""
        _, *scalars = vars(self).values()
        return np.concatenate([scalars, self.T_camera_imu.ravel()])

    @classmethod
    def of(cls, numbers: Array) -> ImuModel:
        """The model of ``numbers``."""
        return cls(numbers[7:].reshape(4, 4), *numbers[:7].tolist())


@dataclass(frozen=True, eq=False)
class InertialFactor:
    """What an IMU measured between two keyframes.

    Attributes:
        segment: the map segment, whose gravity it is.
        readings: (N, 10) of N intervals in a row: duration in s, specific force m/s^2 and rate
            rad/s in the IMU's frame, and angular acceleration rad/s^2, each the interval's mean.
    """

    keyframe_a: int
    keyframe_b: int
    segment: int
    readings: Array
    model: ImuModel

    @property
    def name(self) -> Name:
        """What it is known by."""
        return IMU, self.keyframe_a, self.keyframe_b


@dataclass(frozen=True, eq=False)
class InertialState:
    """What is known of a keyframe's motion, in its own camera frame.

    Attributes:
        keyframe: its id. timestamp_s: its time.
        velocity: (3,) m/s. down: (3,) unit vector of gravity.
        bias: (6,) of the accelerometer, m/s^2, and the gyroscope, rad/s.
        mounting: (8,) T_camera_imu in TUM's columns and the delay in s, where they were estimated.
    """

    keyframe: int
    timestamp_s: float
    velocity: Array
    down: Array
    bias: Array
    mounting: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def numbers(self) -> Array:
        """All of it as (14,) or (22,), for a file."""
        motion = (*self.velocity, *self.down, *self.bias)
        return np.array([self.keyframe, self.timestamp_s, *motion, *self.mounting])

    @classmethod
    def of(cls, numbers: Array) -> InertialState:
        """The state of ``numbers``."""
        known = numbers[2:5], numbers[5:8], numbers[8:14], numbers[14:]
        return cls(int(numbers[0]), float(numbers[1]), *known)


@dataclass(frozen=True)
class InertialUpdate:
    """What an update of the graph adds to its inertial part and removes from it.

    Attributes:
        factors: new ones.
        remove: pairs of keyframes whose factors are removed.
        states: (9,) of keyframes, where a chain begins or all begins anew; the states of other new
            keyframes are predicted.
        down: (3,) unit vectors of gravity in the world, by segment.
    """

    factors: tuple[InertialFactor, ...] = ()
    remove: tuple[tuple[int, int], ...] = ()
    states: dict[int, Array] = field(default_factory=dict)
    down: dict[int, Array] = field(default_factory=dict)

    def __len__(self) -> int:
        """How many factors come and go."""
        return len(self.factors) + len(self.remove)

    def __add__(self, more: InertialUpdate) -> InertialUpdate:
        """Both updates, of different segments."""
        return InertialUpdate(
            self.factors + more.factors,
            self.remove + more.remove,
            self.states | more.states,
            self.down | more.down,
        )


@dataclass(frozen=True)
class InertialChange:
    """What ISAM2 is to be told: new factors by name, and the variables that are new."""

    names: tuple[Name, ...] = ()
    keyframes: tuple[int, ...] = ()
    segments: tuple[int, ...] = ()
    removed_slots: tuple[int, ...] = ()


class InertialTables:
    """The inertial factors, states and directions of gravity.

    Attributes:
        factors: by pair of keyframes. states: (9,) by keyframe. down: (3,) by segment.
        slots: in ISAM2, by name.
    """

    def __init__(self) -> None:
        self.factors: dict[tuple[int, int], InertialFactor] = {}
        self.states: dict[int, Array] = {}
        self.down: dict[int, Array] = {}
        self.slots: dict[Name, int] = {}

    def __bool__(self) -> bool:
        return bool(self.factors)

    def add(self, update: InertialUpdate) -> None:
        """Remove and add factors, with the states that are given; one may replace another."""
        for pair in update.remove:
            self.factors.pop(pair, None)
        for factor in update.factors:
            if (slot := self.slots.pop(factor.name, None)) is not None:
                self.slots[_REPLACED, factor.keyframe_a, factor.keyframe_b] = slot
        self.factors |= {(f.keyframe_a, f.keyframe_b): f for f in update.factors}
        self.states |= update.states
        self.down |= update.down

    def prune(self, keyframes: Ints) -> None:
        """Remove the factors of keyframes that are not among these, and variables without one."""
        if not (self.factors or self.states):
            return
        known = set(keyframes.tolist())
        for pair in [pair for pair in self.factors if not known.issuperset(pair)]:
            del self.factors[pair]
        used = {k for pair in self.factors for k in pair}
        self.states = {k: s for k, s in sorted(self.states.items()) if k in used}
        segments = {f.segment for f in self.factors.values()}
        self.down = {n: d for n, d in sorted(self.down.items()) if n in segments}

    @property
    def names(self) -> list[Name]:
        """All factors, with the priors that they need."""
        pairs = sorted(self.factors)
        begins = sorted({a for a, _ in pairs} - {b for _, b in pairs})
        return [
            *((IMU, a, b) for a, b in pairs),
            *((BIAS, k, 0) for k in begins),
            *((GRAVITY, segment, 0) for segment in sorted(self.down)),
        ]

    def change(self) -> InertialChange:
        """What differs from what is in ISAM2; the slots of what goes are forgotten."""
        names, slots = self.names, self.slots
        keyframes = {k for what, *pair in slots if what in (IMU, _REPLACED) for k in pair}
        segments = {segment for what, segment, _ in slots if what == GRAVITY}
        gone = sorted(set(slots) - set(names))
        return InertialChange(
            tuple(name for name in names if name not in slots),
            tuple(k for k in sorted(self.states) if k not in keyframes),
            tuple(n for n in sorted(self.down) if n not in segments),
            tuple(slots.pop(name) for name in gone),
        )

    def arrays(self) -> Arrays:
        """All but the slots as arrays for a file; nothing if there is nothing."""
        if not self:
            return {}
        factors = [self.factors[pair] for pair in sorted(self.factors)]
        columns = [(f.keyframe_a, f.keyframe_b, f.segment, len(f.readings)) for f in factors]
        return {
            "imu_factors": np.array(columns, np.int64),
            "imu_readings": np.concatenate([f.readings for f in factors]),
            "imu_models": np.array([f.model.numbers for f in factors]),
            "imu_keyframes": np.array(list(self.states), np.int64),
            "imu_states": np.array(list(self.states.values())),
            "imu_segments": np.array(list(self.down), np.int64),
            "imu_down": np.array(list(self.down.values())),
        }


def example_arrays() -> Arrays:
    """The arrays of `InertialTables.arrays`, without rows."""
    shapes = {"factors": (4,), "readings": (10,), "models": (_MODEL,), "keyframes": ()}
    shapes |= {"states": (STATE,), "segments": (), "down": (3,)}
    whole = ("factors", "keyframes", "segments")
    return {
        f"imu_{name}": np.zeros((0, *shape), np.int64 if name in whole else float)
        for name, shape in shapes.items()
    }


def read_inertial(arrays: Arrays, keyframes: Ints) -> InertialTables:
    """The tables of ``arrays``, empty without them. Raises ValueError if they do not fit."""
    tables = InertialTables()
    if "imu_factors" not in arrays:
        return tables
    columns, readings = arrays["imu_factors"], arrays["imu_readings"]
    models, counts = arrays["imu_models"], columns[:, 3]
    finite = (readings, models, arrays["imu_states"], arrays["imu_down"])
    longest = counts.max()  # the sum of what is longer than all readings may overflow
    if not 1 <= counts.min() <= longest <= len(readings) == counts.sum():
        raise ValueError("inertial factors do not fit their readings")
    misshapen = models.shape[1] != _MODEL or readings.shape[1] != 10
    if misshapen or not all(np.isfinite(a).all() for a in finite):
        raise ValueError("inertial readings or models are misshapen or not finite")
    parts = split_rows(readings, counts)
    for (a, b, segment, _), part, numbers in zip(columns.tolist(), parts, models, strict=True):
        tables.factors[a, b] = InertialFactor(a, b, segment, part, ImuModel.of(numbers))
    tables.states = _by_id(arrays["imu_keyframes"], arrays["imu_states"].reshape(-1, STATE))
    tables.down = _by_id(arrays["imu_segments"], arrays["imu_down"].reshape(-1, 3))
    ends = {k for pair in tables.factors for k in pair}
    segments = {f.segment for f in tables.factors.values()}
    if ends != tables.states.keys() or segments != tables.down.keys():
        raise ValueError("inertial factors have other variables than there are")
    if not ends.issubset(keyframes.tolist()):
        raise ValueError("inertial factors have unknown keyframes")
    return tables


def _by_id(ids: Iterable, values: Array) -> dict[int, Array]:
    return dict(zip((int(i) for i in ids), values, strict=True))
