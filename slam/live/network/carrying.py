"""Files that go with messages over a network, behind all other messages.

A map's process that runs on a workstation is told paths of the robot. It writes to a folder of its
own, and what it has written is sent in pieces. Each waits until nothing else is to be sent, and a
newer file takes the place of an older one of the same path that is not sent yet: where the network
is slow, tracking gets the map's changes in time, and fewer states are saved.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Condition
from typing import Any

import numpy as np

from bmask_slam.graph.arrays import Bytes
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.reading import read_bytes
from bmask_slam.graph.files.whole_file import open_plain
from bmask_slam.live.channel import END, Channel
from bmask_slam.live.messages import Finish, MapSaved, SaveMap, SaveState, StateSaved

MAX_BYTES = 1 << 40
PIECE = 1 << 18
"""Bytes of a piece: what another message waits for at most."""


def file_data(path: Path) -> Bytes:
    """The bytes of a file that this program has just written. Raises InputError: it is gone."""
    return np.frombuffer(read_bytes(path, "run it again", MAX_BYTES), np.uint8)


@dataclass(frozen=True, eq=False)
class FilePiece:
    """A part of a file of the receiver, from the byte ``begin`` on.

    Attributes:
        message: with the last piece: says that the file is there.
    """

    path: Path
    begin: int
    data: Bytes
    message: Any = None


class Outbox:
    """What is to be sent: messages in their order, then pieces of files, then the end."""

    def __init__(self) -> None:
        self._messages: deque[Any] = deque()
        self._pieces: deque[FilePiece] = deque()
        self._ended = False
        self._changed = Condition()

    def put(self, item: Any) -> None:
        """Add a message, a piece or the end."""
        with self._changed:
            if item is END:
                self._ended = True
            elif not isinstance(item, FilePiece):
                self._messages.append(item)
            else:
                if item.begin == 0:
                    self._pieces = deque(p for p in self._pieces if p.path != item.path)
                self._pieces.append(item)
            self._changed.notify()

    def get(self) -> Any:
        """The next to be sent; waits for it."""
        with self._changed:
            self._changed.wait_for(lambda: self._messages or self._pieces or self._ended)
            if self._messages:
                return self._messages.popleft()
            return self._pieces.popleft() if self._pieces else END


class CarriedFiles:
    """The channel of a map's process whose owner, and its files, are on another machine."""

    def __init__(self, channel: Channel, folder: Path) -> None:
        self._channel, self._folder = channel, folder
        self._theirs: dict[Path, Path] = {}

    def messages(self) -> Iterator[Any]:
        """Numbered messages, with paths of this machine."""
        for number, message in self._channel.messages():
            if isinstance(message, SaveState | SaveMap | Finish):
                here = self._folder / type(message).__name__
                self._theirs[here] = message.path
                yield number, replace(message, path=here)
            else:
                yield number, message

    def send(self, message: Any) -> None:
        """Send an answer; a file that is written is sent before it."""
        if not isinstance(message, StateSaved | MapSaved):
            self._channel.send(message)
            return
        path = self._theirs[message.path]
        told = replace(message, path=path)
        if isinstance(message, MapSaved) and message.failure:
            self._channel.send(told)
            return
        data = file_data(message.path)
        for begin in range(0, max(len(data), 1), PIECE):
            end = begin + PIECE
            last = told if end >= len(data) else None
            self._channel.send(FilePiece(path, begin, data[begin:end], last))


def store(piece: FilePiece, fail: Callable[[OSError | InputError], Any]) -> Any | None:
    """Write a piece; returns the message of the last, when the file has its name.

    What cannot be written is what ``fail`` makes of the message.
    """
    part = piece.path.with_name(f"{piece.path.name}.part")
    try:
        with open_plain(part, "r+b" if piece.begin else "wb") as file:
            file.seek(piece.begin)
            file.write(piece.data.tobytes())
        if piece.message is not None:
            os.replace(part, piece.path)
    except (OSError, InputError) as error:
        with suppress(OSError):  # without its beginning, no later piece makes a file of it
            part.unlink()
        return fail(error) if piece.message is not None else None
    return piece.message
