"""The order of overlapping instances in depth, from their masks alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bmask_slam.graph.arrays import Floats, Ints
from bmask_slam.semantics.instances.instances import Instance, mask_box

_COARSE = 4
"""Masks are compared on every fourth pixel in both directions."""


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
