"""An RGB-D sequence: its camera, stamps and ground truth, and an iterator over its frames."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import numpy as np

from bmask_slam.graph.arrays import Array, Floats, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.sequences.bags.topics import split_path
from bmask_slam.sequences.formats.layouts import open_recording
from bmask_slam.sequences.frame import Frame
from bmask_slam.sequences.images import depth_between, working_camera
from bmask_slam.sequences.lists import image_name, pair_images
from bmask_slam.sequences.prefetch import prefetched
from bmask_slam.sequences.recording import Recording

T = TypeVar("T")
logger = logging.getLogger(__name__)

DECODED = 4
"""Depth images that are kept in memory: with a delay, the next frames need them again."""


@dataclass(frozen=True)
class SequenceConfig:
    """How a sequence is read.

    Attributes:
        max_time_difference_s: largest difference between the stamps of a colour/depth pair.
        max_broken_share: share of broken frames above which the sequence is refused; a single
            one is always skipped.
        depth_check_frames: number of frames that are searched for depth when the first has none.
    """

    max_time_difference_s: float = 0.02
    max_broken_share: float = 0.2
    depth_check_frames: int = 5


class Sequence:
    """Registered RGB-D frames in the order of their stamps; made by ``open_sequence``.

    Attributes:
        name: the name of the folder or file.
        folder: the folder or file; `open_sequence` opens it again.
        recording: its images, and how they are decoded.
        camera: the colour camera to which depth is registered.
        camera_source: source of the camera's parameters.
        pairs: the images with their stamps.
        groundtruth: T_world_camera of the colour camera, or None.
    """

    def __init__(self, recording: Recording, camera: Camera, config: SequenceConfig) -> None:
        """Raises InputError: no colour and depth image belong together."""
        self.folder = recording.path
        self.name = split_path(recording.path)[0].resolve().stem
        if recording.path.is_dir():
            self.name = recording.path.resolve().name
        self.recording = recording
        self.camera = camera
        self.camera_source = recording.camera_source
        self.groundtruth = recording.groundtruth
        self.config = config
        limit_s, offset_s = config.max_time_difference_s, camera.depth_time_offset_s
        lists = recording.rgb, recording.depth
        self.pairs = pair_images(*lists, limit_s, offset_s, recording.path)
        self._skipped: dict[int, str] = {}
        self._read_depth = lru_cache(DECODED)(lambda path: recording.read_depth(path, camera))

    def __len__(self) -> int:
        return len(self.pairs.timestamps_s)

    @property
    def timestamps_s(self) -> Array:
        """Stamps (N,) of the colour images, increasing."""
        return self.pairs.timestamps_s

    @property
    def skipped(self) -> list[tuple[int, str]]:
        """Index and reason of every broken frame found so far."""
        return sorted(self._skipped.items())

    def load(self, index: int) -> Frame:
        """Decode one frame.

        Raises:
            InputError: its colour or depth image is broken, or there is no such frame.
        """
        if not 0 <= index < len(self):
            raise InputError(f"{self.folder}: no frame {index}; there are 0 to {len(self) - 1}")
        depth = self.depth(index)
        return self._frame(index, self.rgb(index), *depth)

    def _frame(self, index: int, rgb: Image, depth_m: Floats, lag_s: float) -> Frame:
        stamp_s, file = float(self.pairs.timestamps_s[index]), self.pairs.rgb_files[index]
        return Frame(index, stamp_s, rgb, depth_m, image_name(file, self.folder), lag_s)

    def rgb(self, index: int) -> Image:
        """The colour image (H, W, 3) of a frame. Raises InputError for a broken one."""
        return self.recording.read_rgb(self.pairs.rgb_files[index], self.camera)

    def with_camera(self, camera: Camera) -> Sequence:
        """The same images, paired by another camera's ``depth_time_offset_s``."""
        return Sequence(self.recording, camera, self.config)

    def with_delay(self, depth_time_offset_s: float) -> Sequence:
        """The same images, paired by another delay; what is decoded for one is there for both."""
        found = self.with_camera(replace(self.camera, depth_time_offset_s=depth_time_offset_s))
        found._read_depth = self._read_depth
        return found

    def depth(self, index: int) -> tuple[Floats, float]:
        """The depth (H, W) of a frame in metres, and its lag, as in `Frame`.

        It is interpolated at the colour image's stamp where depth has a time offset. Raises
        InputError for a broken image.
        """
        depth_m = self._read_depth(self.pairs.depth_files[index])
        other, offset_s = self.pairs.neighbour_files[index], self.camera.depth_time_offset_s
        lag_s = float(self.pairs.lags_s[index]) - offset_s
        if offset_s == 0 or other is None:
            return depth_m, lag_s
        try:
            other_m = self._read_depth(other)
        except InputError as error:
            logger.warning("frame %d: its depth is not interpolated: %s", index, error)
            return depth_m, lag_s
        share = float(self.pairs.neighbour_shares[index])
        return depth_between(depth_m, other_m, share), -offset_s

    def frames(
        self, start: int = 0, stop: int | None = None, stride: int = 1, prefetch: int = 4
    ) -> Generator[Frame, None, None]:
        """Decode the frames ``start:stop:stride``, up to ``prefetch`` ahead.

        Colour and depth have a thread each. Nothing else is done there: it would wait for the
        interpreter lock again and again, and whoever has it for the thread. Broken frames are
        skipped with a warning and listed in ``skipped``.

        Raises:
            InputError: more than ``max_broken_share`` of the sequence is broken.
            ValueError: a stride below 1.
        """
        if stride < 1:
            raise ValueError(f"stride {stride} must be at least 1")
        return self._decoded(range(len(self))[start:stop:stride], prefetch)

    def _decoded(self, indices: range, prefetch: int) -> Generator[Frame, None, None]:
        with (
            closing(prefetched(_read_each(self.rgb, indices), prefetch)) as colours,
            closing(prefetched(_read_each(self.depth, indices), prefetch)) as depths,
        ):
            for index, rgb, depth in zip(indices, colours, depths, strict=True):
                if isinstance(depth, InputError):
                    self.skip(index, str(depth))
                elif isinstance(rgb, InputError):
                    self.skip(index, str(rgb))
                else:
                    yield self._frame(index, rgb, *depth)

    def skip(self, index: int, reason: str) -> None:
        """Record a broken frame; refuse the sequence when there are too many."""
        if index not in self._skipped:
            logger.warning("frame %d skipped: %s", index, reason)
        self._skipped[index] = reason
        if len(self._skipped) > max(1, self.config.max_broken_share * len(self)):
            raise InputError(
                f"{self.folder}: {len(self._skipped)} of {len(self)} frames are broken, the last: "
                f"{reason}"
            )


def _read_each(read: Callable[[int], T], indices: range) -> Iterator[T | InputError]:
    """What is read for each index, or why it cannot be read."""
    for index in indices:
        try:
            yield read(index)
        except InputError as error:
            yield error


def open_sequence(
    path: str | os.PathLike[str],
    config: SequenceConfig | None = None,
    camera: str | os.PathLike[str] | Camera | None = None,
    full_size: bool = False,
) -> Sequence:
    """Open a recording in any layout of docs/data.md: TUM's, others' folders, files, ROS bags.

    ``camera``, a file or a camera, replaces its own. Large images are reduced, as
    `images.working_camera` says, but not with ``full_size``, or a camera that is given.
    Images may be in any order. All checks that need not decode every image are done here.

    Raises:
        InputError: naming the file, the value and the cure.
    """
    given = camera if camera is None or isinstance(camera, Camera) else Path(camera)
    recorded = given.recorded() if isinstance(given, Camera) else given
    recording = open_recording(Path(path), recorded)
    own = recording.camera
    used = given if isinstance(given, Camera) else own if full_size else working_camera(own)
    sequence = Sequence(recording, used, config or SequenceConfig())
    if used.reduced_by > 1:
        sizes = f"{own.width}x{own.height}, reduced to {used.width}x{used.height}"
        sequence.camera_source += f", images of {sizes}"
    _check_images(sequence)
    truth = sequence.groundtruth is not None
    text = "%s, %s: %d frames, ground truth: %s"
    logger.info(text, path, recording.layout, len(sequence), truth)
    return sequence


def _check_images(sequence: Sequence) -> None:
    """Decode the first pair, search for depth, and record every listed image that is missing."""
    first = sequence.load(0)
    for index, files in enumerate(
        zip(sequence.pairs.rgb_files, sequence.pairs.depth_files, strict=True)
    ):
        for file in files:
            if not sequence.recording.exists(file):
                sequence.skip(index, f"{file}: no such image; restore it or correct the list")
    if np.isnan(first.depth_m).all() and not _has_depth(sequence):
        raise InputError(
            f"{sequence.pairs.depth_files[0]}: no depth at all, every value is 0 here and in "
            f"{sequence.config.depth_check_frames} frames of the sequence; check the depth images"
        )


def _has_depth(sequence: Sequence) -> bool:
    """Whether any of a few frames, spread over the sequence, holds depth."""
    spread = np.linspace(0, len(sequence) - 1, sequence.config.depth_check_frames, dtype=int)
    for index in np.unique(spread):
        try:
            frame = sequence.load(int(index))
        except InputError:
            continue
        if np.isfinite(frame.depth_m).any():
            return True
    return False
