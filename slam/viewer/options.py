"""Where a run is shown."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from bmask_slam.graph.errors import InputError

LOCAL = "127.0.0.1"


@dataclass(frozen=True)
class ViewOptions:
    """Where the scene is shown: in Rerun, in Foxglove, or in both.

    Attributes:
        record: Rerun recording to write.
        serve: port of Rerun's web viewer; 0: none.
        window: show it in Rerun's own window.
        host: address that the servers listen on.
        foxglove_file: MCAP file to write.
        foxglove_port: of a websocket that Foxglove connects to; 0: none.
    """

    record: Path | None = None
    serve: int = 0
    window: bool = False
    host: str = LOCAL
    foxglove_file: Path | None = None
    foxglove_port: int = 0

    @property
    def in_rerun(self) -> bool:
        """Whether Rerun shows it."""
        return self.record is not None or self.serve > 0 or self.window

    @property
    def in_foxglove(self) -> bool:
        """Whether Foxglove does."""
        return self.foxglove_file is not None or self.foxglove_port > 0

    @property
    def enabled(self) -> bool:
        """Whether it is shown at all."""
        return self.in_rerun or self.in_foxglove


@contextmanager
def naming(file: Path) -> Iterator[None]:
    """What a viewer's library raises while it opens or ends a file is an InputError with its name.

    A library says neither the file nor, as ``OSError.errno``, the reason.
    """
    try:
        yield
    except (OSError, RuntimeError) as error:
        reason = str(error).partition(", path")[0]
        cure = "change the folder's permissions, free some space, or choose another place"
        raise InputError(f"{file}: {reason}; {cure}") from error
