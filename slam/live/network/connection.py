"""A connection between two machines that know the same token: authenticated and compressed.

Neither side unpickles a byte before the other has proved that it knows the token, and every message
carries a code (HMAC-SHA256) that only who knows it can make, for its place in the stream. What is
sent is not secret: who listens on the way sees images and map.
"""

from __future__ import annotations

import hmac
import os
import secrets
import socket
import struct
import sys
import threading
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bmask_slam import __version__
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.reading import read_bytes

PROTOCOL = 4
HELLO_BYTES, NONCE_BYTES, CODE_BYTES = 64, 32, 32
MIN_TOKEN, MAX_TOKEN = 20, 4096
MAX_PARTS = 1 << 16
DEAD_S = 60
"""A connection of which nothing is acknowledged for so long has ended, as the system sees it. That
counts a process that reads nothing for so long, as one that is being loaded."""
BEAT_S = 0.3
"""Between two empty messages of the robot, which the other machine's system acknowledges, also
while its process works."""
_RETRANSMITS, _LAST_ACKNOWLEDGED = 2, 8 + 12 * 4
"""Where Linux's struct tcp_info has how often the same was sent again, and the milliseconds since
the last acknowledgement."""
_SMALL = 512
"""Bytes up to which a part is not compressed."""
_COUNT, _SIZES = struct.Struct("!I"), struct.Struct("!QQ")


@dataclass(frozen=True)
class Keys:
    """Of one connection, for what this end sends and for what it receives."""

    sending: bytes
    receiving: bytes


def default_token_file() -> Path:
    """$XDG_CONFIG_HOME/bmask-slam/token, or ~/.config/bmask-slam/token."""
    base = os.environ.get("XDG_CONFIG_HOME")
    return (Path(base) if base else Path.home() / ".config") / "bmask-slam" / "token"


def read_token(path: Path) -> bytes:
    """The token in a file.

    Raises:
        InputError: there is none, or it is too short to be safe.
    """
    cure = (
        "copy the token of the workstation to it, which bmask-slam workstation makes at its first "
        "start"
    )
    token = read_bytes(path, cure, MAX_TOKEN).strip()
    if len(token) < MIN_TOKEN:
        raise InputError(f"{path}: a token of fewer than {MIN_TOKEN} characters is not safe")
    return token


def make_token(path: Path) -> None:
    """Write a new token, which only its owner can read."""
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "w") as file:
        file.write(secrets.token_urlsafe(32) + "\n")


def hello() -> bytes:
    """What both sides say first: they must be of one version, as they exchange its classes."""
    return f"bmask-slam {__version__} protocol {PROTOCOL}".encode().ljust(HELLO_BYTES, b"\0")


def introduce(end: socket.socket, token: bytes) -> Keys:
    """Prove to a workstation that this side knows the token, and let it prove that.

    Raises:
        InputError: it does not, or it has another version.
        OSError: the connection ends.
    """
    ours = secrets.token_bytes(NONCE_BYTES)
    end.sendall(hello() + ours)
    said = exactly(end, HELLO_BYTES)
    if said != hello():
        other = said.rstrip(b"\0").decode("ascii", "replace")
        mine = hello().rstrip(b"\0").decode()
        raise InputError(f"the workstation has {other!r}, this machine {mine!r}; install the same")
    theirs, code = exactly(end, NONCE_BYTES), exactly(end, CODE_BYTES)
    if not hmac.compare_digest(code, _code(token, b"workstation", ours, theirs)):
        raise InputError("the workstation has another token; copy its file to this machine")
    end.sendall(_code(token, b"robot", ours, theirs))
    return Keys(_code(token, b"to it", ours, theirs), _code(token, b"from it", ours, theirs))


def admit(end: socket.socket, token: bytes) -> Keys | None:
    """The opposite of ``introduce``: the keys of who knows the token, else None.

    Raises:
        OSError: the connection ends.
    """
    said, theirs = exactly(end, HELLO_BYTES), exactly(end, NONCE_BYTES)
    if said != hello():
        end.sendall(hello())
        return None
    ours = secrets.token_bytes(NONCE_BYTES)
    end.sendall(hello() + ours + _code(token, b"workstation", theirs, ours))
    if not hmac.compare_digest(exactly(end, CODE_BYTES), _code(token, b"robot", theirs, ours)):
        return None
    return Keys(_code(token, b"from it", theirs, ours), _code(token, b"to it", theirs, ours))


def exactly(end: socket.socket, size: int) -> bytes:
    """So many bytes. Raises OSError if the connection ends before."""
    data = bytearray(size)
    view = memoryview(data)
    while view:
        count = end.recv_into(view)
        if not count:
            raise ConnectionResetError("the other side has ended")
        view = view[count:]
    return bytes(data)


class Connection:
    """Sends and receives a pickle with its buffers, as multiprocessing's does.

    Attributes:
        sent_bytes, received_bytes: on the wire, without the headers of TCP.
    """

    def __init__(self, end: socket.socket, keys: Keys) -> None:
        self.sent_bytes = self.received_bytes = 0
        self._end, self._keys = end, keys
        self._sent = self._received = 0  # messages
        self._sending = threading.Lock()
        end.settimeout(None)
        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        end.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        idle, limit = {"TCP_KEEPIDLE": 2, "TCP_KEEPINTVL": 1, "TCP_KEEPCNT": 3}, 1000 * DEAD_S
        for name, value in (idle | {"TCP_USER_TIMEOUT": limit}).items():
            if hasattr(socket, name):
                end.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)

    def fileno(self) -> int:
        """The descriptor."""
        return self._end.fileno()

    def close(self) -> None:
        """Give the descriptor back; nobody may wait for data any more."""
        self._end.close()

    @property
    def silent_s(self) -> float:
        """For how long the other system has acknowledged nothing of what was sent again.

        0 where this system does not say, and while what was sent has arrived, but is not read.
        """
        try:
            info = self._end.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 104)
        except (OSError, AttributeError):
            return 0.0
        if not info[_RETRANSMITS]:
            return 0.0
        return int.from_bytes(info[_LAST_ACKNOWLEDGED:][:4], sys.byteorder) / 1e3

    def beat(self) -> None:
        """Send an empty message, which ``recv`` passes over. Raises OSError as ``send``."""
        with self._sending:
            self._send([])

    def send(self, message: tuple[bytes, Sequence[bytes | memoryview]]) -> None:
        """Send a pickle and its buffers. Raises OSError if the connection has ended."""
        parts = [_packed(part) for part in (message[0], *message[1])]
        with self._sending:
            self._send(parts)

    def _send(self, parts: list[tuple[bytes, int]]) -> None:
        head = _COUNT.pack(len(parts)) + b"".join(_SIZES.pack(len(d), raw) for d, raw in parts)
        body = b"".join(data for data, _ in parts)
        number = self._sent.to_bytes(8, "big")
        self._sent += 1
        codes = [_code(self._keys.sending, number, kind, text) for kind, text in
                 ((b"head", head), (b"body", body))]  # fmt: skip
        self._end.sendall(head + codes[0])
        self._end.sendall(body)
        self._end.sendall(codes[1])
        self.sent_bytes += len(head) + len(body) + 2 * CODE_BYTES

    def recv(self) -> tuple[bytes, list[bytes]]:
        """The next pickle and its buffers.

        Raises:
            OSError: the connection has ended, or somebody has changed what was sent.
        """
        while not (parts := self._recv()):
            pass
        return parts[0], parts[1:]

    def _recv(self) -> list[bytes]:
        first = exactly(self._end, _COUNT.size)
        (count,) = _COUNT.unpack(first)
        if count > MAX_PARTS:
            raise ConnectionAbortedError("a message of a foreign form")
        sizes = exactly(self._end, count * _SIZES.size)
        number = self._received.to_bytes(8, "big")
        self._received += 1
        self._check(number, b"head", first + sizes)
        both = list(_SIZES.iter_unpack(sizes))
        body = exactly(self._end, sum(size for size, _ in both))
        self._check(number, b"body", body)
        self.received_bytes += len(first) + len(sizes) + len(body) + 2 * CODE_BYTES
        parts: list[bytes] = []
        begin = 0
        for size, raw in both:
            data = body[begin : begin + size]
            parts.append(data if raw == size else zlib.decompress(data, bufsize=raw))
            begin += size
        return parts

    def _check(self, number: bytes, kind: bytes, text: bytes) -> None:
        code = exactly(self._end, CODE_BYTES)
        if not hmac.compare_digest(code, _code(self._keys.receiving, number, kind, text)):
            raise ConnectionAbortedError("a message that the other side has not sent")


def _packed(part: bytes | memoryview) -> tuple[bytes, int]:
    """A part as it is sent, compressed where that saves something, and its own size."""
    raw = bytes(part)
    if len(raw) <= _SMALL:
        return raw, len(raw)
    packed = zlib.compress(raw, 1)
    return (packed, len(raw)) if len(packed) < len(raw) else (raw, len(raw))


def _code(key: bytes, *texts: bytes) -> bytes:
    """HMAC-SHA256 of texts of which all but the last have a fixed size or are of ours."""
    made = hmac.new(key, digestmod="sha256")
    for text in texts:
        made.update(text)
    return made.digest()
