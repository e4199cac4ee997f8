"""What every part of an image is: classes of things and of stuff, such as walls and floors."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Bytes, Floats
from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.semantics.labels import LabelSet

Codes = NDArray[np.uint16]
LEVELS = MOST_CLASSES = 255
"""Of a probability in the 16 bits of a code; the class is above it."""


@dataclass(frozen=True, eq=False)
class SurfaceClasses:
    """Class probabilities of an image's cells.

    Attributes:
        labels: their label set; column k of the probabilities is of label k + 1.
        probabilities: (h, w, C) float16. Row and column 0 are at the upper left; the cells cover
            the image, the last ones may reach beyond it or end a little before its edge.
        cell_px: edge of a cell.
        size: (H, W) of the image.
    """

    labels: LabelSet
    probabilities: Array
    cell_px: float
    size: tuple[int, int]

    def at(self, pixels: Array) -> Floats:
        """Probabilities (N, C) at pixels (N, 2), linear between the centres of cells."""
        limits = np.array(self.probabilities.shape[1::-1]) - 1
        place = np.clip((pixels + 0.5) / self.cell_px - 0.5, 0, limits)
        low = np.minimum(place.astype(np.int64), np.maximum(limits - 1, 0))
        high = np.minimum(low + 1, limits)
        (x, y), (x0, y0), (x1, y1) = (place - low).T, low.T, high.T
        p = self.probabilities
        upper = (1 - x)[:, None] * p[y0, x0] + x[:, None] * p[y0, x1]
        lower = (1 - x)[:, None] * p[y1, x0] + x[:, None] * p[y1, x1]
        return ((1 - y)[:, None] * upper + y[:, None] * lower).astype(np.float32)

    def pixels(self) -> Floats:
        """Probabilities (H, W, C) of all pixels, linear between the centres of cells."""
        cells = np.asarray(self.probabilities, np.float32)
        height, width = cells.shape[:2]
        whole = np.maximum(np.rint(np.array([width, height]) * self.cell_px), 1).astype(int)
        found = cv2.resize(cells, (int(whole[0]), int(whole[1])), interpolation=cv2.INTER_LINEAR)
        found = found.reshape(whole[1], whole[0], -1)[: self.size[0], : self.size[1]]
        missing = [(0, n - m) for n, m in zip(self.size, found.shape[:2], strict=True)]
        return np.pad(found, (*missing, (0, 0)), "edge") if np.any(missing) else found

    def codes(self) -> Codes:
        """(h, w) uint16: the likeliest label times 256 plus its probability in 255ths.

        Raises:
            InputError: there are more than 255 classes.
        """
        if len(self.labels) - 1 > MOST_CLASSES:
            raise InputError(
                f"surfaces: {len(self.labels) - 1} classes; give at most {MOST_CLASSES}"
            )
        best = self.probabilities.max(axis=2).astype(np.float32)
        label = self.probabilities.argmax(axis=2) + 1
        return (label * (LEVELS + 1) + np.rint(LEVELS * best)).astype(np.uint16)

    @classmethod
    def from_codes(
        cls, codes: Codes, labels: LabelSet, cell_px: float, size: tuple[int, int]
    ) -> SurfaceClasses:
        """The inverse of ``codes``: what is not the likeliest class's is shared by the others."""
        label, best = codes // (LEVELS + 1), (codes % (LEVELS + 1)) / LEVELS
        classes = len(labels) - 1
        p = np.repeat(((1 - best) / max(classes - 1, 1))[..., None], classes, axis=2)
        rows, columns = np.nonzero(label > 0)
        p[rows, columns, label[rows, columns] - 1] = best[rows, columns]
        p[label == 0] = 1 / classes
        return cls(labels, p.astype(np.float16), cell_px, size)


@dataclass(frozen=True, eq=False)
class CodedSurfaces:
    """What is kept of ``SurfaceClasses``: ``codes`` (h, w) of its cells of ``cell_px``."""

    labels: LabelSet
    codes: Codes
    cell_px: float

    def codes_at(self, pixels: Array) -> Codes:
        """Codes (N,) of the cells that pixels (N, 2) are in."""
        limits = np.array(self.codes.shape[::-1]) - 1
        columns, rows = np.clip(((pixels + 0.5) / self.cell_px).astype(np.int64), 0, limits).T
        return self.codes[rows, columns]

    @staticmethod
    def decoded(codes: Codes, labels: LabelSet) -> Floats:
        """Probabilities (N, C) of codes (N,)."""
        cells = SurfaceClasses.from_codes(codes[:, None], labels, 1.0, (len(codes), 1))
        return cells.probabilities[:, 0].astype(np.float32)


def coded(seen: SurfaceClasses) -> CodedSurfaces:
    """The likeliest classes and their probabilities alone."""
    return CodedSurfaces(seen.labels, seen.codes(), seen.cell_px)


class Segmented(list[Instance]):
    """The instances in an image, best first, and what all of it is.

    Attributes:
        surfaces: classes of all pixels; None where the segmenter does not tell.
        up: the side of the image that is up in the world, of `graph.camera.SIDES`; "" where the
            segmenter does not know.
    """

    def __init__(
        self,
        instances: Iterable[Instance] = (),
        surfaces: SurfaceClasses | None = None,
        up: str = "",
    ) -> None:
        super().__init__(instances)
        self.surfaces, self.up = surfaces, up


def surfaces_of(instances: object) -> SurfaceClasses | None:
    """What a segmenter told about all pixels with its instances; None for a plain list."""
    return instances.surfaces if isinstance(instances, Segmented) else None


def up_of(instances: object) -> str:
    """The side of an image that its segmenter knows to be up; "" for a plain list."""
    return instances.up if isinstance(instances, Segmented) else ""


def most_probable(seen: SurfaceClasses) -> tuple[Bytes, Floats]:
    """The likeliest label, from 1, of every pixel (H, W), and its probability (H, W)."""
    p = seen.pixels()
    return (p.argmax(axis=2) + 1).astype(np.uint8), p.max(axis=2)
