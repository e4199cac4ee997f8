"""The classes of all pixels of images on disk: a PNG of 16 bits for each, and their label set."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.file_names import check_name, target_below
from bmask_slam.graph.files.whole_file import whole_file
from bmask_slam.semantics.instances.image_files import decode_image, write_image
from bmask_slam.semantics.instances.surfaces import SurfaceClasses
from bmask_slam.semantics.labels import LabelSet, read_label_set

FOLDER, NAMES = "surfaces", "classes.txt"
_FEW_CELLS = 4096
"""A tiny image is enlarged for the network, which may give it more cells than it has pixels."""


def write_surfaces(folder: Path, name: str, seen: SurfaceClasses) -> None:
    """Write FOLDER/name.png, a pixel for each cell: 256 times the label plus 255 times p.

    The label set goes to FOLDER/NAMES. Only the likeliest class of a cell is kept.

    Raises:
        InputError: the folder has classes of another label set.
    """
    names = target_below(folder, f"{FOLDER}/{NAMES}")
    before = surface_labels(folder)
    if before is not None and before != seen.labels:
        raise InputError(
            f"{names}: other classes than the segmenter's; choose another --out or delete {folder}"
        )
    if before is None:
        with whole_file(names) as temporary:
            temporary.write_text("\n".join(seen.labels.names[1:]) + "\n", encoding="utf-8")
    target = target_below(folder, f"{FOLDER}/{name}").with_suffix(".png")
    with whole_file(target) as temporary:
        write_image(temporary, seen.codes())


def surface_labels(folder: Path) -> LabelSet | None:
    """The label set of what ``write_surfaces`` wrote; None if there is nothing."""
    names = folder / FOLDER / NAMES
    return read_label_set(str(names)) if names.is_file() else None


def read_surfaces(
    folder: Path, name: str, labels: LabelSet, size: tuple[int, int]
) -> SurfaceClasses | None:
    """What ``write_surfaces`` wrote of an image (H, W); None if there is no file of it.

    Raises:
        InputError: a broken file, one of another kind, or one that is too large.
    """
    path = (folder / FOLDER / check_name(name, str(folder))).with_suffix(".png")
    if not path.is_file():
        return None
    codes = decode_image(path, cv2.IMREAD_UNCHANGED)
    cure = "make the masks again"
    if codes.size > max(size[0] * size[1], _FEW_CELLS):  # before they get C classes each
        raise InputError(f"{path}: more cells than an image of {size} has pixels; {cure}")
    if codes.ndim != 2 or codes.dtype != np.uint16 or codes.max() >> 8 >= len(labels):
        raise InputError(f"{path}: not the classes of an image's pixels; {cure}")
    cell_px = max(size) / max(codes.shape)
    if any(
        abs(n * cell_px - wanted) > cell_px for n, wanted in zip(codes.shape, size, strict=True)
    ):
        raise InputError(f"{path}: of an image of another shape than {size}; {cure}")
    return SurfaceClasses.from_codes(codes, labels, cell_px, size)
