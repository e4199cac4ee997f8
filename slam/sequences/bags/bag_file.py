"""ROS bags as files: ROS 1 .bag, ROS 2 folders (sqlite3, mcap), and single .mcap and .db3 files."""

from __future__ import annotations

import bz2
import struct
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.extras import import_extra
from bmask_slam.graph.files.reading import MAX_RATIO, SMALL_BYTES

SUFFIXES = (".bag", ".mcap", ".db3")
_CURE = (
    "if the recording was cut off, repair it with `rosbag reindex`, `ros2 bag reindex` or "
    "`mcap recover`"
)
INFO_TYPE = "sensor_msgs/msg/CameraInfo"
IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")


class Topic(NamedTuple):
    """A topic of a bag: its name, message type and number of messages."""

    name: str
    type: str
    messages: int


def is_bag(path: Path) -> bool:
    """Whether a path has the form of a bag; the contents may be broken."""
    return (path / "metadata.yaml").is_file() if path.is_dir() else path.suffix in SUFFIXES


class Bag:
    """An open bag.

    Attributes:
        path: of the bag.
        topics: all of them, sorted by name.
        duration_s: time from the first message to the last, by the time of recording.
    """

    def __init__(self, path: Path, reader: Any, allowance: Allowance) -> None:
        self.path = path
        self._allowance = allowance
        self.duration_s = max(float(reader.duration), 0.0) * 1e-9
        self._reader = reader
        self.topics = sorted(
            Topic(str(name), str(topic.msgtype), int(topic.msgcount))
            for name, topic in reader.topics.items()
        )

    def messages(self, *names: str) -> Iterator[tuple[str, Any]]:
        """The messages of these topics, each with its topic's name. Raises as ``records``."""
        for name, _, message in self.records(names):
            yield name, message

    def records(
        self, names: Collection[str], start_ns: int | None = None
    ) -> Iterator[tuple[str, int, Any]]:
        """Topic, time of recording in nanoseconds and message, in the order of recording.

        Raises:
            InputError: the bag is damaged; the messages before the damage were yielded.
        """
        chosen = [c for c in self._reader.connections if c.topic in names]
        if not chosen:
            return
        with _translated(self.path):
            raw = iter(self._reader.messages(chosen, start=start_ns))
        while True:
            with _translated(self.path), self._allowance.in_use():
                found = next(raw, None)
                if found is None:
                    return
                connection, time_ns, data = found
                message = self._reader.deserialize(data, connection.msgtype)
            yield connection.topic, time_ns, message


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a bag for reading; messages are read one by one.

    Raises:
        InputError: no such bag, one that cannot be read, or rosbags is not installed.
    """
    if not (path.is_file() or path.is_dir()):
        reason = "is no file or folder" if path.exists() else "no such bag"
        raise InputError(f"{path}: {reason}; give a .bag, .mcap or .db3, or the folder of a bag")
    typesys = import_extra("rosbags.typesys", str(path), "ros")
    highlevel = import_extra("rosbags.highlevel", str(path), "ros")
    allowance = Allowance(path)
    _bound_unpacking(path)
    with _translated(path), allowance.in_use():
        types = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        reader = highlevel.AnyReader([path], default_typestore=types)
        reader.open()
    try:
        with _translated(path):
            bag = Bag(path, reader, allowance)
        yield bag
    finally:
        with _translated(path):
            reader.close()


class Allowance:
    """How many bytes all that is compressed in a bag may unpack to, while it is open.

    As for other files, 256 MB, or 100 times the size of the bag where that is more.
    """

    def __init__(self, path: Path | None = None) -> None:
        """That of a bag; without one there is no limit."""
        if path is None:
            self.left = sys.maxsize - 1
            return
        files = path.iterdir() if path.is_dir() else [path]
        self.left = max(SMALL_BYTES, MAX_RATIO * sum(file.stat().st_size for file in files))

    def take(self, size: int) -> None:
        """Count what was unpacked. Raises ValueError if it is too much."""
        self.left -= size
        if self.left < 0:
            raise ValueError("it unpacks to far more than its size")

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """What rosbags unpacks in this block, in this thread, is counted."""
        token = _ALLOWANCE.set(self)
        try:
            yield
        finally:
            _ALLOWANCE.reset(token)


_ALLOWANCE: ContextVar[Allowance | None] = ContextVar("allowance", default=None)


def _unpack(make: Callable[[], Any], data: bytes) -> bytes:
    """What compressed data unpack to, by decompressors of ``make``; no more than is allowed."""
    allowance = _ALLOWANCE.get() or Allowance()
    parts: list[bytes] = []
    while data:
        stream = make()
        parts.append(stream.decompress(data, max_length=allowance.left + 1))
        allowance.take(len(parts[-1]))
        if not stream.eof:
            raise EOFError("compressed data are cut off")
        data = stream.unused_data or b""
    return b"".join(parts)


def _bound_unpacking(path: Path) -> None:
    """Let rosbags unpack by ``_unpack``: its own functions have no limit."""
    names = ("rosbag1.reader", "rosbag2.reader", "rosbag2.storage_mcap")
    modules: list[Any] = [import_extra(f"rosbags.{name}", str(path), "ros") for name in names]
    one, two, mcap = modules
    lz4 = import_extra("lz4.frame", str(path), "ros")
    zstd = two.zstd
    if isinstance(zstd, ModuleType):
        one.decompressors["bz2"] = lambda data: _unpack(bz2.BZ2Decompressor, data)
        one.decompressors["lz4"] = lambda data: _unpack(lz4.LZ4FrameDecompressor, data)
        mcap.DECOMPRESSORS["lz4"] = lambda data, _: _unpack(lz4.LZ4FrameDecompressor, data)
        mcap.DECOMPRESSORS["zstd"] = lambda data, _: _unpack(zstd.ZstdDecompressor, data)
        two.zstd = SimpleNamespace(
            ZstdError=zstd.ZstdError,
            decompress=lambda data: _unpack(zstd.ZstdDecompressor, data),
            open=lambda file, mode: _counted(zstd.open(file, mode)),
        )


@contextmanager
def _counted(file: Any) -> Iterator[Any]:
    """A compressed file of which no more than is allowed is read."""
    allowance = _ALLOWANCE.get() or Allowance()

    def read(size: int) -> bytes:
        data: bytes = file.read(size)
        allowance.take(len(data))
        return data

    with file:
        yield SimpleNamespace(read=read)


def format_topics(bag: Bag) -> str:
    """A bag's topics as aligned text."""
    rows = [(topic.name, topic.type, f"{topic.messages} messages") for topic in bag.topics]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)] or [0, 0, 0]
    lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
    return "\n".join([f"{bag.path}: {bag.duration_s:.2f} s", *lines])


@contextmanager
def _translated(path: Path) -> Iterator[None]:
    """Convert what rosbags raises for bags that it cannot read into InputError."""
    one, two = (import_extra(f"rosbags.rosbag{k}", str(path), "ros") for k in (1, 2))
    reader = import_extra("rosbags.rosbag2.reader", str(path), "ros")
    sqlite = import_extra("rosbags.rosbag2.storage_sqlite3", str(path), "ros")
    highlevel = import_extra("rosbags.highlevel", str(path), "ros")
    known = (highlevel.AnyReaderError, one.ReaderError, two.ReaderError)
    inside = (reader.zstd.ZstdError, sqlite.apsw.Error, struct.error, EOFError, OSError)
    damaged = (ArithmeticError, AssertionError, LookupError, MemoryError, RuntimeError)
    untyped = (TypeError, ValueError, AttributeError)
    try:
        yield
    except (*known, *inside, *damaged, *untyped) as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(f"{path}: cannot be read ({reason}); {_CURE}") from error
