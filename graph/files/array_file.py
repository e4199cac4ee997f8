"""Named numpy arrays and a JSON header in one file: how graphs, maps and checkpoints are saved.

The file is a zip of .npy arrays (``numpy.load`` opens it), the same bytes for the same contents.
It is written under a temporary name and renamed, so that an interrupted run leaves either the old
file or the new one; the zip's checksums detect damage, and nothing in it is executed.
"""

from __future__ import annotations

import json
import os
import struct
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Arrays, Ints
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.whole_file import whole_file

Header = dict[str, Any]
_HEADER = "header"
_UNREADABLE = (  # RuntimeError: a damaged byte may ask for encryption or another compression
    *(zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError),
    *(ValueError, KeyError, TypeError, RuntimeError, OverflowError),
)


@dataclass(frozen=True)
class FileKind:
    """What a file holds: ``noun`` is the word for it, such as "graph".

    ``version`` increases with every change of the arrays that the file must contain. A compressed
    file (zlib, lossless) takes about half the space and many times the time.
    """

    noun: str
    version: int
    compressed: bool = False

    @property
    def format(self) -> str:
        """The name that the file itself bears."""
        return f"bmask-slam {self.noun}"


def write_arrays(path: Path, kind: FileKind, header: Header, arrays: Arrays) -> None:
    """Save arrays and a header of JSON values, atomically. Raises InputError if it cannot."""
    names = list(arrays)  # the zip's own directory has no checksum
    header = {**header, "format": kind.format, "version": kind.version, "arrays": names}
    try:
        with whole_file(path) as temporary, temporary.open("wb") as file:
            named = {_HEADER: np.array(json.dumps(header, sort_keys=True)), **arrays}
            save = np.savez_compressed if kind.compressed else np.savez
            save(file, allow_pickle=False, **named)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise InputError(
            f"{path}: the {kind.noun} cannot be written ({error.strerror}); free some space or "
            "choose another folder"
        ) from error


def read_arrays(path: Path, kind: FileKind) -> tuple[Header, Arrays]:
    """Load what write_arrays saved. Raises InputError for a missing, foreign or broken file."""
    if not path.is_file():
        raise InputError(f"{path}: there is no saved {kind.noun} here; give a run that has one")
    try:
        with zipfile.ZipFile(path), np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(str(arrays.pop(_HEADER)))
        found = header["format"], header["version"]
        if found == (kind.format, kind.version) and header["arrays"] != list(arrays):
            raise ValueError("an array is missing")
    except _UNREADABLE as error:
        raise InputError(
            f"{path}: not a saved {kind.noun}, or a damaged one ({error}); save it again"
        ) from error
    if found != (kind.format, kind.version):
        raise InputError(
            f"{path}: holds {found[0]!r} version {found[1]!r}, expected {kind.format!r} version "
            f"{kind.version}; save it again with this version of bmask-slam"
        )
    return header, arrays


def nested(**parts: Arrays) -> Arrays:
    """The arrays of several parts in one dictionary, named ``part.array``."""
    return {f"{part}.{name}": a for part, arrays in parts.items() for name, a in arrays.items()}


def part(arrays: Arrays, name: str) -> Arrays:
    """The arrays of one part of what ``nested`` made."""
    prefix = f"{name}."
    return {key[len(prefix) :]: a for key, a in arrays.items() if key.startswith(prefix)}


def split_rows(array: NDArray[Any], counts: Ints) -> list[NDArray[Any]]:
    """The consecutive parts (counts[i], ...) of an array (sum of counts, ...), one for each count.

    How columns of unequal length are read back that were saved one after the other. Unlike
    ``np.split`` it gives no part for no counts.
    """
    ends = np.cumsum(counts, dtype=np.int64)
    return [array[end - count : end] for end, count in zip(ends, counts, strict=True)]


def check_like(arrays: Arrays, example: Arrays, path: Path) -> None:
    """Refuse arrays read from a file that differ from the example's in names, types or shapes.

    The first dimension may be of any length. Raises InputError.
    """
    for name in sorted(arrays.keys() ^ example.keys()):
        raise InputError(
            f"{path}: array {name!r} is {'missing' if name in example else 'unknown'}; save it "
            "again with this version of bmask-slam"
        )
    for name, array in arrays.items():
        found, expected = _layout(array), _layout(example[name])
        if found != expected:
            raise InputError(f"{path}: array {name!r} holds {found}, not {expected}; save it again")


def _layout(array: NDArray[Any]) -> str:
    """Type and shape in words, but for what may differ: texts' lengths, the first dimension."""
    kind = "texts" if array.dtype.kind == "U" else str(array.dtype)
    return f"{kind} of shape {('N', *array.shape[1:])[: array.ndim]}"
