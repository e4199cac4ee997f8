"""Blocks of voxels: their keys, the order of their voxels, and tables of them in files.

A block has EDGE^3 voxels, in bricks of BRICK^3. The voxel at index i has its centre at i voxel_m.
"""

from __future__ import annotations

import mmap
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np
import torch
from torch import Tensor

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.file_names import refuse_link

EDGE, BRICK = 8, 4
"""Edges in voxels of a block, the unit of memory, and of a brick, the unit of work."""
BRICKS, BRICK_VOXELS = (EDGE // BRICK) ** 3, BRICK**3
TABLES: dict[str, tuple[tuple[int, ...], torch.dtype]] = {
    "distance": ((BRICK_VOXELS,), torch.float32),
    "weight": ((BRICK_VOXELS,), torch.float32),
    "witnesses": ((BRICK_VOXELS,), torch.float16),
    "free": ((BRICK_VOXELS,), torch.float16),
    "colour": ((BRICK_VOXELS, 4), torch.float16),
}
KINDS = {torch.float32: np.float32, torch.float16: np.float16}


class FileTable:
    """Rows of numbers in a file that is mapped into memory.

    The system reads what is used, writes what has changed, and may drop it from memory at any time.

    Attributes:
        rows: (N, *shape), at first without rows; a new tensor after ``grow``.
    """

    def __init__(
        self, shape: tuple[int, ...], kind: torch.dtype, folder: Path | None, name: str | None
    ) -> None:
        """A file in a ``folder``; without ``name`` it vanishes with the table.

        Raises:
            InputError: it cannot be made.
        """
        self._shape, self._kind = shape, np.dtype(KINDS[kind])
        with _disk():
            self._file = _opened(folder, name)
        self._map: mmap.mmap | None = None
        self.rows: Tensor = torch.zeros((0, *shape), dtype=kind)

    def grow(self, rows: int) -> None:
        """Let the table have so many rows; new ones are zero. Raises InputError: no space."""
        size = rows * self._kind.itemsize * int(np.prod(self._shape))
        with _disk():
            _take_space(self._file, size)
            self._map = mmap.mmap(self._file.fileno(), size)
        values = np.frombuffer(self._map, self._kind).reshape(rows, *self._shape)
        self.rows = torch.from_numpy(values)

    def cut(self, rows: int) -> None:
        """Let the file end behind so many rows, which stay those of the table."""
        self._file.truncate(rows * self._kind.itemsize * int(np.prod(self._shape)))

    def release(self) -> None:
        """Give the memory back; what is used again is read again."""
        if self._map is not None:
            self._map.madvise(mmap.MADV_DONTNEED)


def open_tables(folder: Path | None, kept: bool) -> dict[str, FileTable]:
    """The TABLES of a volume by name, in files that have these names if they are kept."""
    return {name: FileTable(*kind, folder, name if kept else None) for name, kind in TABLES.items()}


def tables_fit(folder: Path, blocks: int) -> bool:
    """Whether the kept files in a folder are as large as so many blocks need."""
    return all(
        (folder / name).is_file()
        and (folder / name).stat().st_size
        == blocks * BRICKS * int(np.prod(shape)) * np.dtype(KINDS[kind]).itemsize
        for name, (shape, kind) in TABLES.items()
    )


def _take_space(file: IO[bytes], size: int) -> None:
    """Make a file that large, on the disk too: later a full one would kill the process."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file.fileno(), 0, size)
        return
    held = file.seek(0, os.SEEK_END)  # macOS
    for start in range(held, size, 1 << 20):
        file.write(bytes(min(size - start, 1 << 20)))
    file.flush()


def _opened(folder: Path | None, name: str | None) -> IO[bytes]:
    if folder is None or name is None:
        return tempfile.TemporaryFile(dir=folder)
    refuse_link(folder / name)
    (folder / name).touch()
    return (folder / name).open("r+b")


@contextmanager
def _disk() -> Iterator[None]:
    """Translate what a disk refuses. Raises InputError."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"the surface's volume cannot be stored ({error.strerror}); free some space"
        ) from error


def lattice(edge: int, step: int) -> Tensor:
    """Points (N, 3) of a cube, ``step`` apart, the last index first."""
    axis = torch.arange(0, edge, step, dtype=torch.float32)
    return torch.cartesian_prod(axis, axis, axis)


def block_keys(index: Tensor) -> Tensor:
    """Keys (N,) of indices (N, 3), with 21 bits for each axis."""
    shifted = index + (1 << 20)
    return (shifted[:, 0] << 42) | (shifted[:, 1] << 21) | shifted[:, 2]


def block_indices(keys: Tensor) -> Tensor:
    """Indices (N, 3) of keys (N,)."""
    mask = (1 << 21) - 1
    return torch.stack([keys >> 42, (keys >> 21) & mask, keys & mask], dim=-1) - (1 << 20)


def voxel_places(index: Tensor) -> tuple[Tensor, Tensor]:
    """Keys (N,) of the blocks of voxels with indices (N, 3), and their rows (N,) in these."""
    block = torch.div(index, EDGE, rounding_mode="floor")
    local = index - block * EDGE
    row = torch.zeros(len(index), dtype=torch.int64)
    for part, edge in ((local // BRICK, EDGE // BRICK), (local % BRICK, BRICK)):
        for k in range(3):
            row = row * edge + part[:, k]
    return block_keys(block), row
