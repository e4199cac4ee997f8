"""Named numpy arrays and a JSON header in one file: how graphs, maps and checkpoints are saved.

The file is a zip of .npy arrays (``numpy.load`` opens it), the same bytes for the same contents.
It is written under a temporary name and renamed, so that an interrupted run leaves either the old
file or the new one; the zip's checksums detect damage, and nothing in it is executed.
"""

from __future__ import annotations

import json
import lzma
import math
import os
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray
from pydantic import TypeAdapter

from bmask_slam.graph.arrays import Arrays, Ints
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.reading import check_unpacked, in_short
from bmask_slam.graph.files.whole_file import whole_file

Header = dict[str, Any]
_HEADER = "header"
_HEADERS = TypeAdapter(Header)
_KINDS = "biufU"
CHUNK_BYTES = 1 << 18
COMPRESSION = 3
"""zlib's level: half the time of its default, 6, for 0.5 (fused depth) to 2 % (maps) more bytes."""
SPARE_ROWS = 1000
"""A table may have so many times as many rows as ids and 4000 more: days of tracking."""
_UNREADABLE = (  # RuntimeError: a damaged byte may ask for encryption or another compression
    *(zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, lzma.LZMAError),
    *(ValueError, LookupError, TypeError, RuntimeError, OverflowError, SyntaxError),
    tokenize.TokenError,
)
_UNFITTING = (ValueError, LookupError, TypeError, ArithmeticError, AttributeError, AssertionError)


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
            _write_zip(file, kind, named)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise InputError(
            f"{path}: the {kind.noun} cannot be written ({error.strerror}); free some space or "
            "choose another folder"
        ) from error


def _write_zip(file: IO[bytes], kind: FileKind, arrays: Arrays) -> None:
    """The file of ``numpy.savez`` or ``savez_compressed``, at the level COMPRESSION."""
    method = zipfile.ZIP_DEFLATED if kind.compressed else zipfile.ZIP_STORED
    with zipfile.ZipFile(file, "w", method, compresslevel=COMPRESSION) as zipped:
        for name, array in arrays.items():
            with zipped.open(f"{name}.npy", "w", force_zip64=True) as member:
                npy.write_array(member, np.asanyarray(array), allow_pickle=False)


def read_arrays(path: Path, kind: FileKind) -> tuple[Header, Arrays]:
    """Load what write_arrays saved. Raises InputError for a missing, foreign or broken file."""
    if not path.is_file():
        cure = "give a finished run, not one with --localise"
        raise InputError(f"{path}: there is no saved {kind.noun} here; {cure}")
    try:
        arrays = _read_zip(path)
        header: Header = _HEADERS.validate_json(str(arrays.pop(_HEADER)))
        found = header["format"], header["version"]
        if found == (kind.format, kind.version) and header["arrays"] != list(arrays):
            raise ValueError("an array is missing")
    except PermissionError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); change its permissions"
        ) from error
    except _UNREADABLE as error:
        raise InputError(
            f"{path}: not a saved {kind.noun}, or a damaged one ({in_short(error)}); save it again"
        ) from error
    if found != (kind.format, kind.version):
        raise InputError(
            f"{path}: holds {found[0]!r} version {found[1]!r}, expected {kind.format!r} version "
            f"{kind.version}; save it again with this version of bmask-slam"
        )
    return header, arrays


def _read_zip(path: Path) -> Arrays:
    """The arrays of a zip of .npy files. Raises one of _UNREADABLE."""
    with zipfile.ZipFile(path) as zipped:
        infos = zipped.infolist()
        check_unpacked(sum(info.file_size for info in infos), path.stat().st_size)
        names = [info.filename.removesuffix(".npy") for info in infos]
        if len(set(names)) < len(names):
            raise ValueError("an array is there twice")
        return {name: _read_array(zipped, i) for name, i in zip(names, infos, strict=True)}


def _read_array(zipped: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    """One array, whose header must promise as many bytes as there are. Raises _UNREADABLE."""
    with zipped.open(info) as file:
        read_header = npy.read_array_header_1_0
        if npy.read_magic(file) != (1, 0):
            read_header = npy.read_array_header_2_0
        shape, transposed, dtype = read_header(file)
        size = dtype.itemsize * math.prod(shape)
        if dtype.kind not in _KINDS or dtype.itemsize == 0 or min(shape, default=0) < 0:
            raise ValueError(f"{info.filename} holds {str(dtype)[:40]} of shape {str(shape)[:40]}")
        if size != info.file_size - file.tell():
            raise ValueError(f"{info.filename} promises {size} bytes")
        data = np.empty(math.prod(shape), dtype)
        places = data.view(np.uint8).data
        for begin in range(0, size, CHUNK_BYTES):  # ValueError if there is less
            places[begin : begin + CHUNK_BYTES] = file.read(CHUNK_BYTES)
    return data.reshape(shape[::-1]).T if transposed else data.reshape(shape)


def check_ids(ids: Ints, size: int) -> None:
    """Refuse ids (N,) that are not each once in [0, size), and a size far beyond their number.

    ``size`` is that of a table with a row for every id, also of those that were removed. Raises
    ValueError.
    """
    if size > SPARE_ROWS * (4000 + len(ids)):
        raise ValueError(f"a table of {size} rows for {len(ids)} ids")
    if len(ids) and not 0 <= ids.min() <= ids.max() < size:
        raise ValueError(f"an id that is not below {size}")
    if len(np.unique(ids)) < len(ids):
        raise ValueError("an id that is there twice")


@contextmanager
def fitting(path: Path) -> Iterator[None]:
    """Refuse a file by what the use of its arrays raises where they do not fit together.

    Raises:
        InputError: for what numpy and Python raise for wrong lengths, indices, names and numbers.
    """
    try:
        yield
    except _UNFITTING as error:
        reason = f"{type(error).__name__}: {in_short(error)}"
        raise InputError(
            f"{path}: its arrays do not fit together ({reason}); save it again"
        ) from error


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
    ``np.split`` it gives no part for no counts. Raises ValueError for another sum.
    """
    possible = bool(((counts >= 0) & (counts <= len(array))).all())
    if not possible or counts.sum() != len(array):  # a sum of larger ones may overflow
        raise ValueError(f"{len(array)} rows where {counts.sum()} are counted")
    ends = np.cumsum(counts, dtype=np.int64)
    return [array[end - count : end] for end, count in zip(ends, counts, strict=True)]


def check_like(arrays: Arrays, example: Arrays, path: Path) -> None:
    """Refuse arrays read from a file that differ from the example's in names, types or shapes.

    The first dimension may be of any length, as may others that are 0 in the example. Raises
    InputError.
    """
    for name in sorted(arrays.keys() ^ example.keys()):
        raise InputError(
            f"{path}: array {name!r} is {'missing' if name in example else 'unknown'}; save it "
            "again with this version of bmask-slam"
        )
    for name, array in arrays.items():
        expected = _layout(example[name], example[name])
        found = _layout(array, example[name])
        if found != expected:
            raise InputError(f"{path}: array {name!r} holds {found}, not {expected}; save it again")


def _layout(array: NDArray[Any], example: NDArray[Any]) -> str:
    """Type and shape in words, but for what may differ: texts' lengths, some dimensions."""
    kind = "texts" if array.dtype.kind == "U" else str(array.dtype)
    same = example.shape if example.ndim == array.ndim else array.shape
    shape = [n if k and same[k] else "N" for k, n in enumerate(array.shape)]
    return f"{kind} of shape {tuple(shape)}"
