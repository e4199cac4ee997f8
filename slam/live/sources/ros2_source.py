"""Frames from the topics of a running ROS 2, received over DDS without ROS."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, cast

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse
from bmask_slam.graph.sensors.config import SensorsConfig
from bmask_slam.graph.sensors.streams import Measurements
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.live.ros2.outputs import Ros2Frames
from bmask_slam.live.ros2.sensors import ImageClock, Ros2Sensors, mounted
from bmask_slam.live.ros2.tf import TF, RobotFrames
from bmask_slam.live.ros2.transport import LATCHED, SENSOR, STATE, Node, Quality, Reader
from bmask_slam.live.sources.message_frames import message_frames
from bmask_slam.live.sources.pairing import DEPTH, RGB, Pair, Pairer
from bmask_slam.live.sources.source import MeasuredSource, SourceCounts
from bmask_slam.sequences.bags.bag_file import INFO_TYPE, Bag, Topic
from bmask_slam.sequences.bags.ros_images import stamp_s
from bmask_slam.sequences.bags.sensors import SensorTopics
from bmask_slam.sequences.bags.topics import BagTopics, find_camera, find_topics, first_message
from bmask_slam.sequences.bags.transforms import MAX_STATIC, TRANSFORMS
from bmask_slam.sequences.frame import Frame

logger = logging.getLogger(__name__)

POLL_S = 0.002
EXPECTED_SHARE = 0.2
"""Of the time that is waited for frames: in so much a topic that has a publisher gives a message,
before the camera is known."""
SENSORS_S = 0.1
"""Longest time that measurements wait for an image to be handed on with."""


class _Heard:
    """What is heard on a domain, as ``topics`` reads a bag: topics, and first messages."""

    def __init__(self, node: Node, name: str, options: Ros2Options) -> None:
        self.path = Path(name)
        self._node, self.expected_s = node, EXPECTED_SHARE * options.silence_s
        self._images = options.image_quality
        self._readers: dict[str, list[Reader]] = {}
        self._messages: dict[str, list[Any]] = {}

    @property
    def topics(self) -> list[Topic]:
        """Those that have a publisher."""
        return sorted(Topic(name, kind, 1) for name, kind in self._node.published().items())

    def messages(self, *names: str) -> Iterator[tuple[str, Any]]:
        """The messages so far, after a wait for the first; none of what nobody publishes."""
        kinds = self._node.published()
        for name in names:
            if name in kinds:
                yield from ((name, message) for message in self._received(name, kinds[name]))

    def keep(self, name: str) -> None:
        """Receive only one topic from now on."""
        self._readers = {n: readers for n, readers in self._readers.items() if n == name}

    def static(self) -> Iterator[Any]:
        """The messages of /tf_static so far, after a wait for the first."""
        received = (message for _, message in islice(self.messages(TRANSFORMS), MAX_STATIC))
        return (message for message in received if hasattr(message, "transforms"))

    def _received(self, name: str, kind: str) -> list[Any]:
        if name not in self._readers:
            quality = LATCHED._replace(depth=100)
            both = {TRANSFORMS: (quality,), INFO_TYPE: (SENSOR, quality)}  # some send it once
            chosen = both.get(name) or both.get(kind, (self._images,))
            self._readers[name] = [self._node.reader(name, kind, q) for q in chosen]
        kept = self._messages.setdefault(name, [])
        kept += self._taken(name) if name == TRANSFORMS else ()
        end_s = time.monotonic() + self.expected_s
        while not kept and time.monotonic() < end_s:
            kept += self._taken(name)
            time.sleep(POLL_S)
        return kept

    def _taken(self, name: str) -> list[Any]:
        return [message for reader in self._readers[name] for message in reader.take()]


@dataclass(frozen=True)
class Ros2Options:
    """What is received from ROS 2, and how.

    Attributes:
        topics: of the images; those that are empty are of a known camera.
        sensors: topics of the sensors beside the camera.
        camera: camera file in place of the camera_info.
        silence_s: how long is waited for publishers, and for frames.
        reliable: images that are lost are sent again.
    """

    topics: BagTopics = field(default_factory=BagTopics)
    sensors: SensorTopics = field(default_factory=SensorTopics)
    camera: Path | None = None
    silence_s: float = 10.0
    reliable: bool = False

    @property
    def image_quality(self) -> Quality:
        """Quality of service with which images are received."""
        return STATE if self.reliable else SENSOR


class Ros2Source(MeasuredSource):
    """Colour and depth images of a ROS 2 domain, paired by the stamps in their headers.

    A publisher may stop and start again; the topics are those of a known camera, or given.

    Attributes:
        counts: images that did not become frames so far, and measurements that were refused.
        node: the participant, also for what is published.
        sensors: what is measured beside the camera.
        deliver: called with measurements, in the thread that iterates over ``frames``, before the
            frames that came with them.
    """

    pairs, waits = True, False

    def __init__(self, node: Node, name: str, options: Ros2Options) -> None:
        """Wait until somebody publishes the images and their camera, and the sensors' topics.

        ``name``, such as ros2:0, is for messages and the run folder.

        Raises:
            InputError: nobody does for ``silence_s``, or the camera cannot be used.
        """
        self.name = name.replace(":", "-").removesuffix("-0").strip("-")
        self.groundtruth: Trajectory | None = None
        self.counts = SourceCounts()
        self.node = node
        self.deliver: Callable[[Measurements], None] = lambda _: None
        self._silence_s = options.silence_s
        self._closed, self._played = threading.Event(), 0
        self._where = name
        self._heard = _Heard(self.node, self._where, options)
        heard = cast("Bag", self._heard)
        self._topics = self._wait_for_topics(heard, options.topics)
        self._found = find_camera(heard, self._topics, options.camera)
        self.camera = self._found.camera
        self._frame = first_message(heard, self._topics.rgb).header.frame_id.lstrip("/")
        self._heard.keep(TRANSFORMS)
        self._robot = RobotFrames(self.node, name, self._heard.static)
        self._pairer = Pairer[Any](self.counts, lambda: self.camera.depth_time_offset_s)
        kinds, quality = self.node.published(), options.image_quality
        names = (self._topics.rgb, self._topics.depth)
        self._readers = [self.node.reader(name, kinds[name], quality) for name in names]
        self.sensors = Ros2Sensors(self.node, options.sensors, options.silence_s)
        self._handed_s, self._to_say = 0.0, ""
        logger.info("%s: colour on %s, depth on %s", self._where, *names)

    def mounted(self, config: SensorsConfig, frames: Ros2Frames) -> SensorsConfig:
        """The settings, with the mountings of tf where they are left at the default.

        Where no topic of odometry is named and somebody publishes the base in ``odom`` on /tf,
        that is odometry.

        Raises:
            InputError: a sensor is heard that is not enabled.
        """
        given = frames.T_base_camera

        def T_camera(frame: str) -> Array | None:
            if given is not None and frame.lstrip("/") == frames.base.lstrip("/"):
                return inverse(given)
            return self.T_camera(frame)

        if not self.sensors.has_odometry:
            self._hear_odometry(config, frames, T_camera)
        for name in self.sensors.names:
            config.check_enabled(name)
        return mounted(config, self.sensors.frames(), T_camera)

    def _hear_odometry(
        self, config: SensorsConfig, frames: Ros2Frames, T_camera: Callable[[str], Array | None]
    ) -> None:
        """Hear odometry of /tf, if there is any; it is used if the camera's place is known."""
        found = self._robot.odometry(frames.odom, frames.base, self._heard.expected_s)
        if found is None:
            return
        own = config.odometry
        is_set = own.camera_in_base != SensorsConfig().odometry.camera_in_base
        use = own.enabled and (is_set or T_camera(frames.base) is not None)
        why = "nothing says where the camera is" if own.enabled else "odometry is not enabled"
        self._to_say = (
            f"{self._where}: /tf has {frames.odom} -> {frames.base}, which is not published, and "
            + ("used as odometry" if use else f"not used as odometry: {why}")
        )
        self.sensors.add_odometry(TF, found, use)

    def T_camera(self, frame: str) -> Array | None:
        """T_camera_frame (4, 4) of the colour camera by tf; None where it does not say."""
        if self._frame == frame.lstrip("/"):
            return np.eye(4)
        return self._robot.mounting(self._frame, frame, self._heard.expected_s)

    def T_base_camera(self, base: str) -> Array | None:
        """(4, 4) by tf; None where it does not say."""
        T = self.T_camera(base)
        return None if T is None else inverse(T)

    def ros_time(self, time_s: float) -> float:
        """The stamp that an image had, whose clock may have been set back since."""
        return self._pairer.clock.original(time_s)

    def frames(self) -> Iterator[Frame]:
        """A frame of each pair of images.

        Raises:
            InputError: none came for ``silence_s``.
        """
        names = (self._where,) * 3
        return message_frames(self._pairs(), lambda: self.camera, self._found, self.counts, names)

    def close(self) -> None:
        """End ``frames`` soon; may be called from any thread."""
        self._closed.set()

    def _pairs(self) -> Iterator[Pair[Any]]:
        pairer = self._pairer
        self._played += 1  # what iterated before ends
        mine = self._played
        heard_s = time.monotonic()
        broken = 0
        while not self._closed.is_set() and mine == self._played:
            found = []
            for stream, reader in ((RGB, self._readers[0]), (DEPTH, self._readers[1])):
                for message in reader.take():
                    found += pairer.add(stream, stamp_s(message.header), message)
            self.counts.broken += sum(reader.broken for reader in self._readers) - broken
            broken = sum(reader.broken for reader in self._readers)
            self._hand_on(bool(found))
            if found:
                heard_s = time.monotonic()
                yield from found
            elif time.monotonic() - heard_s > self._silence_s:
                raise InputError(
                    f"{self._where}: no frame for {self._silence_s:g} s; does {self._topics.rgb} "
                    "still have a publisher?"
                )
            else:
                self._closed.wait(POLL_S)
        if mine == self._played:
            yield from pairer.finish()

    def _hand_on(self, at_once: bool) -> None:
        """Hand on what was measured: before frames, else from time to time."""
        now_s, clock = time.monotonic(), self._pairer.clock
        due = at_once or now_s > self._handed_s + SENSORS_S
        if not due or not np.isfinite(clock.latest_s):
            return
        self._handed_s = now_s
        if self._to_say:  # now the run's log is open
            logger.info(self._to_say)
            self._to_say = ""
        self._robot.hear()
        for measured in self.sensors.take(ImageClock(clock.latest_s, clock.shift_s)):
            self.deliver(measured)
        self.counts.late_measurements = self.sensors.late
        self.counts.broken_measurements = self.sensors.broken

    def _wait_for_topics(self, heard: Any, topics: BagTopics) -> BagTopics:
        """The topics of the images and the camera_info, once they are published."""
        end_s = time.monotonic() + self._silence_s
        while True:
            try:
                found = find_topics(heard, topics)
                if self.node.published().get(found.camera_info) == INFO_TYPE:
                    return found
                if time.monotonic() > end_s:
                    return found  # what is missing is said where the camera is looked for
            except InputError:
                if time.monotonic() > end_s:
                    raise
            time.sleep(10 * POLL_S)
