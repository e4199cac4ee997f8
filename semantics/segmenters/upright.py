"""Images of a camera that is mounted sideways or upside down, turned upright for a network.

Networks learn from photographs, which are upright: in images that are not they find a fifth to a
half as much, and take a floor for a ceiling.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Floats, Image
from bmask_slam.graph.camera import SIDES
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.semantics.instances.surfaces import Segmented, SurfaceClasses, surfaces_of
from bmask_slam.semantics.segmenters.segmenter import Segmenter, check_image

SAMPLES = 16
"""So many images of a recording are looked at."""
SIDE_PX = 320
"""Their longer side: what a scene looks like as a whole tells its upper side best."""
UPRIGHT_IMAGES, UPRIGHT_EVIDENCE = 4, 3.0
TURNED_IMAGES, TURNED_EVIDENCE = 8, 4.0
TIMES = 2.0
MAX_IMAGES = 60


@dataclass(frozen=True, eq=False)
class Upright:
    """What is known of the side of the images that is up in the world.

    Attributes:
        side: one of SIDES; "" if it is not known.
        samples: ``sample`` of images of the whole recording, which tell it; without them it is
            found from the first images that come.
    """

    side: str = ""
    samples: tuple[Image, ...] = ()


class Finder(Protocol):
    """Finds things in images."""

    def evidence(self, image: Image) -> float:
        """How much is found in an image (H, W, 3): the sum of class scores."""


class UpVotes:
    """Which side of the images is up: the one that a network finds the most with.

    Upright is settled after ``UPRIGHT_IMAGES`` images if with it ``TIMES`` as much is found as
    with any other side, ``UPRIGHT_EVIDENCE`` at least; another side needs more of both. What is
    not settled after ``MAX_IMAGES`` is upright.
    """

    def __init__(self, finder: Finder) -> None:
        self._finder = finder
        self._found, self._images = np.zeros(len(SIDES)), 0

    def add(self, image: Image) -> str:
        """Look at an image (H, W, 3); the side that is up, "" if that is not settled."""
        small = sample(image)
        self._found += [self._finder.evidence(turned(small, k)) for k in range(len(SIDES))]
        self._images += 1
        best = int(self._found.argmax())
        clear = self._found[best] >= TIMES * np.delete(self._found, best).max()
        images = TURNED_IMAGES if best else UPRIGHT_IMAGES
        enough = self._found[best] >= (TURNED_EVIDENCE if best else UPRIGHT_EVIDENCE)
        if clear and enough and self._images >= images:
            return SIDES[best]
        return SIDES[0] if self._images >= MAX_IMAGES else ""


class UprightSegmenter:
    """A segmenter whose images are turned so that the world's up is their top.

    Attributes:
        labels: the label set.
        measured: under what name the errors of its masks were measured, "" if they were not.
    """

    def __init__(self, inner: Segmenter, known: Upright, finder: Finder | None = None) -> None:
        """``finder`` finds the side that is up where it is not ``known``."""
        self.labels, self.measured = inner.labels, getattr(inner, "measured", "")
        self._inner, self._side = inner, known.side
        self._samples = known.samples
        self._votes = None if finder is None or known.side else UpVotes(finder)

    def segment(self, image: Image, name: str) -> list[Instance]:
        """Instances in an image (H, W, 3) as it is, found in the turned one."""
        check_image(image, name)
        if self._votes is not None:
            self._vote(self._votes, image)
        turns = SIDES.index(self._side or SIDES[0])
        found = self._inner.segment(turned(image, turns), name)
        return turned_back(found, turns, (image.shape[0], image.shape[1]), self._side)

    def _vote(self, votes: UpVotes, image: Image) -> None:
        """Look for the side that is up, in all samples at once or else in this image."""
        told = map(votes.add, self._samples or (image,))
        self._side = next(filter(None, told), SIDES[0] if self._samples else "")
        if self._side:
            self._votes, self._samples = None, ()


def sample(image: Image) -> Image:
    """An image (H, W, 3), its longer side SIDE_PX at most."""
    factor = SIDE_PX / max(image.shape[:2])
    if factor >= 1:
        return image
    size = max(int(image.shape[1] * factor), 1), max(int(image.shape[0] * factor), 1)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def spread(count: int) -> list[int]:
    """Numbers of SAMPLES of so many frames, spread evenly, in an order that mixes them."""
    chosen = np.unique(np.linspace(0, count - 1, min(SAMPLES, count)).astype(int))
    return np.concatenate([chosen[k::4] for k in range(4)]).tolist() if count else []


def turned(image: NDArray[Any], turns: int) -> NDArray[Any]:
    """An image (H, W, ...), turned anticlockwise by a number of right angles."""
    return np.ascontiguousarray(np.rot90(image, turns)) if turns else image


def turned_back(
    found: Sequence[Instance], turns: int, size: tuple[int, int], side: str
) -> Segmented:
    """What was found in a turned image, in the image of (H, W) ``size`` as it was.

    ``side`` is the one that is up, "" if that is not known.
    """
    surfaces = surfaces_of(found)
    if not turns:
        return Segmented(found, surfaces, side)
    instances = [
        replace(i, mask=turned(i.mask, -turns), box=_box(i.box, turns, size)) for i in found
    ]
    seen = None if surfaces is None else _surfaces(surfaces, turns, size)
    return Segmented(instances, seen, side)


def _box(box: Floats, turns: int, size: tuple[int, int]) -> Floats:
    height, width = size
    ends = (height, width) if turns % 2 else (width, height)
    corners = _turned_points(box.reshape(2, 2).astype(float), -turns % len(SIDES), ends)
    return np.concatenate([corners.min(axis=0), corners.max(axis=0)]).astype(np.float32)


def _surfaces(seen: SurfaceClasses, turns: int, size: tuple[int, int]) -> SurfaceClasses:
    """Cells of the image as it was, from those of the turned one."""
    height, width = size
    rows, columns = (math.ceil(n / seen.cell_px) for n in size)
    places = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    pixels = (places.astype(float) + 0.5) * seen.cell_px - 0.5
    p = seen.at(_turned_points(pixels, turns, (width - 1, height - 1)))
    found = p.reshape(rows, columns, -1).astype(seen.probabilities.dtype)
    return SurfaceClasses(seen.labels, found, seen.cell_px, size)


def _turned_points(points: Array, turns: int, ends: tuple[float, float]) -> Array:
    """Where points (N, 2) of an image from 0 to ``ends`` (x, y) are in the turned image."""
    for _ in range(turns):
        points = np.stack([points[:, 1], ends[0] - points[:, 0]], axis=1)
        ends = ends[1], ends[0]
    return points
