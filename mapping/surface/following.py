"""A surface that follows its frames: where a pose moved, blocks are integrated again."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bmask_slam.graph.arrays import Array, Arrays, Ints, Mask
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.array_file import (
    FileKind,
    Header,
    check_like,
    read_arrays,
    write_arrays,
)
from bmask_slam.graph.geometry import transform
from bmask_slam.mapping.surface.blocks import tables_fit
from bmask_slam.mapping.surface.depth_frame import DepthFrame
from bmask_slam.mapping.surface.volume import SurfaceVolume

REACH_M = 2.0
"""Poses are as far apart as the camera is, or points at its image's edges so far ahead."""

LoadFrame = Callable[[int, Array], DepthFrame | None]
"""A frame by its number again, at a pose T_world_camera (4, 4); None if it cannot be used."""
VOLUME_FILE = FileKind("surface volume", 1)
_NUMBERS = np.zeros(0, np.int64)
_NOTHING: Arrays = {
    **dict.fromkeys(("keys", "numbers", "sizes"), _NUMBERS),
    "poses": np.zeros((0, 4, 4)),
    "packed": np.zeros(0, np.uint8),
}


@dataclass(frozen=True, eq=False)
class _Part:
    """What a frame did: its pose, and the numbers of the blocks that it changed, as packed bits."""

    T_world_camera: Array
    packed: bytes

    @classmethod
    def of(cls, T_world_camera: Array, blocks: Ints) -> _Part:
        marks = np.zeros(int(blocks.max(initial=-1)) + 1, bool)
        marks[blocks] = True
        return cls(T_world_camera, zlib.compress(np.packbits(marks).tobytes(), 1))

    def also(self, blocks: Ints, total: int) -> _Part:
        """The same frame, which changed these of ``total`` blocks too."""
        marks = torch.zeros(total, dtype=torch.bool)
        self.mark(marks)
        marks[torch.from_numpy(blocks)] = True
        return _Part.of(self.T_world_camera, np.flatnonzero(marks.numpy()))

    def mark(self, blocks: Tensor) -> None:
        """Mark the blocks (B,) in place."""
        bits = torch.from_numpy(self._bits(len(blocks)))
        blocks[: len(bits)] |= bits

    def on(self, blocks: Tensor) -> bool:
        """Whether it changed a marked block (B,)."""
        bits = torch.from_numpy(self._bits(len(blocks)))
        return bool((blocks[: len(bits)] & bits).any())

    def _bits(self, most: int) -> Mask:
        bits = np.unpackbits(np.frombuffer(zlib.decompress(self.packed), np.uint8))
        return bits[:most].astype(bool)


class FollowingSurface:
    """A volume and the poses at which its frames are in it.

    Attributes:
        volume: of the frames.
        stale: blocks (B,) of an unfinished ``following``, which lack frames; else none.
    """

    def __init__(self, volume: SurfaceVolume, load: LoadFrame) -> None:
        self.volume, self._load = volume, load
        self._parts: dict[int, _Part] = {}
        self._changed = self.stale = torch.zeros(0, dtype=torch.bool)

    def __len__(self) -> int:
        return len(self._parts)

    def __iter__(self) -> Iterator[int]:
        return iter(self._parts)

    def add(self, number: int, frame: DepthFrame) -> None:
        """Integrate a frame that is not in it yet. Raises InputError: the disk is full."""
        blocks = self.volume.integrate(frame)
        self._parts[number] = _Part.of(frame.T_world_camera, blocks)
        self._changed = _grown(self._changed, len(self.volume))
        self._changed[torch.from_numpy(blocks)] = True

    def take_changed(self) -> Ints:
        """Keys (N,) of the blocks that have changed since the last call."""
        rows = torch.nonzero(self._changed)[:, 0].numpy()
        self._changed = torch.zeros(len(self.volume), dtype=torch.bool)
        return self.volume.keys[rows]

    def moved(self, poses: Mapping[int, Array]) -> set[int]:
        """Which frames are in it by more than a voxel from these poses T_world_camera (4, 4)."""
        return {n for n, T in poses.items() if n in self._parts and self._has_moved(n, T)}

    def follow(
        self,
        poses: Mapping[int, Array],
        removed: Collection[int] = (),
        progress: Callable[[int], None] = lambda done: None,
    ) -> int:
        """Bring frames to their poses T_world_camera (4, 4) of now, and take some out.

        Frames that moved by more than a voxel, and those removed, leave the blocks that they
        changed, which are cleared; whatever else had changed these is integrated into them again,
        all frames in the order in which they came. Returns how many were read again; ``progress``
        is told how many of all were looked at.

        Raises:
            InputError: a frame cannot be read, or the disk is full.
        """
        read = 0
        for done, was_read in self.following(poses, removed):
            progress(done)
            read += was_read
        return read

    def following(
        self,
        poses: Mapping[int, Array],
        removed: Collection[int] = (),
        changed: Collection[int] = (),
    ) -> Iterator[tuple[int, bool]]:
        """``follow`` in steps of at most one frame: how many were looked at, whether it was read.

        Frames that were ``changed`` are taken as moved. Between the steps other frames may be
        added; until the last one ``stale`` blocks are not complete, and it must not begin anew.
        Frames that cannot be read again are taken out of all their blocks in the end.
        """
        gone = [n for n in removed if n in self._parts]
        known = {n: T for n, T in poses.items() if n in self._parts and n not in gone}
        moved = {n: T for n, T in known.items() if n in changed or self._has_moved(n, T)}
        if not moved and not gone:
            return
        self._clear((*moved, *gone))
        for number in gone:
            del self._parts[number]
        done, lost = 0, list[int]()
        for done, (number, part) in enumerate(list(self._parts.items())):
            if number not in moved and not part.on(self.stale):
                yield done, False
                continue
            frame = self._load(number, moved.get(number, part.T_world_camera))
            if frame is None and number in moved:
                del self._parts[number]
            elif frame is None:
                lost.append(number)
            elif number in moved:
                self.add(number, frame)
            else:
                self._complete(number, frame)
            yield done, True
        self.stale = torch.zeros(0, dtype=torch.bool)
        yield from ((done, was_read) for _, was_read in self.following({}, lost))

    def _complete(self, number: int, frame: DepthFrame) -> None:
        """Integrate a frame that has not moved into the stale blocks again."""
        self.stale = _grown(self.stale, len(self.volume))  # by frames that moved
        blocks = self.volume.integrate(frame, self.stale)
        self._parts[number] = self._parts[number].also(blocks, len(self.volume))

    def _clear(self, numbers: Collection[int]) -> None:
        """Clear the blocks that some frames changed, which are stale from here on."""
        self.stale = torch.zeros(len(self.volume), dtype=torch.bool)
        for number in numbers:
            self._parts[number].mark(self.stale)
        self.volume.clear(self.stale)
        self._changed = _grown(self._changed, len(self.volume)) | self.stale

    def _has_moved(self, number: int, T_world_camera: Array) -> bool:
        was = self._parts[number].T_world_camera
        return displacement_m(was, T_world_camera) > self.volume.voxel_m

    def save(self, path: Path, made_of: Header) -> None:
        """Write which frames are in the kept volume of this folder, and of what they are made.

        The volume is not used any more. Raises InputError: the disk is full.
        """
        self.volume.close()
        parts = list(self._parts.values())
        poses = [part.T_world_camera for part in parts]
        arrays: Arrays = {
            "keys": self.volume.keys,
            "numbers": np.array(list(self._parts), np.int64),
            "poses": np.stack(poses) if poses else np.zeros((0, 4, 4)),
            "sizes": np.array([len(part.packed) for part in parts], np.int64),
            "packed": np.frombuffer(b"".join(part.packed for part in parts), np.uint8),
        }
        write_arrays(path, VOLUME_FILE, {"made_of": made_of}, arrays)

    def restore(self, arrays: Arrays) -> None:
        """Know the frames that ``save`` wrote, whose volume this has."""
        ends = np.cumsum(arrays["sizes"])
        packed = arrays["packed"].tobytes()
        for number, T, size, end in zip(
            arrays["numbers"].tolist(), arrays["poses"], arrays["sizes"], ends, strict=True
        ):
            self._parts[number] = _Part(T, packed[end - size : end])


def read_kept(path: Path, made_of: Header) -> Arrays | None:
    """What ``save`` wrote; None if it is missing, broken or made of something else.

    The file is removed: from here on the volume beside it is not what it says.
    """
    try:
        header, arrays = read_arrays(path, VOLUME_FILE)
        check_like(arrays, _NOTHING, path)
    except InputError:
        return None
    path.unlink()
    if header.get("made_of") != made_of or not tables_fit(path.parent, len(arrays["keys"])):
        return None
    total = arrays["sizes"].sum() == len(arrays["packed"]) and (arrays["sizes"] >= 0).all()
    alike = len(arrays["numbers"]) == len(arrays["poses"]) == len(arrays["sizes"])
    sound = np.isfinite(arrays["poses"]).all() and len(np.unique(arrays["keys"])) == len(
        arrays["keys"]
    )
    return arrays if total and alike and sound and _are_packed(arrays) else None


def _are_packed(arrays: Arrays) -> bool:
    """Whether each frame's bits can be unpacked, and are not more than the blocks."""
    packed, most = arrays["packed"].tobytes(), -(-len(arrays["keys"]) // 8)
    for size, end in zip(arrays["sizes"], np.cumsum(arrays["sizes"]), strict=True):
        unpacker = zlib.decompressobj()
        try:
            bits = unpacker.decompress(packed[end - size : end], most + 1)
        except zlib.error:
            return False
        if len(bits) > most or not unpacker.eof:
            return False
    return True


def _grown(marks: Tensor, size: int) -> Tensor:
    """Marks (B,) of more blocks, the new ones not marked."""
    return torch.nn.functional.pad(marks, (0, size - len(marks)))


def displacement_m(T_world_a: Array, T_world_b: Array) -> float:
    """How far the camera, or a point REACH_M ahead at the edges of its view, moved at the most."""
    points = REACH_M * np.array([[0.0, 0, 0], [1, 0, 1], [-1, 0, 1], [0, 1, 1], [0, -1, 1]])
    apart = transform(T_world_a, points) - transform(T_world_b, points)
    return float(np.linalg.norm(apart, axis=1).max())
