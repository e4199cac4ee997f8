"""Type aliases of the numpy arrays that the packages exchange, empty ones, digests of rows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]  # poses, points, pixels, covariances
Floats = NDArray[np.float32]  # depth images, textures, beliefs
Ints = NDArray[np.int64]  # ids and rows
Mask = NDArray[np.bool_]
Image = NDArray[np.uint8]  # colour (H, W, 3) or grey (H, W)
Bytes = NDArray[np.uint8]  # colours of points, image patches, packed bits
Bits = NDArray[np.uint64]  # binary descriptors, 64 bits a word
Arrays = dict[str, NDArray[Any]]  # arrays by name, as a file holds them

SPARSE = 10
"""Ids are told apart by counting where they span less than so many times their number."""
_ODD, _HALF = np.uint64(0x9E3779B97F4A7C15), np.uint64(32)


def no_ids() -> Ints:
    """No ids (0,)."""
    return np.zeros(0, np.int64)


def no_pairs() -> Ints:
    """No pairs of ids (0, 2)."""
    return np.zeros((0, 2), np.int64)


def distinct(ids: Ints) -> Ints:
    """Ids (N,), ascending and each once; ``np.unique``, which hashes them, takes longer."""
    if not len(ids):
        return no_ids()
    low = int(ids.min())
    if int(ids.max()) - low < SPARSE * len(ids):
        return low + np.flatnonzero(np.bincount(ids - low))
    ordered = np.sort(ids)
    return ordered[np.append(True, ordered[1:] != ordered[:-1])]


def numbered(ids: Ints) -> tuple[Ints, Ints]:
    """The `distinct` ids of ids (N,), and of each of these its place (N,) among them."""
    names = distinct(ids)
    if not len(ids) or (span := int(names[-1]) - int(names[0])) >= SPARSE * len(ids):
        return names, np.searchsorted(names, ids)
    places = np.empty(span + 1, np.int64)
    places[names - names[0]] = np.arange(len(names))
    return names, places[ids - names[0]]


def step_of(whole: int, kept: int) -> int:
    """The step s of ``image[::s]``, which keeps ceil(whole / s) of an image's rows or columns."""
    return -(-whole // max(kept, 1))


def digest_rows(columns: Sequence[NDArray]) -> Bits:
    """A number (N,) for each row of columns (N, ...) of int32 or 8 bytes: equal for equal bytes.

    Two rows that differ have the same number with a probability of 2^-64.
    """
    digests = np.zeros(len(columns[0]), np.uint64)
    for column in (c.astype(np.int64) if c.dtype == np.int32 else c for c in columns):
        flat = np.ascontiguousarray(column).reshape(len(column), math.prod(column.shape[1:]))
        for words in flat.view(np.uint64).T:
            digests = (digests ^ words) * _ODD
            digests ^= digests >> _HALF
    return digests
