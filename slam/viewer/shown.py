"""What is shown of a run, in the words that every transport speaks; paths follow the frames.

====================  ==============================================================================
world/camera          the camera's pose; below it ``image``, and where it may be (``uncertainty``)
world/trajectory      the path so far
world/keyframes       their positions; ``world/loops``: lines between the ends of closed loops
world/uncertainty     of a finished run: where the keyframes may be, 3 sigma, ENLARGED
world/landmarks       points in the colours of their labels, else in their own
world/objects         boxes with names
world/dense           the dense cloud of a finished run
world/surface/X_Y_Z   in a live run: a part of the dense map's surface, as triangles (Rerun)
world/submaps/ID      in a live run: some points of each submap, in the frame of its keyframe
keyframe              the last keyframe that was segmented: image, masks, names
plots/...             status, inliers, milliseconds of each stage, uncertainty, queues
events                what happened: lost, found again, loops, segments, what the graph refused
====================  ==============================================================================
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Bytes, Image, Ints
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.semantics.instances.overlay import class_colour
from bmask_slam.semantics.objects.boxes3d import OrientedBox

if TYPE_CHECKING:  # it loads torch
    from bmask_slam.mapping.surface.parts import SurfacePart

IMAGE_STEP = 2
"""Every second pixel of an image is shown."""
JPEG_QUALITY = 70
ENLARGED = 10.0
"""Ellipsoids are so much larger than 3 sigma: those of a good map are smaller than a point."""
MAX_HALF_M = 1.0
MIN_SCORE = 0.3
"""Instances that are less sure are not shown; the map weighs them."""
MIN_AREA_PX = 20.0
"""Smaller parts of a mask get no outline."""


@dataclass(frozen=True, eq=False)
class Points:
    """Points (N, 3) with colours (N, 3), a radius, and their classes (N,) if they have some."""

    points: NDArray[np.floating]
    colours: Bytes
    radius_m: float
    labels: Ints | None = None


@dataclass(frozen=True, eq=False)
class Box:
    """A labelled box, with a colour (3,)."""

    box: OrientedBox
    text: str
    colour: Bytes


@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """Its centre (3,), axes as the columns of a rotation (3, 3), and half its size (3,) in m."""

    centre: Array
    rotation: Array
    half_sizes_m: Array

    @classmethod
    def of(cls, centre: Array, covariance: Array) -> Ellipsoid:
        """Where a point may be, by its covariance (3, 3) in m^2: 3 sigma, ENLARGED."""
        variances, axes = np.linalg.eigh(covariance)
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        half_m = 3 * ENLARGED * np.sqrt(np.maximum(variances, 0))
        return cls(centre, axes, np.clip(half_m, 1e-4, MAX_HALF_M))


@dataclass(frozen=True, eq=False)
class SeenInstance:
    """An instance in a shown image: name and score, colour, x1 y1 x2 y2, outlines (K, 2) in px."""

    text: str
    colour: Bytes
    box: Array
    outlines: tuple[Array, ...]


@dataclass(frozen=True, eq=False)
class SegmentedImage:
    """An image as JPEG, the class of each of its pixels (h, w), and its instances."""

    jpeg: bytes
    labels: Ints
    instances: tuple[SeenInstance, ...]


class Transport(Protocol):
    """Takes what is shown to a program that shows it, or to a file; arrays are not changed."""

    @property
    def address(self) -> str:
        """What to open, with what, in words; "" if it is not served."""

    def set_time(self, timestamp_s: float) -> None:
        """The time of everything from now on."""

    def names(self, names: Sequence[str]) -> None:
        """The names of the classes, by number."""

    def camera(self, K: Array, size: tuple[int, int]) -> None:
        """The camera matrix (3, 3) and width and height of the images."""

    def pose(self, path: str, T_world_child: Array) -> None:
        """Where something is, (4, 4); what is below it moves with it."""

    def image(self, jpeg: bytes) -> None:
        """What the camera sees."""

    def segmented(self, image: SegmentedImage) -> None:
        """The last keyframe with masks."""

    def points(self, path: str, shown: Points) -> None:
        """Points, in the frame of ``pose`` where there is one, else in the world."""

    def surface(self, path: str, part: SurfacePart) -> None:
        """A part of a surface in place of what was shown of its region."""

    def lines(self, path: str, lines: Sequence[Array], colour: Sequence[int]) -> None:
        """Lines through points (N, 3)."""

    def boxes(self, boxes: Sequence[Box]) -> None:
        """The map's objects."""

    def ellipsoids(self, path: str, shown: Sequence[Ellipsoid]) -> None:
        """Where things may be, in the frame of what they are below."""

    def numbers(self, group: str, values: Mapping[str, float]) -> None:
        """A value for each time series of a plot."""

    def event(self, text: str, is_bad: bool) -> None:
        """A line of the log."""

    def clear(self, path: str) -> None:
        """Remove what is at a path, and below it."""

    def close(self) -> None:
        """Send or write what is left, and end.

        Raises:
            InputError: a file cannot be written to its end.
        """


def as_jpeg(rgb: Image) -> bytes:
    """An image (H, W, 3), red first, in the size in which it is shown."""
    small = np.ascontiguousarray(rgb[::IMAGE_STEP, ::IMAGE_STEP, ::-1])
    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    return cv2.imencode(".jpg", small, quality)[1].tobytes()


def segmented_image(
    rgb_jpeg: bytes, instances: Sequence[Instance], names: Sequence[str]
) -> SegmentedImage:
    """A shown image with the sure instances of the whole one, of which the first is the best."""
    instances = [i for i in instances if i.mask_score >= MIN_SCORE]
    seen: list[SeenInstance] = []
    shape = instances[0].mask[::IMAGE_STEP, ::IMAGE_STEP].shape if instances else (0, 0)
    labels = np.zeros(shape, np.int64)
    for instance in reversed(instances):  # the best on top
        mask = instance.mask[::IMAGE_STEP, ::IMAGE_STEP]
        labels[mask] = instance.label
        found, _ = cv2.findContours(
            mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE
        )
        outlines = [c[:, 0].astype(float) for c in found if cv2.contourArea(c) >= MIN_AREA_PX]
        text = f"{names[instance.label]} {instance.mask_score:.2f}"
        colour = class_colour(instance.label).astype(np.uint8)
        box = np.asarray(instance.box, float) / IMAGE_STEP
        seen.append(SeenInstance(text, colour, box, tuple(outlines)))
    return SegmentedImage(rgb_jpeg, labels, tuple(reversed(seen)))


def quaternion(rotation: Array) -> Array:
    """x y z w of a rotation matrix (3, 3)."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - only where something is drawn

    return np.asarray(Rotation.from_matrix(rotation).as_quat(), float)
