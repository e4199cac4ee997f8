"""Any recording as a folder in TUM layout."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bmask_slam.evaluation.reference import (
    TRUTH,
    TRUTH_BODY,
    TruthBody,
    find_truth_body,
)
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.reading import MAX_TEXT_BYTES, read_bytes
from bmask_slam.graph.files.whole_file import whole_folder
from bmask_slam.graph.sensors.streams import FILES
from bmask_slam.graph.trajectory import write_tum
from bmask_slam.semantics.instances.image_files import write_image
from bmask_slam.sequences.cameras import write_camera
from bmask_slam.sequences.formats.layouts import open_recording
from bmask_slam.sequences.lists import IMAGE_SUFFIXES, ImageList
from bmask_slam.sequences.recording import Recording

logger = logging.getLogger(__name__)

METRE, MIN_SCALE = 5000.0, 1000.0
"""Stored depth of one metre where the recording's is below the second, as of float32 metres."""
MAX_STORED = 65535
LEFT_BEHIND = ("right.txt", "annotations.json", "mav0/imu0/data.csv", "imu0/data.csv")
"""Files of a recording that are not carried over; a warning names them."""
Progress = Callable[[int, int], None]


@dataclass
class Converted:
    """What was written.

    Attributes:
        layout: of the recording.
        colour, depth: images.
        broken: images that could not be read, and were left out.
        too_far: depth values beyond what 16 bits hold, written as missing.
        copied: files of sensors.
    """

    layout: str
    colour: int = 0
    depth: int = 0
    broken: int = 0
    too_far: int = 0
    copied: tuple[str, ...] = ()

    def __str__(self) -> str:
        text = f"{self.layout}: {self.colour} colour and {self.depth} depth images"
        if self.broken:
            text += f", {self.broken} broken ones left out"
        text += "".join(f", {name}" for name in self.copied)
        return text + (f", {self.too_far} depths too far for 16 bits" if self.too_far else "")


def convert(
    source: Path,
    folder: Path,
    camera: Path | None = None,
    max_images: int | None = None,
    progress: Progress = lambda done, total: None,
) -> Converted:
    """Write ``folder``, which must not be there; it appears when it is complete.

    Stamps stay as they are; depth is registered to colour, and a ``depth_scale`` below 1000 to the
    metre becomes 5000. The files of sensors beside the images are copied.

    Raises:
        InputError: the recording cannot be read, holds no readable image, the folder is there, or
            ``max_images`` is below 1.
    """
    if max_images is not None and max_images < 1:
        raise InputError(f"--max-frames {max_images}: must be a whole number of at least 1")
    if folder.exists():
        raise InputError(f"{folder}: is there already; give the name of a new folder")
    recording = open_recording(source, camera)
    written = Converted(recording.layout)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with whole_folder(folder) as out:
        images = _Images(recording, out, written)
        colour, depth = (_first(each, max_images) for each in (recording.rgb, recording.depth))
        total = len(colour.files) + len(depth.files)
        written.colour = images.write("rgb", colour, lambda done: progress(done, total))
        before = len(colour.files)
        written.depth = images.write("depth", depth, lambda done: progress(before + done, total))
        if not written.colour or not written.depth:
            raise InputError(f"{source}: no image in it can be read; see the warnings")
        saved = replace(recording.camera, depth_scale=images.factor * recording.camera.depth_scale)
        write_camera(out / "camera.yaml", saved, f"{recording.layout}: {recording.camera_source}")
        if recording.groundtruth is not None:
            write_tum(out / TRUTH, recording.groundtruth)
            if find_truth_body(recording.path) or find_truth_body(folder):
                (out / TRUTH_BODY).write_text(TruthBody().yaml(), encoding="utf-8")  # the camera
        written.copied = _copy_sensors(recording.path, out)
    return written


def _copy_sensors(source: Path, out: Path) -> tuple[str, ...]:
    """Copy the files of sensors that are plain files; a warning names what else stays behind."""
    copied = []
    for name in FILES.values():
        path = source / name
        if path.is_symlink():
            logger.warning("not carried over: %s, which is a link", path)
        elif path.is_file():
            (out / name).write_bytes(read_bytes(path, "correct or remove it", MAX_TEXT_BYTES))
            copied.append(name)
    for name in LEFT_BEHIND:
        if (source / name).is_file():
            logger.warning("not carried over: %s", source / name)
    return tuple(copied)


def _first(images: ImageList, count: int | None) -> ImageList:
    return ImageList(images.timestamps_s[:count], images.files[:count])


class _Images:
    """Writes the images of a recording to a folder.

    Attributes:
        factor: from the recording's stored depth to that of the images written.
    """

    def __init__(self, recording: Recording, out: Path, written: Converted) -> None:
        scale = recording.camera.depth_scale
        self.factor = 1.0 if scale >= MIN_SCALE else METRE / scale
        self._recording, self._out, self._written = recording, out, written

    def write(self, kind: str, images: ImageList, progress: Callable[[int], None]) -> int:
        """Write ``rgb`` or ``depth`` and its list; returns how many could be read."""
        (self._out / kind).mkdir()
        write = self._colour if kind == "rgb" else self._depth
        lines = []
        for k, (stamp_s, file) in enumerate(zip(images.timestamps_s, images.files, strict=True)):
            progress(k + 1)
            try:
                name = write(file, f"{kind}/{k:06d}")
            except InputError as error:
                self._written.broken += 1
                logger.warning("left out: %s", error)
            else:
                lines.append(f"{stamp_s:.9f} {name}\n")
        (self._out / f"{kind}.txt").write_text("".join(lines), encoding="utf-8")
        return len(lines)

    def _colour(self, file: Path, stem: str) -> str:
        """Copy an image file, or encode what is none; returns its name."""
        rgb = self._recording.read_rgb(file, self._recording.camera)
        suffix = file.suffix.lower()
        if suffix in IMAGE_SUFFIXES and file.is_file():
            shutil.copyfile(file, self._out / f"{stem}{suffix}")
            return f"{stem}{suffix}"
        write_image(self._out / f"{stem}.png", rgb)
        return f"{stem}.png"

    def _depth(self, file: Path, stem: str) -> str:
        """Write stored values times the factor, 0 where there is none; returns the name."""
        stored = self._recording.registered_depth(file, self._recording.camera)
        values = np.nan_to_num(np.rint(stored * self.factor), nan=0.0, posinf=0.0, neginf=0.0)
        self._written.too_far += int(np.count_nonzero(values > MAX_STORED))
        values = np.where((values > 0) & (values <= MAX_STORED), values, 0).astype(np.uint16)
        write_image(self._out / f"{stem}.png", values)
        return f"{stem}.png"
