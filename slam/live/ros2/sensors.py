"""Sensors beside the camera from running topics, and their mountings by tf."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse, quaternion_from_rotation
from bmask_slam.graph.sensors.config import SensorsConfig
from bmask_slam.graph.sensors.odometry import interpolated
from bmask_slam.graph.sensors.streams import Measurements, measurements
from bmask_slam.live.ros2.transport import SENSOR, Node, Reader
from bmask_slam.sequences.bags.ros_images import stamp_s
from bmask_slam.sequences.bags.sensors import (
    FIX,
    ODOMETRY,
    TYPES,
    SensorTopics,
    east_north_up,
    sensor_row,
)

logger = logging.getLogger(__name__)

KEPT = 4000
"""Messages of a sensor that wait to be read: ten seconds of an IMU at 400 Hz."""
FAR_S = 10.0
"""A stamp farther than that from the newest image's is of another clock, and refused."""
RECENT = 400
"""Poses of odometry that are kept to know where the base was at an image's time."""
MAX_BEYOND_S = 0.1
"""Odometry is extrapolated for so long."""
_POLL_S = 0.02
_FIRST_S = 2.0
"""Wait for a sensor's first message, which names its frame."""
_MOUNTINGS = {
    "imu": "imu_in_camera",
    "odometry": "camera_in_base",
    "accelerometer": "accelerometer_in_camera",
    "position": "antenna_in_camera",
}


@dataclass
class _Topic:
    """A sensor's topic, its reader, the last stamp that was used, and the first satellite fix.

    ``broken``: messages so far that could not be decoded. ``measures``: it is handed on; else it
    only says where the base is.
    """

    sensor: str
    name: str
    kind: str
    reader: Reader
    last_s: float = -np.inf
    frame: str = ""
    origin: Array | None = None
    measures: bool = True
    broken: int = 0


@dataclass(frozen=True)
class ImageClock:
    """The images' time: the newest stamp, and the shift since their clock was last set back."""

    latest_s: float
    shift_s: float


class Ros2Sensors:
    """Receives what sensors measure.

    Attributes:
        broken: messages that were no measurement.
        late: measurements that were not later than the one before, or of another clock.
    """

    def __init__(self, node: Node, wanted: SensorTopics, silence_s: float) -> None:
        """Wait until each topic that is named has a publisher.

        Raises:
            InputError: one has none for ``silence_s``, or one of another type.
        """
        self.broken = self.late = 0
        self._node = node
        self._recent = np.zeros((0, 8))
        end_s = time.monotonic() + silence_s
        self._topics = [
            self._topic(sensor, name, end_s) for sensor, name in asdict(wanted).items() if name
        ]
        self._early: dict[str, list[Any]] = {}

    def _topic(self, sensor: str, name: str, end_s: float) -> _Topic:
        while (kind := self._node.published().get(name)) is None and time.monotonic() < end_s:
            time.sleep(_POLL_S)
        if kind not in TYPES[sensor]:
            published = self._node.published().items()
            has = ", ".join(topic for topic, other in published if other in TYPES[sensor])
            raise InputError(
                f"ros2: no {' or '.join(TYPES[sensor])} on {name} for --{sensor}-topic; there is "
                f"{has or 'none'}"
            )
        reader = self._node.reader(name, kind, SENSOR._replace(depth=KEPT))
        return _Topic(sensor, name, kind, reader)

    @property
    def names(self) -> tuple[str, ...]:
        """The sensors that measure."""
        return tuple(topic.sensor for topic in self._topics if topic.measures)

    @property
    def has_odometry(self) -> bool:
        """Whether ``T_odom_base`` may be known."""
        return any(topic.sensor == "odometry" for topic in self._topics)

    def add_odometry(self, name: str, reader: Reader, measures: bool) -> None:
        """Hear nav_msgs/Odometry by another reader.

        Without ``measures`` it only says where the base is.
        """
        self._topics.append(_Topic("odometry", name, ODOMETRY, reader, measures=measures))

    def frames(self) -> dict[str, str]:
        """The frame of each sensor by its first message, which is waited for; "" if it has none."""
        end_s = time.monotonic() + _FIRST_S
        for topic in self._topics:
            early = self._early.setdefault(topic.sensor, [])
            while not early and time.monotonic() < end_s:
                early += topic.reader.take(KEPT)
                time.sleep(0 if early else _POLL_S)
            if early:
                is_base = topic.sensor == "odometry" and hasattr(early[0], "child_frame_id")
                topic.frame = early[0].child_frame_id if is_base else early[0].header.frame_id
        return {topic.sensor: topic.frame for topic in self._topics if topic.measures}

    def take(self, clock: ImageClock) -> list[Measurements]:
        """What was measured since the last call, on the images' clock; what is late is counted."""
        found = []
        for topic in self._topics:
            rows = []
            for message in [*self._early.pop(topic.sensor, ()), *topic.reader.take(KEPT)]:
                row = self._row(topic, message, clock)
                if row is not None:
                    rows.append(row)
            self.broken += topic.reader.broken - topic.broken
            topic.broken = topic.reader.broken
            if rows and topic.sensor == "odometry":
                self._recent = np.concatenate([self._recent, rows])[-RECENT:]
            if rows and topic.measures:
                found.append(Measurements(topic.sensor, np.array(rows)))
        return found

    def _row(self, topic: _Topic, message: Any, clock: ImageClock) -> Array | None:
        """A checked measurement, None for one that is late or no measurement."""
        time_s = stamp_s(message.header) + clock.shift_s
        if time_s <= topic.last_s or abs(time_s - clock.latest_s) > FAR_S:
            if not self.late:
                logger.warning(
                    "%s: a measurement at %.3f s is late or of another clock (images: %.3f s); "
                    "such are counted in health.json", topic.name, time_s, clock.latest_s,
                )  # fmt: skip
            self.late += 1
            return None
        values = np.array(sensor_row(topic.sensor, message, topic.kind), float)
        try:
            if topic.kind == FIX and np.isfinite(values[:3]).all():
                topic.origin = values[None, :3].copy() if topic.origin is None else topic.origin
                values[:3] = east_north_up(np.vstack([topic.origin, values[:3]]))[1]
            row = measurements(topic.sensor, [[time_s, *values]], topic.name).rows[0]
        except InputError as error:
            if not self.broken:
                logger.warning("%s; such are counted in health.json", error)
            self.broken += 1
            return None
        topic.last_s = time_s
        return row

    def T_odom_base(self, time_s: float) -> Array | None:
        """The base's pose (4, 4) by odometry at an image's time; None if that is not covered."""
        recent = self._recent  # the thread that receives puts another one in its place
        stamps = recent[:, 0]
        if len(stamps) < 2 or not stamps[0] <= time_s <= stamps[-1] + MAX_BEYOND_S:
            return None
        near = max(int(np.searchsorted(stamps, time_s)), 1)
        rows = recent[min(near, len(stamps) - 1) - 1 :][:2]
        return np.asarray(interpolated(rows, np.array([time_s]))[0])


def mounted(
    config: SensorsConfig, frames: dict[str, str], T_camera: Callable[[str], Array | None]
) -> SensorsConfig:
    """The settings, in which sensors whose mounting is the default get that of tf.

    Args:
        frames: of sensors by name; "" where it is not known.
        T_camera: gives T_camera_frame (4, 4) of a frame, None where it is not known.
    """
    usual = SensorsConfig()
    for sensor, frame in frames.items():
        name, section = _MOUNTINGS[sensor], getattr(config, sensor)
        if getattr(section, name) != getattr(getattr(usual, sensor), name):
            continue
        T = T_camera(frame) if frame else None
        if T is None:
            logger.warning(
                "%s: tf does not say where its frame %r is; the mounting is sensors.%s.%s",
                sensor, frame, sensor, name,
            )  # fmt: skip
            continue
        place = mounting_of(inverse(T) if sensor == "odometry" else T)
        if sensor == "position":
            place = place[:3]
        logger.info("%s: by tf, sensors.%s.%s=%s", sensor, sensor, name, list(place))
        config = replace(config, **{sensor: replace(section, **{name: place})})
    return config


def mounting_of(T: Array) -> Sequence[float]:
    """A pose (4, 4) as x y z qx qy qz qw."""
    return tuple(map(float, (*T[:3, 3], *quaternion_from_rotation(T[:3, :3]))))
