"""Several recordings as one, one after the other: what a merged map was made from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bmask_slam.evaluation.recordings import COLOUR_MARGIN_S, CURE, Part, read_parts
from bmask_slam.graph.arrays import Array, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.sequences.lists import ImageList, sorted_list
from bmask_slam.sequences.recording import Recording

DEPTH_MARGIN_S = 0.1
"""Depth images so much before the first colour image of a part and after its last one belong to
it."""

OpenOne = Callable[[Path, "Path | Camera | None"], Recording]


@dataclass(frozen=True, eq=False)
class JoinedRecording(Recording):
    """Images of several recordings; each is decoded as its own recording does it."""

    of: dict[Path, Recording] = field(default_factory=dict)

    def read_rgb(self, file: Path, camera: Camera) -> Image:
        """The colour image (H, W, 3), red first. Raises InputError."""
        return self.of[file].read_rgb(file, camera)

    def registered_depth(self, file: Path, camera: Camera) -> NDArray:
        """Stored depth (H, W), z-depth registered to ``camera``. Raises InputError."""
        return self.of[file].registered_depth(file, camera)


def open_joined(path: Path, camera: Path | Camera | None, open_one: OpenOne) -> Recording:
    """Open a list of recordings, which have one camera; their ground truths are not joined.

    Raises:
        InputError: the list or a recording in it is broken or not there.
    """
    parts = read_parts(path)
    children = [_open_child(path, part, camera, open_one) for part in parts]
    first, of = children[0], dict[Path, Recording]()
    lists: list[ImageList] = []
    for name, margin_s in (("rgb", COLOUR_MARGIN_S), ("depth", DEPTH_MARGIN_S)):
        stamps_s: list[Array] = []
        files: list[Path] = []
        for part, child in zip(parts, children, strict=True):
            images: ImageList = getattr(child, name)
            inside = images.timestamps_s >= part.begin_s - margin_s
            inside &= images.timestamps_s <= part.end_s + margin_s
            stamps_s.append(images.timestamps_s[inside] + part.shift_s)
            own = [images.files[k] for k in np.flatnonzero(inside).tolist()]
            of |= dict.fromkeys(own, child)
            files += own
        if not files:
            raise InputError(f"{path}: no image of its recordings is within its stamps; {CURE}")
        lists.append(sorted_list(path, np.concatenate(stamps_s), files))
    return JoinedRecording(
        "joined",
        path,
        lists[0],
        lists[1],
        first.camera,
        first.camera_source,
        exists=lambda file: of[file].exists(file),
        of=of,
    )


def _open_child(
    path: Path, part: Part, camera: Path | Camera | None, open_one: OpenOne
) -> Recording:
    try:
        return open_one(Path(part.sequence), camera)
    except OSError as error:  # such as a name that is too long
        raise InputError(f"{path}: {part.sequence[:100]}: {error.strerror}; {CURE}") from error
