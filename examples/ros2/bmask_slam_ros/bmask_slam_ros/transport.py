"""A node of rclpy as bmask_slam's transport: it carries the bytes, and changes nothing in them.

bmask_slam encodes and decodes messages itself; rclpy publishes and receives them serialised.
"""

from __future__ import annotations

import threading
import weakref
from collections import deque
from collections.abc import Iterator
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosidl_runtime_py.utilities import get_message, get_service

from bmask_slam.live.ros2.transport import SENSOR, STATE, Quality, decoded, encoded, typestore

ANSWER_S = 600.0
"""Longest time that a call waits for its answer: a run that is reset is saved before."""


class RclpyWriter:
    """Sends messages of one type on one topic."""

    def __init__(self, name: str, publisher: Any) -> None:
        self._name, self._publisher = name, publisher

    def send(self, message: Any) -> None:
        """Send a message of rosbags' class."""
        if self._publisher is not None:
            self._publisher.publish(encoded(message, self._name))


class RclpyReader:
    """Keeps the newest messages of one topic until they are taken; ``broken``: not decodable."""

    def __init__(self, name: str, depth: int) -> None:
        self.broken = 0
        self.received: deque[bytes] = deque(maxlen=depth)
        self._name = name

    def take(self, most: int = 16) -> Iterator[Any]:
        """What was received since the last call, as rosbags' classes."""
        for _ in range(min(most, len(self.received))):
            message = decoded(self.received.popleft(), self._name)
            if message is None:
                self.broken += 1
            else:
                yield message


class RclpyRequest:
    """A call whose thread waits for the answer; ``message`` has the fields of ROS's request."""

    def __init__(self, message: Any) -> None:
        self.message, self.answer = message, None
        self.answered = threading.Event()

    def reply(self, message: Any) -> None:
        """Answer it, with a message of rosbags' class."""
        self.answer = message
        self.answered.set()


class RclpyService:
    """Keeps calls until they are taken."""

    def __init__(self) -> None:
        self._calls: deque[RclpyRequest] = deque()

    def take(self) -> Iterator[RclpyRequest]:
        """The calls since the last call of this."""
        while self._calls:
            yield self._calls.popleft()

    def called(self, request: Any, response: Any) -> Any:
        """Wait for the answer, in a thread of rclpy's executor."""
        call = RclpyRequest(request)
        self._calls.append(call)
        if call.answered.wait(ANSWER_S) and call.answer is not None:
            response.success, response.message = call.answer.success, call.answer.message
        else:
            response.success, response.message = False, "bmask-slam does not answer"
        return response


class RclpyNode:
    """What bmask_slam asks of a node; an executor must spin it in other threads."""

    def __init__(self, node: Node) -> None:
        self._node, self._group = node, ReentrantCallbackGroup()
        self._published: dict[str, str] = {}

    def published(self) -> dict[str, str]:
        """Message types by the names of the topics that have had a publisher."""
        known = typestore().fielddefs
        for topic, kinds in self._node.get_topic_names_and_types():
            if kinds[0] in known and self._node.count_publishers(topic):
                self._published[topic] = kinds[0]
        return dict(self._published)

    def writer(self, topic: str, name: str, quality: Quality = STATE) -> RclpyWriter:
        """A publisher; of a package that is not installed one that sends nothing."""
        try:
            kind = get_message(name)
        except (ImportError, AttributeError, ValueError) as error:
            self._node.get_logger().warning(f"{topic} is not published: no {name} ({error})")
            return RclpyWriter(name, None)
        return RclpyWriter(name, self._node.create_publisher(kind, topic, _qos(quality)))

    def reader(self, topic: str, name: str, quality: Quality = SENSOR) -> RclpyReader:
        """A subscription, which ends when the reader is dropped."""
        reader = RclpyReader(name, quality.depth)
        subscription = self._node.create_subscription(
            get_message(name),
            topic,
            reader.received.append,
            _qos(quality),
            callback_group=self._group,
            raw=True,
        )
        weakref.finalize(reader, self._node.destroy_subscription, subscription)
        return reader

    def service(self, service: str, name: str) -> RclpyService:
        """Serve a service of std_srvs."""
        made = RclpyService()
        kind = get_service(name)
        self._node.create_service(kind, service, made.called, callback_group=self._group)
        return made


def _qos(quality: Quality) -> QoSProfile:
    reliable, latched = ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL
    return QoSProfile(
        depth=quality.depth,
        reliability=reliable if quality.reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=latched if quality.latched else DurabilityPolicy.VOLATILE,
    )
