"""Point clouds as binary PLY files: one vertex element, any named columns. Needs numpy alone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Arrays
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.reading import read_bytes
from bmask_slam.graph.files.whole_file import whole_file

_TYPES = {
    "float": "<f4",
    "double": "<f8",
    "char": "i1",
    "uchar": "u1",
    "short": "<i2",
    "ushort": "<u2",
    "int": "<i4",
    "uint": "<u4",
}
_NAMES = {np.dtype(code): name for name, code in _TYPES.items()}
MAX_BYTES = 1 << 34
_FORMAT = "format binary_little_endian 1.0"


def write_ply(path: Path, columns: Mapping[str, NDArray[Any]], comment: str = "") -> None:
    """Write columns (N,) as the properties of N vertices; the file appears whole or not at all.

    Raises:
        ValueError: columns of different length, or of a type that PLY has not (int64, bool).
    """
    arrays = {name: np.asarray(column) for name, column in columns.items()}
    sizes = {array.shape for array in arrays.values()}
    if len(sizes) != 1 or any(len(shape) != 1 for shape in sizes):
        raise ValueError(f"PLY columns must be one-dimensional and equally long, not {sizes}")
    layout = np.dtype([(name, array.dtype.newbyteorder("<")) for name, array in arrays.items()])
    vertices = np.empty(next(iter(sizes)), layout)
    header = ["ply", _FORMAT, *([f"comment {comment}"] if comment else [])]
    header.append(f"element vertex {len(vertices)}")
    for name, array in arrays.items():
        if array.dtype not in _NAMES:
            raise ValueError(f"PLY has no type for the column {name} of {array.dtype}")
        vertices[name] = array
        header.append(f"property {_NAMES[array.dtype]} {name}")
    header.append("end_header\n")
    with whole_file(path) as temporary:
        temporary.write_bytes("\n".join(header).encode("ascii") + vertices.tobytes())


POINTS = ("x", "y", "z", "red", "green", "blue")
"""Columns of coloured points."""


def read_ply(path: Path, needed: tuple[str, ...] = ()) -> Arrays:
    """Columns (N,) of the vertices of a file as ``write_ply`` makes them.

    Raises:
        InputError: no such file, another format, fewer bytes than the header promises, or a column
            of ``needed`` that it does not have.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; give a binary PLY file")
    head, separator, body = read_bytes(path, "give a binary PLY file", MAX_BYTES).partition(
        b"end_header\n"
    )
    lines = head.decode("ascii", errors="replace").splitlines()
    if not separator or lines[:1] != ["ply"] or _FORMAT not in lines:
        raise InputError(f"{path}: not a PLY file of '{_FORMAT}'; convert it")
    try:
        count, dtype = _layout(lines[1:])
    except (ValueError, IndexError, KeyError) as error:
        raise InputError(
            f"{path}: its header cannot be read ({error}); only plain vertices are supported"
        ) from error
    if len(body) < count * dtype.itemsize:
        raise InputError(f"{path}: {len(body)} bytes for {count} vertices; the file is cut off")
    vertices = np.frombuffer(body, dtype, count)
    columns = {name: vertices[name].copy() for name in vertices.dtype.names or ()}
    check_columns(columns, needed, path)
    return columns


def check_columns(columns: Arrays, needed: tuple[str, ...], path: Path) -> None:
    """Raise InputError for a column of a file that is not there."""
    for name in needed:
        if name not in columns:
            raise InputError(f"{path}: has no column {name!r}; make it again")


def _layout(lines: list[str]) -> tuple[int, np.dtype]:
    """Number and type of the vertices by a header's lines; they must be its first element."""
    count, properties, element = 0, [], ""
    for words in filter(None, (line.split() for line in lines)):
        if words[0] == "element":
            if not element and words[1] != "vertex":
                raise ValueError(f"its first element is {words[1]!r}")
            element = words[1]
            count = int(words[2]) if element == "vertex" else count
        elif words[0] == "property" and element == "vertex":
            if words[1] not in _TYPES:
                raise ValueError(f"a {words[1]} property")
            properties.append((words[2], _TYPES[words[1]]))
    if count < 0 or not properties:
        raise ValueError("no vertex with properties")
    return count, np.dtype(properties)
