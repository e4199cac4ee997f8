"""Which sequence a run was made from: the comment in the first line of its config.yaml."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from bmask_slam import __version__
from bmask_slam.evaluation.recordings import JOINED
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.file_names import is_folder
from bmask_slam.graph.files.reading import read_text
from bmask_slam.sequences.bags.topics import split_path
from bmask_slam.sequences.formats.layouts import is_recording_file

CONFIG = "config.yaml"
_MAX_LINE = 5000
_SEQUENCE = re.compile(r"^# .*?, sequence (?P<path>.+), stride (?P<stride>[0-9]{1,9})$")


@dataclass(frozen=True)
class Origin:
    """The sequence of a run, folder, file or bag, absolute, and its stride; None for a camera."""

    sequence: Path | None
    stride: int = 1

    def __str__(self) -> str:
        begin = f"bmask-slam {__version__}"
        if self.sequence is None:
            return f"{begin}, live"
        return f"{begin}, sequence {self.sequence.absolute()}, stride {self.stride}"


def read_origin(run: Path) -> Origin:
    """The origin of a run; a relative path, as older runs have, is resolved.

    It was relative to the folder where the run was started, which is not known: the working
    directory is tried, then the run's folder and those above it. It stays relative if no such
    folder exists.
    """
    config = run / CONFIG
    text = read_text(config, "give --sequence") if config.is_file() else ""
    first = text[:_MAX_LINE].partition("\n")[0]
    found = _SEQUENCE.match(first)
    if found is None:
        return Origin(None)
    path = Path(found["path"])
    if not path.is_absolute():
        folders = (Path.cwd(), run.absolute(), *run.absolute().parents)
        path = next((f / path for f in folders if _may_be_sequence(f / path)), path)
    return Origin(path, int(found["stride"]))


def _may_be_sequence(folder: Path) -> bool:
    """Whether it is a folder and no run: runs/office is named after its sequence, office."""
    return is_folder(folder) and not (folder / CONFIG).exists()


def _is_there(sequence: Path) -> bool:
    """Whether a folder or a file that is a recording lies there; topics may follow a bag's path."""
    file, _ = split_path(sequence)
    try:
        return is_folder(file) or (is_recording_file(sequence) and file.is_file())
    except OSError:  # no name that a file can have
        return False


def recording_of(path: Path) -> Path:
    """The recording itself, or that of a run's folder; of a merged run its recordings.json."""
    if is_folder(path) and (path / JOINED).is_file():
        return path / JOINED
    return read_origin(path).sequence or path if is_folder(path) else path


def find_sequence(run: Path) -> Path:
    """The sequence that a run was made from: a folder, a file or a bag.

    Raises:
        InputError: config.yaml names none, or one that is not there.
    """
    sequence = read_origin(run).sequence
    if sequence is None or not _is_there(sequence):
        named = f"names {str(sequence)!r}, which is not there" if sequence else "names no sequence"
        cure = "give the folder of the run's images as --sequence"
        raise InputError(f"{run / CONFIG}: {named}; {cure}")
    return sequence
