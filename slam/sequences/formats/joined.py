"""Several recordings as one, one after the other: what a merged map was made from.

``recordings.json`` lists them, each with the part of its stamps that counts and with what is added
to them, so that no two overlap.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from bmask_slam.graph.arrays import Array, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import MAX_NUMBER, InputError
from bmask_slam.graph.files.json_file import STRICT, read_json
from bmask_slam.sequences.lists import ImageList, sorted_list
from bmask_slam.sequences.recording import Recording

JOINED = "recordings.json"
COLOUR_MARGIN_S, DEPTH_MARGIN_S = 1e-4, 0.1
"""Images so much before the first colour image of a part and after its last one belong to it."""
CURE = "merge the runs again"


class Part(BaseModel):
    """A recording, and which of it counts.

    Attributes:
        sequence: its folder or file.
        begin_s, end_s: stamps of the first and the last colour image, in its own clock.
        shift_s: added to its stamps.
    """

    model_config = STRICT
    sequence: str
    begin_s: float
    end_s: float
    shift_s: float


class _File(BaseModel):
    """What recordings.json holds."""

    model_config = STRICT
    recordings: list[Part]


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


def is_joined(path: Path) -> bool:
    """Whether a path is named as a list of recordings."""
    return path.name == JOINED


def write_parts(path: Path, parts: Sequence[Part]) -> None:
    """Write recordings.json."""
    content = {"recordings": [part.model_dump() for part in parts]}
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def read_parts(path: Path) -> list[Part]:
    """Read recordings.json. Raises InputError for a broken one."""
    listed = read_json(path, _File, CURE).recordings
    if not listed:
        raise InputError(f"{path}: lists no recording; {CURE}")
    for part in listed:
        if is_joined(Path(part.sequence)):
            raise InputError(f"{path}: lists another list, {part.sequence}; {CURE}")
        if not max(map(abs, (part.begin_s, part.end_s, part.shift_s))) <= MAX_NUMBER:
            raise InputError(f"{path}: stamps from {part.begin_s} s are no seconds; {CURE}")
    return listed


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
