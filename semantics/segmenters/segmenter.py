"""The ``Segmenter`` protocol, and the segmenters that need no network."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from bmask_slam.graph.arrays import Image
from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.instances.coco_files import MAX_MASK_BYTES, CocoImage, read_coco
from bmask_slam.semantics.instances.image_files import decode_labels, reduced_labels, reduction
from bmask_slam.semantics.instances.instances import Instance, certain, mask_box
from bmask_slam.semantics.instances.surface_files import read_surfaces, surface_labels
from bmask_slam.semantics.instances.surfaces import Segmented
from bmask_slam.semantics.labels import LabelSet, label_set

INSTANCES_A_CLASS = 1000
"""In a label PNG, value = 1000 * label + instance; a value below 1000 is a label."""


@runtime_checkable
class Segmenter(Protocol):
    """Finds instances in images; ``labels`` is the set of their labels."""

    labels: LabelSet

    def segment(self, image: Image, name: str) -> list[Instance]:
        """Instances in an image (H, W, 3), red first, best mask score first.

        ``name`` is the image's file name relative to its sequence, for look-ups and errors. A
        segmenter that also tells what all pixels are gives a ``Segmented``.
        """


def check_segmenter(given: object) -> None:
    """Raise InputError for what finds no instances, such as the name of a segmenter."""
    if not isinstance(given, Segmenter):
        what = repr(given) if isinstance(given, str) else f"a {type(given).__name__}"
        raise InputError(
            f"segmenter: {what}; give what make_segmenter makes of it, or an object with labels "
            "and segment()"
        )


@runtime_checkable
class EarlySegmenter(Protocol):
    """A segmenter that works beside its caller."""

    def begin(self, image: Image, name: str) -> None:
        """Begin with an image whose instances will be asked for next; returns at once."""


def begin_early(segmenter: Segmenter, image: Image, name: str) -> None:
    """Let a segmenter begin with an image, if it can before the instances are asked for."""
    if isinstance(segmenter, EarlySegmenter):
        segmenter.begin(image, name)


def check_image(image: Image, name: str) -> None:
    """Refuse anything but a colour image of 8 bits that is not empty.

    Raises:
        InputError: another shape or type.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.size == 0:
        raise InputError(
            f"{name}: an image of shape {image.shape} and type {image.dtype}; "
            "segmentation needs (height, width, 3) in 8 bits, and at least one pixel"
        )


class NoSegmenter:
    """Finds nothing."""

    labels = label_set(())

    def segment(self, image: Image, name: str) -> list[Instance]:
        """An empty list."""
        check_image(image, name)
        return []


class CocoSegmenter:
    """Reads instances from a COCO file: cached masks, or the truth of a rendered sequence.

    Beside cached masks lie the classes of all pixels, if their segmenter told them.
    """

    def __init__(self, path: Path) -> None:
        content = read_coco(path)
        self.path = path
        self.labels = content.labels
        self._images = {Path(i.file_name).as_posix(): i for i in content.images}
        self._surface_labels = surface_labels(path.parent)

    def segment(self, image: Image, name: str) -> list[Instance]:
        """The instances in the file for the image of this name, which may be a reduced one.

        Raises:
            InputError: the file does not have the image, or in another size.
        """
        check_image(image, name)
        known = self._images.get(Path(name).as_posix())
        if known is None:
            raise InputError(f"{self.path}: has no image {name}; make the masks of this sequence")
        size = image.shape[:2]
        k = reduction((known.height, known.width), size)
        if not k:
            raise InputError(
                f"{self.path}: {name} has {known.width}x{known.height} pixels there, but "
                f"{image.shape[1]}x{image.shape[0]} here; make the masks of this sequence"
            )
        found = sorted(_instances(known, len(self.labels)), key=lambda i: -i.mask_score)
        if k > 1:
            found = [
                replace(i, mask=reduced_labels(i.mask, k), box=i.box / np.float32(k)) for i in found
            ]
        if self._surface_labels is None:
            return found
        return Segmented(found, read_surfaces(self.path.parent, name, self._surface_labels, size))


def _instances(image: CocoImage, classes: int) -> list[Instance]:
    found = []
    for o in image.objects:
        if o.distribution is not None and len(o.distribution) == classes:
            distribution = np.array(o.distribution, np.float32)
        else:
            distribution = certain(o.label, classes, o.class_score)
        box = np.array(o.box, np.float32)
        found.append(Instance(o.mask(), box, o.label, distribution, o.class_score, o.score))
    return found


class LabelImageSegmenter:
    """Reads label PNGs of any tool: one for each image, of its name, with 8 or 16 bits.

    Of PNGs with a palette, such as those of Pascal VOC, the indices are the values.
    """

    def __init__(self, folder: Path, labels: LabelSet) -> None:
        self.folder = folder
        self.labels = labels

    def segment(self, image: Image, name: str) -> list[Instance]:
        """One instance for each value in the PNG except 0; the image may be a reduced one.

        Raises:
            InputError: no PNG for the image, one of another size, or a label that is not known.
        """
        check_image(image, name)
        path = self._file(name)
        values, size = decode_labels(path), image.shape[:2]
        k = reduction(values.shape, size) if values.ndim == 2 else 0
        if not k:
            raise InputError(
                f"{path}: shape {values.shape}, but the image has {size}; "
                "label images have one channel and their image's size"
            )
        values = reduced_labels(values, k)
        found, present = [], np.unique(values[values > 0])
        if len(present) * values.size > MAX_MASK_BYTES:
            raise InputError(
                f"{path}: {len(present)} different values, masks of more than "
                f"{MAX_MASK_BYTES / 1e9:.1f} GB; give label images with fewer objects"
            )
        for value in present.tolist():
            label = value // INSTANCES_A_CLASS if value >= INSTANCES_A_CLASS else value
            if label >= len(self.labels):
                raise InputError(
                    f"{path}: the value {value} means label {label}, but the label set ends at "
                    f"{len(self.labels) - 1}; give the label set of these images"
                )
            mask = values == value
            distribution = certain(label, len(self.labels))
            found.append(Instance(mask, mask_box(mask), label, distribution, 1.0, 1.0))
        return found

    def _file(self, name: str) -> Path:
        """The PNG of an image: under the same relative path, or directly in the folder."""
        whole = (self.folder / name).with_suffix(".png")
        return whole if whole.is_file() else self.folder / f"{Path(name).stem}.png"
