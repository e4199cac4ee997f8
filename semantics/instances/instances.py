"""The result of segmenting an image: one ``Instance`` an object, and their order in depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bmask_slam.graph.arrays import Bytes, Floats, Ints, Mask
from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.labels import LabelSet

_COARSE = 4
"""The order compares masks on every fourth pixel in both directions."""
_ROUNDING = 1e-3
"""By so much a probability may be above 1."""


@dataclass(frozen=True, eq=False)
class PackedMask:
    """A mask of ``shape`` (H, W) with one bit a pixel: ``bits`` (ceil(H W / 8),)."""

    bits: Bytes
    shape: tuple[int, ...]

    @classmethod
    def of(cls, mask: Mask) -> PackedMask:
        """Pack a mask (H, W)."""
        return cls(np.packbits(mask), mask.shape)

    def unpacked(self) -> Mask:
        """The mask (H, W)."""
        size = int(np.prod(self.shape))
        return np.unpackbits(self.bits, count=size).reshape(self.shape) > 0


@dataclass(frozen=True, eq=False)
class Instance:
    """One object in an image.

    Attributes:
        mask: (H, W) bool, its visible pixels.
        box: (4,) x1, y1, x2, y2 in pixels, the edges of a box around it.
        label: class in the segmenter's label set, never 0.
        distribution: (C,) probability of each class, background first; sums to 1.
        class_score: probability of the label.
        mask_score: class score times predicted IoU of the mask (Huang et al. 2019), a confidence
            of the mask; equal to the class score without a predicted IoU.
    """

    mask: Mask
    box: Floats
    label: int
    distribution: Floats
    class_score: float
    mask_score: float

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle with one bit a pixel, for other processes and machines."""
        rest = (self.box, self.label, self.distribution, self.class_score, self.mask_score)
        return _with_mask, (PackedMask.of(self.mask), rest)


def _with_mask(packed: PackedMask, rest: tuple) -> Instance:
    return Instance(packed.unpacked(), *rest)


def check_instances(
    instances: Sequence[Instance], size: tuple[int, int], labels: LabelSet, name: str
) -> None:
    """Refuse instances of another image size than (height, width) or another label set.

    Raises:
        InputError: a mask of another size, a label or distribution outside the set.
    """
    for instance in instances:
        if instance.mask.shape != size or instance.mask.dtype != bool:
            raise InputError(
                f"{name}: a mask of shape {instance.mask.shape}, {instance.mask.dtype}, but the "
                f"images have {size}; give masks of these images"
            )
        if not 0 < instance.label < len(labels) or len(instance.distribution) != len(labels):
            raise InputError(
                f"{name}: label {instance.label} of {len(instance.distribution)}, but the label "
                f"set has {len(labels)}; give the label set of these masks"
            )
        p = np.asarray(instance.distribution)
        possible = ((p >= 0) & (p <= 1 + _ROUNDING)).all()  # False for NaN
        if not possible or not 0 <= instance.mask_score <= 1:
            raise InputError(
                f"{name}: mask score {instance.mask_score} or a class probability is not between "
                "0 and 1; make the masks again"
            )


def mask_box(mask: Mask) -> Floats:
    """The box (4,) around the pixels of a mask (H, W); zeros for an empty mask."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return np.zeros(4, np.float32)
    return np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], np.float32)


def painting_order(ranked: Sequence[Instance], nested: float, in_boxes: bool) -> Ints:
    """Indices of instances from back to front: by how many others each lies in, then by score.

    ``ranked`` is sorted by score, the best first. An instance lies in another one of at least twice
    its area and of another class if the share ``nested`` of it is on the other's mask or, with
    ``in_boxes``, in the box around that mask.
    """
    if not ranked:
        return np.zeros(0, np.int64)
    coarse = np.array([i.mask[::_COARSE, ::_COARSE] for i in ranked], np.float32)
    some = coarse.reshape(len(ranked), -1)
    labels = np.array([i.label for i in ranked])
    around = np.stack([_filled(m) for m in coarse]).reshape(some.shape) if in_boxes else some
    both, areas = some @ around.T, some.sum(axis=1)
    inside = (both >= nested * areas[:, None]) & (areas[:, None] > 0)
    inside &= (areas[None] >= 2 * areas[:, None]) & (labels[None] != labels[:, None])
    return np.lexsort((-np.arange(len(ranked)), inside.sum(axis=1)))


def _filled(mask: Floats) -> Floats:
    """A mask (H, W) of the box around a mask (H, W)."""
    x1, y1, x2, y2 = mask_box(mask > 0).astype(int)
    box = np.zeros_like(mask)
    box[y1:y2, x1:x2] = 1
    return box


def certain(label: int, classes: int, score: float = 1.0) -> Floats:
    """The distribution (classes,) of a label with a score; the rest goes to the background."""
    distribution = np.zeros(classes, np.float32)
    distribution[0] = 1.0 - score
    distribution[label] = score
    return distribution


def as_annotation(instance: Instance) -> dict[str, Any]:
    """An instance in COCO's format, without ids; the mask as compressed run lengths."""
    from pycocotools import mask as coco_mask  # noqa: PLC0415  # only where masks are coded

    coded = coco_mask.encode(np.asfortranarray(instance.mask.astype(np.uint8)))
    x1, y1, x2, y2 = (round(float(v), 3) for v in instance.box)
    return {
        "category_id": instance.label,
        "bbox": [x1, y1, round(x2 - x1, 3), round(y2 - y1, 3)],
        "area": int(instance.mask.sum()),
        "segmentation": {"size": list(instance.mask.shape), "counts": coded["counts"].decode()},
        "iscrowd": 0,
        "score": round(instance.mask_score, 6),
        "class_score": round(instance.class_score, 6),
        "distribution": [round(float(p), 5) for p in instance.distribution],
    }
