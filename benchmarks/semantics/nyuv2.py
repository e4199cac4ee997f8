"""The labelled images of NYU Depth v2: half of them, 40 classes, the official split.

Colour images alone: this copy has no depth. Code 39 (otherprop, or not labelled) is ignored.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from benchmarks.paths import SHARED
from bmask_slam.graph.arrays import Bytes, Image
from bmask_slam.semantics.instances.image_files import decode_image, read_colour
from bmask_slam.semantics.training.stuff_images import IGNORED

NYUV2 = SHARED / "nyuv2"
CLASSES = 39
GROUPS = (
    *("bed", "books", "ceiling", "chair", "floor", "furniture", "objects", "picture", "sofa"),
    *("table", "television", "wall", "window"),
)
"""The 13 classes of Couprie et al. 2013, as A. Handa's nyuv2-meta-data has them."""
_GROUPS_FROM_1 = (
    *(12, 5, 6, 1, 4, 9, 10, 12, 13, 6, 8, 6, 13, 10, 6, 13, 6, 7, 7, 5, 7, 3, 2, 6, 11),
    *(7, 7, 7, 7, 7, 7, 6, 7, 7, 7, 7, 7, 7, 6),
)
GROUP_OF = np.array(_GROUPS_FROM_1) - 1
"""(39,) the group of each of the 39 classes."""


def numbers(part: str) -> list[int]:
    """The images of "train" or "test"."""
    lines = (NYUV2 / "split.txt").read_text(encoding="utf-8").split("\n")
    rows = [line.split() for line in lines if line]
    return [int(number) for number, which in rows if which == part]


def labelled(chosen: list[int]) -> Iterator[tuple[Image, Bytes]]:
    """Images (H, W, 3), red first, with classes (H, W): 0..38, or IGNORED."""
    for number in chosen:
        labels = decode_image(NYUV2 / "labels" / f"{number}.png", cv2.IMREAD_UNCHANGED)
        image = read_colour(NYUV2 / "images" / f"{number}.jpg")
        yield image, np.where(labels < CLASSES, labels, IGNORED).astype(np.uint8)
