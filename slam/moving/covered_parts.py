"""Parts of the image that do not show the room: the robot itself, an overlay, dirt on the lens.

Their corners stand still while the room moves through the image, which is also how a camera at rest
sees a room in which much moves. So they are looked for in pairs of images, a moment apart, over the
whole recording, before anything is tracked: what stands still in nearly all pairs in which most of
the image changes is attached to the camera, if the rest of the image stands still in none.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from bmask_slam.graph.arrays import Array, Floats, Image, Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.sequences.frame import Frame, check_frame
from bmask_slam.sequences.sequence import Sequence

WIDTH_PX, CELL_PX = 320, 8
"""Of the images that are compared, and of the square cells that are told apart in them."""
APART_S, MAX_APART_S = 0.3, 1.0
PAIRS, ENOUGH, FEWEST = 120, 32, 12
"""Pairs that are looked at; with most of the image moving: so many are enough, and are needed."""
BLUR_PX = 0.6
LEAST_CONTRAST = 4.0
"""In grey levels: mean distance from the cell's mean. A cell with less has no corners."""
STILL, MOVED = 0.25, 0.5
"""Mean change of a cell, below and above."""
MOST_MOVES, LEAST_CELLS = 0.4, 30
"""A pair counts if so large a share of the cells with contrast moved, and so many of them."""
SEEN_SHARE, SEEN_PAIRS = 0.3, 6
"""A cell is judged if it had contrast in so large a share of the pairs, and in so many."""
ALWAYS, OFTEN = 0.75, 0.4
"""A covered part holds a cell that stood still in the first share of its pairs; all its cells did
in the second."""
RESTLESS, MAX_RESTLESS = 0.3, 0.02
"""Of the other cells so small a share may stand still in more than so many of the pairs."""
MAX_COVERED = 0.7
"""Of the image; more is no part of it."""
WHAT = "the robot itself, an overlay or dirt on the lens"

Rectangles = tuple[tuple[int, int, int, int], ...]


@dataclass(frozen=True, eq=False)
class Cells:
    """A small grey image as cells (R, C, CELL_PX, CELL_PX), less their means, over their contrasts.

    So light that changes is no motion. Contrast (R, C) is the mean distance from the mean.
    """

    grey: Floats
    contrast: Floats

    @classmethod
    def of(cls, rgb: Image) -> Cells:
        """Those of a colour image (H, W, 3)."""
        height, width = rgb.shape[:2]
        size = WIDTH_PX, max(round(height * WIDTH_PX / width), CELL_PX)
        small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
        grey = cv2.GaussianBlur(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), (0, 0), BLUR_PX)
        rows, columns = size[1] // CELL_PX, size[0] // CELL_PX
        tiles = grey[: rows * CELL_PX, : columns * CELL_PX].astype(np.float32)
        tiles = tiles.reshape(rows, CELL_PX, columns, CELL_PX).swapaxes(1, 2)
        tiles = tiles - tiles.mean(axis=(2, 3), keepdims=True)
        contrast = np.abs(tiles).mean(axis=(2, 3))
        return cls(tiles / np.maximum(contrast, LEAST_CONTRAST)[..., None, None], contrast)


class CoveredParts:
    """Counts in how many pairs of images each cell stood still."""

    def __init__(self) -> None:
        self.pairs = 0
        """In which most of the image moved."""
        self._seen, self._still = np.zeros((2, 0, 0), np.int64)

    def add(self, before: Cells, after: Cells) -> None:
        """Take a pair of images, a moment apart, into account."""
        seen = np.maximum(before.contrast, after.contrast) > LEAST_CONTRAST
        change = np.abs(before.grey - after.grey).mean(axis=(2, 3))
        moved = np.count_nonzero(seen & (change > MOVED))
        if moved < max(MOST_MOVES * np.count_nonzero(seen), LEAST_CELLS):
            return
        if not self.pairs:
            self._seen, self._still = np.zeros((2, *seen.shape), np.int64)
        self.pairs += 1
        self._seen += seen
        self._still += seen & (change < STILL)

    def cells(self) -> Mask:
        """(R, C) those that are attached to the camera, none as long as that is not sure."""
        if not self.pairs:
            return np.zeros((0, 0), bool)
        judged = self._seen >= max(SEEN_SHARE * self.pairs, SEEN_PAIRS)
        share = np.where(judged, self._still / np.maximum(self._seen, 1), 0.0)
        found = _reached((share >= OFTEN).astype(np.uint8), share >= ALWAYS)
        others = judged & (cv2.dilate(found.astype(np.uint8), np.ones((3, 3))) == 0)
        restless = np.count_nonzero(others & (share > RESTLESS))
        sure = restless <= MAX_RESTLESS * np.count_nonzero(others)
        if not (sure and found.any() and self.pairs >= FEWEST and found.mean() <= MAX_COVERED):
            return np.zeros_like(found)
        closed = cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5)))
        return found | ((closed > 0) & ~judged)


def _reached(candidates: Image, seeds: Mask) -> Mask:
    """The connected candidates (R, C) that hold a seed."""
    _, parts = cv2.connectedComponents(candidates, connectivity=8)
    return np.asarray((candidates > 0) & np.isin(parts, np.unique(parts[seeds])))


class CoveredWatch:
    """Looks at the images of a camera that runs, until something is found or surely nothing is."""

    def __init__(self) -> None:
        self._parts, self._due = CoveredParts(), FEWEST
        self._last: tuple[float, Cells | None] = (-np.inf, None)

    def look(self, frame: Frame, camera: Camera) -> tuple[Camera, str] | None:
        """The camera with what is covered, and that in words, once it is known.

        Raises:
            InputError: as `check_frame`.
        """
        (then_s, before), now_s = self._last, frame.timestamp_s
        if now_s - then_s < APART_S or self._due > PAIRS:
            return None
        cells = Cells.of(check_frame(frame, camera).rgb)
        if before is not None and now_s - then_s <= MAX_APART_S:
            self._parts.add(before, cells)
        self._last = now_s, cells
        if self._parts.pairs < self._due:
            return None
        self._due *= 2
        parts = rectangles_of(self._parts.cells(), (camera.width, camera.height))
        return _told(camera, parts) if parts else None


def covered_camera(sequence: Sequence, frames: range) -> tuple[Camera, str]:
    """The camera of a sequence with what these frames show of ``covered``, and that in words.

    Without a finding the camera is the sequence's and the text is empty.
    """
    camera, stamps_s = sequence.camera, sequence.timestamps_s[np.array(frames, np.int64)]
    size = camera.width, camera.height
    parts = find_covered_parts(lambda k: sequence.rgb(frames[k]), stamps_s, size)
    return _told(camera, parts) if parts else (camera, "")


def _told(camera: Camera, parts: Rectangles) -> tuple[Camera, str]:
    found = replace(camera, covered=parts)
    return found, f"{1 - found.visible().mean():.1%} of the image never moves: {WHAT}"


def with_verdict(text: str, used: bool) -> str:
    """What was found, and what became of it."""
    return f"{text}: {'left out' if used else 'found, not left out'}"


def find_covered_parts(
    read: Callable[[int], Image], stamps_s: Array, size: tuple[int, int]
) -> Rectangles:
    """The covered parts of images (width, height) in a recording, as ``Camera.covered``.

    Args:
        read: gives the colour image of a frame; one that raises InputError is left out.
        stamps_s: (N,) of the frames.
    """
    parts = CoveredParts()
    for first, second in _pairs(stamps_s):
        try:
            parts.add(Cells.of(read(first)), Cells.of(read(second)))
        except InputError:
            continue
        if parts.pairs >= ENOUGH:
            break
    return rectangles_of(parts.cells(), size)


def _pairs(stamps_s: Array) -> list[tuple[int, int]]:
    """Frames about ``APART_S`` apart; any first few pairs are spread over the whole recording."""
    after = np.searchsorted(stamps_s, stamps_s + APART_S)
    first = np.flatnonzero(after < len(stamps_s))
    first = first[stamps_s[after[first]] - stamps_s[first] <= MAX_APART_S]
    chosen = first[np.linspace(0, len(first) - 1, min(PAIRS, len(first))).astype(int)]
    chosen = chosen[_spread_order(len(chosen))]
    return list(zip(chosen.tolist(), after[chosen].tolist(), strict=True))


def _spread_order(count: int) -> Ints:
    """The numbers below ``count`` in the order of van der Corput's sequence."""
    digits = max(count - 1, 1).bit_length()
    numbers = np.arange(2**digits)
    swapped = sum(((numbers >> k) & 1) << (digits - 1 - k) for k in range(digits))
    order = np.asarray(swapped, np.int64)
    return order[order < count]


def rectangles_of(cells: Mask, size: tuple[int, int]) -> Rectangles:
    """Cells (R, C) as rectangles of images (width, height): runs of a row, joined downward."""
    scale = size[0] / WIDTH_PX * CELL_PX
    found: list[tuple[int, int, int, int]] = []
    above: dict[tuple[int, int], int] = {}
    for row, line in enumerate(cells):
        edges = np.flatnonzero(np.diff(np.r_[False, line, False])).reshape(-1, 2)
        runs: dict[tuple[int, int], int] = {}
        for first, end in edges.tolist():
            run = first, end
            top = above.get(run, len(found))
            if top == len(found):
                found.append((first, row, end, row))
            found[top] = (*found[top][:3], row + 1)
            runs[run] = top
        above = runs
    rows, columns = cells.shape
    return tuple(
        (
            round(left * scale),
            round(top * scale),
            size[0] if right == columns else round(right * scale),
            size[1] if bottom == rows else round(bottom * scale),
        )
        for left, top, right, bottom in found
    )
