"""What carries ROS 2's messages: the protocol of a transport, and the definitions of messages.

The definitions are those of rosbags' typestore, and so are the bytes (CDR), whoever carries them:
`dds.DdsNode` by cyclonedds without ROS, or a node of rclpy (examples/ros2/bmask_slam_ros).
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from functools import cache
from typing import Any, NamedTuple, Protocol

from bmask_slam.graph.extras import import_extra

SOURCE = "ros2:"
_BROKEN = (ValueError, AssertionError, LookupError, TypeError, struct.error, MemoryError)
_EMPTY = "uint8 structure_needs_at_least_one_member"
_SUCCESS = "bool success\nstring message"
MORE_TYPES = {
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score",
    "vision_msgs/msg/ObjectHypothesisWithPose":
        "ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose",
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "vision_msgs/msg/Detection3D":
        "std_msgs/Header header\nObjectHypothesisWithPose[] results\nBoundingBox3D bbox\nstring id",
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nDetection3D[] detections",
    "std_srvs/srv/Trigger_Request": _EMPTY,
    "std_srvs/srv/Trigger_Response": _SUCCESS,
    "std_srvs/srv/SetBool_Request": "bool data",
    "std_srvs/srv/SetBool_Response": _SUCCESS,
}  # fmt: skip
"""Fields of messages that rosbags does not have, as of vision_msgs 4 (Humble and later)."""


@cache
def typestore() -> Any:
    """The definitions of ROS 2 Humble's messages, which later ROS 2 shares, and of MORE_TYPES."""
    typesys = import_extra("rosbags.typesys", SOURCE, "ros2")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    for name, text in MORE_TYPES.items():
        (fields,) = typesys.get_types_from_msg(text, name).values()
        store.register({name: fields})  # of services, rosbags would change the name
    return store


def encoded(message: Any, name: str) -> bytes:
    """The bytes of a message of rosbags' class, CDR with its header of four bytes."""
    return bytes(typestore().serialize_cdr(message, name))


def decoded(data: bytes, name: str) -> Any | None:
    """The message of received bytes, None for bytes that are none of its type."""
    broken = import_extra("rosbags.serde", SOURCE, "ros2").SerdeError
    try:
        return typestore().deserialize_cdr(data, name)
    except (broken, *_BROKEN):
        return None


class Quality(NamedTuple):
    """Quality of service of a topic.

    Attributes:
        reliable: what is lost is sent again; else best effort, as ROS has for sensors.
        latched: who joins later gets the last message (transient local).
        depth: messages that are kept for a slow reader.
    """

    reliable: bool = False
    latched: bool = False
    depth: int = 5


SENSOR, STATE, LATCHED = Quality(), Quality(True, depth=10), Quality(True, True, 1)


class Writer(Protocol):
    """Sends messages of one type on one topic."""

    def send(self, message: Any) -> None:
        """Send a message of rosbags' class."""


class Reader(Protocol):
    """Receives messages of one type on one topic.

    Attributes:
        broken: messages that could not be decoded.
    """

    broken: int

    def take(self, most: int = 16) -> Iterable[Any]:
        """What was received since the last call, as rosbags' classes."""


class Request(Protocol):
    """One call of a service.

    Attributes:
        message: what was asked, of rosbags' class.
    """

    message: Any

    def reply(self, message: Any) -> None:
        """Answer it, once, with a message of rosbags' class."""


class Service(Protocol):
    """The serving end of a service."""

    def take(self) -> Iterable[Request]:
        """The calls since the last call of this."""


class Node(Protocol):
    """Takes part in ROS 2; types have names such as sensor_msgs/msg/Image."""

    def published(self) -> dict[str, str]:
        """Message types by the names of the topics that have had a publisher."""

    def writer(self, topic: str, name: str, quality: Quality = STATE) -> Writer:
        """A publisher of messages of a type."""

    def reader(self, topic: str, name: str, quality: Quality = SENSOR) -> Reader:
        """A subscription; one of best effort hears reliable publishers too."""

    def service(self, service: str, name: str) -> Service:
        """Serve a service of a type such as std_srvs/srv/Trigger."""
