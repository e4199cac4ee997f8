"""ROS 2's wire: DDS topics of ROS names and types, whose messages are CDR as ROS 2 has it.

cyclonedds carries the bytes that rosbags makes. It knows the types by structs that are made from
the same definitions. Services are those of rmw_cyclonedds: a request and its reply have the
caller's number and that of the call, 16 bytes, before their fields. ROS 2 over another DDS has
another way.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import cache
from typing import Any

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.extras import import_extra
from bmask_slam.live.ros2.transport import (
    SENSOR,
    SOURCE,
    STATE,
    Quality,
    decoded,
    encoded,
    typestore,
)

MAX_DOMAIN = 232
HEADER_BYTES = 4
"""Of a message: how it is encoded."""
CALL_BYTES = 16
"""Of a service's request or reply, behind that: who calls, and the number of the call."""
_IDL_NAMES = {"bool": "boolean", "byte": "uint8", "char": "uint8", "octet": "uint8"}


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


def rooted(name: str) -> str:
    """The name of a topic or service with a slash before it, as ROS resolves one without."""
    return f"/{name.lstrip('/')}"


@cache
def idl_struct(name: str) -> Any:
    """The struct of a message type as cyclonedds knows it, with a field for each of the message."""
    idl = import_extra("cyclonedds.idl", SOURCE, "ros2")
    _, fields = typestore().fielddefs[name]
    made = idl.make_idl_struct(
        name.rpartition("/")[2], dds_name(name), {field: _idl_type(kind) for field, kind in fields}
    )
    made.__idl_annotations__["extensibility"] = "final"
    return made


def _idl_type(kind: tuple[Any, Any]) -> Any:
    """The type of a field in cyclonedds by its definition in rosbags."""
    types = import_extra("cyclonedds.idl.types", SOURCE, "ros2")
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
    idl = import_extra("cyclonedds.idl", SOURCE, "ros2")
    made = idl.make_idl_struct(
        f"Carried{name.rpartition('/')[2]}",
        dds_name(name),
        _call_fields(name) | {f: _idl_type(kind) for f, kind in typestore().fielddefs[name][1]},
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


def _call_fields(name: str) -> dict[str, Any]:
    """What precedes the fields of a service's request or reply: CALL_BYTES."""
    if name.split("/")[1] != "srv":
        return {}
    types = import_extra("cyclonedds.idl.types", SOURCE, "ros2")
    return {"call_guid": types.uint64, "call_sequence": types.int64}


class DdsWriter:
    """Sends messages of one type on one topic."""

    def __init__(self, name: str, writer: Any) -> None:
        self._name, self._writer = name, writer

    def send(self, message: Any) -> None:
        """Send a message of rosbags' class."""
        self.send_bytes(encoded(message, self._name))

    def send_bytes(self, data: bytes) -> None:
        """Send a message that is encoded."""
        carried = carried_type(self._name)
        sample = carried.__new__(carried)
        sample.cdr = data
        self._writer.write(sample)


class DdsReader:
    """Receives messages of one type on one topic.

    Attributes:
        broken: messages that could not be decoded.
    """

    def __init__(self, name: str, reader: Any) -> None:
        self.broken = 0
        self._name, self._reader = name, reader

    def take(self, most: int = 16) -> Iterator[Any]:
        """What was received since the last call, as rosbags' classes."""
        for data in self.take_bytes(most):
            message = decoded(data, self._name)
            if message is None:
                self.broken += 1
            else:
                yield message

    def take_bytes(self, most: int = 16) -> Iterator[bytes]:
        """The same, encoded."""
        for sample in self._reader.take(most):
            data = getattr(sample, "cdr", b"")
            if len(data) > HEADER_BYTES:  # else a publisher has gone
                yield data


class DdsRequest:
    """A call of a service, to be answered to who called."""

    def __init__(self, message: Any, call: bytes, service: DdsService) -> None:
        self.message = message
        self._call, self._service = call, service

    def reply(self, message: Any) -> None:
        """Answer it."""
        self._service.send(message, self._call)


class DdsService:
    """One end of a service of a type: receives calls and answers them.

    The other way round it is a client, which sends calls and receives answers.
    """

    def __init__(self, names: tuple[str, str], reader: DdsReader, writer: DdsWriter) -> None:
        """``names`` of the messages that are received and sent."""
        self._names, self._reader, self._writer = names, reader, writer

    def take(self) -> Iterator[DdsRequest]:
        """What was received since the last call; what cannot be decoded is left out."""
        begin = HEADER_BYTES + CALL_BYTES
        for data in self._reader.take_bytes():
            message = decoded(data[:HEADER_BYTES] + data[begin:], self._names[0])
            if len(data) > begin and message is not None:
                yield DdsRequest(message, data[HEADER_BYTES:begin], self)

    def send(self, message: Any, call: bytes) -> None:
        """Send a message of a call, which is named by CALL_BYTES bytes."""
        data = encoded(message, self._names[1])
        self._writer.send_bytes(data[:HEADER_BYTES] + call + data[HEADER_BYTES:])


class DdsNode:
    """A participant in a DDS domain, as every ROS 2 node has one."""

    def __init__(self, domain: int) -> None:
        """Raises InputError: cyclonedds is not installed, or the domain cannot be joined."""
        self._dds = {
            part: import_extra(f"cyclonedds.{part}", SOURCE, "ros2")
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

    def writer(self, topic: str, name: str, quality: Quality = STATE) -> DdsWriter:
        """A publisher of messages of the type ``name``, such as sensor_msgs/msg/Image."""
        return self._writer(f"rt{rooted(topic)}", name, self._qos(quality))

    def reader(self, topic: str, name: str, quality: Quality = SENSOR) -> DdsReader:
        """A subscription; one of best effort hears reliable publishers too."""
        return self._reader(f"rt{rooted(topic)}", name, self._qos(quality))

    def service(self, service: str, name: str, calls: bool = False) -> DdsService:
        """Serve a service, or with ``calls`` be a client of it."""
        path = rooted(service)
        ends = (f"rq{path}Request", f"{name}_Request"), (f"rr{path}Reply", f"{name}_Response")
        (topic, received), (back, sent) = ends[::-1] if calls else ends
        role = "clientid" if calls else "serviceid"
        number = ".".join(f"{byte:x}" for byte in os.urandom(12))  # by which ROS finds the pair
        qos = self._qos(Quality(reliable=True, depth=10), f"{role}={number};")
        reader = self._reader(topic, received, qos)
        return DdsService((received, sent), reader, self._writer(back, sent, qos))

    def _writer(self, dds_topic: str, name: str, qos: Any) -> DdsWriter:
        topic = self._dds["topic"].Topic(self._participant, dds_topic, carried_type(name))
        return DdsWriter(name, self._dds["pub"].DataWriter(self._participant, topic, qos=qos))

    def _reader(self, dds_topic: str, name: str, qos: Any) -> DdsReader:
        topic = self._dds["topic"].Topic(self._participant, dds_topic, carried_type(name))
        return DdsReader(name, self._dds["sub"].DataReader(self._participant, topic, qos=qos))

    def _qos(self, quality: Quality, user_data: str = "") -> Any:
        policy, duration = self._dds["qos"].Policy, self._dds["util"].duration
        reliable = policy.Reliability.Reliable(duration(milliseconds=100))
        latched = policy.Durability.TransientLocal
        return self._dds["qos"].Qos(
            reliable if quality.reliable else policy.Reliability.BestEffort,
            latched if quality.latched else policy.Durability.Volatile,
            policy.History.KeepLast(quality.depth),
            policy.DataRepresentation(use_cdrv0_representation=True),
            *([policy.Userdata(user_data.encode())] if user_data else ()),
        )
