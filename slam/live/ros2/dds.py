"""ROS 2's wire: DDS topics of ROS names and types, whose messages are CDR as ROS 2 has it.

The definitions of messages are those of rosbags' typestore, and so are their bytes: cyclonedds
carries them. It knows the types by structs that are made from the same definitions.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.extras import import_extra

MAX_DOMAIN = 232
HEADER_BYTES = 4
"""Of a message: how it is encoded."""
_SOURCE = "ros2:"
_BROKEN = (ValueError, AssertionError, LookupError, TypeError, struct.error, MemoryError)
_IDL_NAMES = {"bool": "boolean", "byte": "uint8", "char": "uint8", "octet": "uint8"}
MORE_TYPES = {
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score",
    "vision_msgs/msg/ObjectHypothesisWithPose":
        "ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose",
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "vision_msgs/msg/Detection3D":
        "std_msgs/Header header\nObjectHypothesisWithPose[] results\nBoundingBox3D bbox\nstring id",
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nDetection3D[] detections",
}  # fmt: skip
"""Fields of messages that rosbags does not have, as of vision_msgs 4 (Humble and later)."""


@cache
def typestore() -> Any:
    """The definitions of ROS 2 Humble's messages, which later ROS 2 shares, and of MORE_TYPES."""
    typesys = import_extra("rosbags.typesys", _SOURCE, "ros2")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    for name, text in MORE_TYPES.items():
        store.register(typesys.get_types_from_msg(text, name))
    return store


def dds_name(name: str) -> str:
    """The name of a type in DDS: sensor_msgs::msg::dds_::Image_ of sensor_msgs/msg/Image."""
    package, kind, last = name.split("/")
    return f"{package}::{kind}::dds_::{last}_"


def ros_name(name: str) -> str:
    """The opposite of ``dds_name``; "" for a name that is none of ROS."""
    parts = name.split("::")
    if len(parts) != 4 or parts[2] != "dds_" or not parts[3].endswith("_"):
        return ""
    return "/".join((*parts[:2], parts[3].removesuffix("_")))


@cache
def idl_struct(name: str) -> Any:
    """The struct of a message type as cyclonedds knows it, with a field for each of the message."""
    idl = import_extra("cyclonedds.idl", _SOURCE, "ros2")
    _, fields = typestore().fielddefs[name]
    made = idl.make_idl_struct(
        name.rpartition("/")[2], dds_name(name), {field: _idl_type(kind) for field, kind in fields}
    )
    made.__idl_annotations__["extensibility"] = "final"
    return made


def _idl_type(kind: tuple[Any, Any]) -> Any:
    """The type of a field in cyclonedds by its definition in rosbags."""
    types = import_extra("cyclonedds.idl.types", _SOURCE, "ros2")
    node, described = kind[0].name, kind[1]
    if node == "NAME":
        return idl_struct(described)
    if node == "BASE":
        base, bound = described
        if base == "string":
            return types.bounded_str[bound] if bound else str
        return bool if base == "bool" else getattr(types, _IDL_NAMES.get(base, base))
    inner, count = _idl_type(described[0]), described[1]
    if node == "ARRAY":
        return types.array[inner, count]
    return types.sequence[inner, count] if count else types.sequence[inner]


@cache
def carried_type(name: str) -> Any:
    """The type of a topic, of which cyclonedds carries the bytes as they are, in ``cdr``.

    Its own way through Python numbers would take longer for an image than a camera's interval.
    """
    idl = import_extra("cyclonedds.idl", _SOURCE, "ros2")
    made = idl.make_idl_struct(
        f"Carried{name.rpartition('/')[2]}",
        dds_name(name),
        {field: _idl_type(kind) for field, kind in typestore().fielddefs[name][1]},
        dataclassify=False,
    )
    made.__idl_annotations__["extensibility"] = "final"

    def received(cls: Any, data: bytes, **_: object) -> Any:
        message = cls.__new__(cls)
        message.cdr = bytes(data)
        return message

    made.serialize = lambda self, **_: self.cdr
    made.deserialize = classmethod(received)
    made.deserialize_key = classmethod(received)
    return made


def decoded(data: bytes, name: str) -> Any | None:
    """The message of received bytes, None for bytes that are none of its type."""
    broken = import_extra("rosbags.serde", _SOURCE, "ros2").SerdeError
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


class Writer:
    """Sends messages of one type on one topic."""

    def __init__(self, name: str, writer: Any) -> None:
        self._name, self._writer = name, writer

    def send(self, message: Any) -> None:
        """Send a message of rosbags' class."""
        carried = carried_type(self._name)
        sample = carried.__new__(carried)
        sample.cdr = bytes(typestore().serialize_cdr(message, self._name))
        self._writer.write(sample)


class Reader:
    """Receives messages of one type on one topic.

    Attributes:
        broken: messages that could not be decoded.
    """

    def __init__(self, name: str, reader: Any) -> None:
        self.broken = 0
        self._name, self._reader = name, reader

    def take(self, most: int = 16) -> Iterator[Any]:
        """What was received since the last call, as rosbags' classes."""
        for sample in self._reader.take(most):
            data = getattr(sample, "cdr", b"")
            if len(data) <= HEADER_BYTES:
                continue  # a publisher has gone
            message = decoded(data, self._name)
            if message is None:
                self.broken += 1
            else:
                yield message


class Node:
    """A participant in a DDS domain, as every ROS 2 node has one."""

    def __init__(self, domain: int) -> None:
        """Raises InputError: cyclonedds is not installed, or the domain cannot be joined."""
        self._dds = {
            part: import_extra(f"cyclonedds.{part}", _SOURCE, "ros2")
            for part in ("core", "domain", "pub", "sub", "topic", "qos", "util", "builtin")
        }
        if not 0 <= domain <= MAX_DOMAIN:
            raise InputError(f"ros2:{domain}: no domain of ROS 2; give a number to {MAX_DOMAIN}")
        try:
            self._participant = self._dds["domain"].DomainParticipant(domain)
        except self._dds["core"].DDSException as error:
            raise InputError(f"ros2:{domain}: cannot join the domain ({error})") from error
        builtin = self._dds["builtin"]
        self._seen = builtin.BuiltinDataReader(
            self._participant, builtin.BuiltinTopicDcpsPublication
        )
        self._published: dict[str, str] = {}

    def published(self) -> dict[str, str]:
        """Message types of ROS by the names of the topics that have had a publisher."""
        for one in self._seen.take(64):
            topic, kind = str(one.topic_name), ros_name(str(one.type_name))
            if topic.startswith("rt/") and kind in typestore().fielddefs:
                self._published[topic.removeprefix("rt")] = kind
        return dict(self._published)

    def writer(self, topic: str, name: str, quality: Quality = STATE) -> Writer:
        """A publisher of messages of the type ``name``, such as sensor_msgs/msg/Image."""
        qos = self._qos(quality)
        made = self._dds["pub"].DataWriter(self._participant, self._topic(topic, name), qos=qos)
        return Writer(name, made)

    def reader(self, topic: str, name: str, quality: Quality = SENSOR) -> Reader:
        """A subscription; one of best effort hears reliable publishers too."""
        qos = self._qos(quality)
        made = self._dds["sub"].DataReader(self._participant, self._topic(topic, name), qos=qos)
        return Reader(name, made)

    def _topic(self, topic: str, name: str) -> Any:
        return self._dds["topic"].Topic(self._participant, f"rt{topic}", carried_type(name))

    def _qos(self, quality: Quality) -> Any:
        policy, duration = self._dds["qos"].Policy, self._dds["util"].duration
        reliable = policy.Reliability.Reliable(duration(milliseconds=100))
        latched = policy.Durability.TransientLocal
        return self._dds["qos"].Qos(
            reliable if quality.reliable else policy.Reliability.BestEffort,
            latched if quality.latched else policy.Durability.Volatile,
            policy.History.KeepLast(quality.depth),
            policy.DataRepresentation(use_cdrv0_representation=True),
        )
