"""Labels of surfaces: what masks say of a keyframe's pixels, and how views of a place are fused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from bmask_slam.graph.arrays import Floats, Ints, Mask
from bmask_slam.semantics.beliefs.label_store import LabelStoreConfig
from bmask_slam.semantics.instances.instances import Instance

OTHER_SHARE = 0.1
"""Probability that what an instance says is not meant for a point: no view rules a class out."""
ASTRAY = 0.01
"""Probability that the landmarks on an instance are of something else."""
MIN_LANDMARKS = 3


@dataclass(frozen=True, eq=False)
class KeyframeLabels:
    """The instances in a keyframe's image.

    Attributes:
        numbers: (H, W) uint16, the instance that each pixel shows, from 1; 0 for none.
        log_likelihoods: (I + 1, C) float32 of each class given the instance, relative to no view;
            row 0, of no instance, is zero. Column 0 is the background.
    """

    numbers: NDArray[np.uint16]
    log_likelihoods: Floats


@dataclass(frozen=True, eq=False)
class InstanceEvidence:
    """What is known of the classes of a keyframe's instances.

    Attributes:
        log_likelihoods: (I + 1, C) float32 by their masks, as in KeyframeLabels.
        landmark_ids: (L,) landmarks seen on instances.
        landmark_instances: (L,) uint16 which, from 1.
    """

    log_likelihoods: Floats
    landmark_ids: Ints
    landmark_instances: NDArray[np.uint16]

    def with_landmarks(
        self,
        distributions: NDArray[np.floating],
        known: Mask,
        prior: NDArray[np.floating],
    ) -> Floats:
        """The likelihoods (I + 1, C) with what the map believes of the landmarks on instances.

        ``distributions`` (L, C) of the landmarks that are ``known`` (L,). Whether there is a thing
        the mask says, and the views without one. Which thing it is both say: where an instance has
        MIN_LANDMARKS with a class, the mean of their distributions, which rest on all keyframes, is
        the prior of its class c > 0. The mask, since it is one of what that rests on, counts half:
        p(c) ~ (mask(c) / prior(c))^(1/2) mean(c).
        """
        rows, classes = self.log_likelihoods.shape
        total, instances = np.zeros((rows, classes)), self.landmark_instances[known]
        np.add.at(total, instances, distributions[known])
        total[:, 0] = 0
        count = total.sum(axis=1, keepdims=True)
        mean = (1 - ASTRAY) * total / np.maximum(count, 1) + ASTRAY / max(classes - 1, 1)
        mask = np.exp(self.log_likelihoods)
        which = np.sqrt(mask[:, 1:]) * mean[:, 1:]
        thing = (mask * prior)[:, 1:].sum(axis=1, keepdims=True)
        believed = mask.copy()
        believed[:, 1:] = thing * which / which.sum(axis=1, keepdims=True) / prior[1:]
        mixed = np.log((1 - OTHER_SHARE) * believed + OTHER_SHARE).astype(np.float32)
        return np.where(count >= MIN_LANDMARKS, mixed, self.log_likelihoods)


@dataclass(frozen=True, eq=False)
class LabelTable:
    """What the instances of all submaps say of classes.

    Attributes:
        log_likelihoods: (I, C) float32 as in KeyframeLabels, one keyframe's rows after the other's.
        submaps: (I,) the number of each one's submap, rising.
        fusion: how views are fused.
    """

    log_likelihoods: Floats
    submaps: Ints
    fusion: LabelStoreConfig

    @classmethod
    def of(cls, keyframes: Sequence[Floats], fusion: LabelStoreConfig) -> LabelTable:
        """The table of keyframes, each with its rows (I_k + 1, C)."""
        submaps = np.repeat(np.arange(len(keyframes)), [len(k) for k in keyframes])
        return cls(np.concatenate(keyframes), submaps, fusion)

    @property
    def first(self) -> Ints:
        """(K,) the row of each submap for no instance."""
        return np.flatnonzero(np.diff(self.submaps, prepend=-1))

    def fused(self, views: csr_matrix) -> Floats:
        """Log probabilities (N, C), but for a constant a point, of points seen in ``views`` (N, I).

        As the label store fuses views of a landmark: what instances say, and that those who saw
        none may all have missed it.
        """
        none = np.zeros(len(self.submaps), np.float32)
        none[self.first] = 1
        told = np.asarray(views @ self.log_likelihoods)
        told += np.log(self.fusion.prior(told.shape[1])).astype(np.float32)
        told[:, 1:] += self.fusion.log_missed(np.asarray(views @ none))[:, None].astype(np.float32)
        return told


def keyframe_labels(
    instances: Sequence[Instance], shape: tuple[int, int], classes: int, fusion: LabelStoreConfig
) -> KeyframeLabels:
    """Number the instances of an image (H, W); where masks overlap the better score wins.

    The likelihood of an instance is its class distribution, trusted as far as its mask: with the
    mask score s over the class score as weight; else it says nothing.
    """
    numbers = np.zeros(shape, np.uint16)
    order = sorted(range(len(instances)), key=lambda k: instances[k].mask_score)
    for k in order:
        numbers[instances[k].mask] = k + 1
    table = np.zeros((len(instances) + 1, classes), np.float32)
    if instances:
        trust = [i.mask_score / max(i.class_score, 1e-6) for i in instances]
        distributions = np.stack([i.distribution for i in instances]).astype(np.float32)
        weights = (1 - OTHER_SHARE) * np.clip(trust, 0, 1).astype(np.float32)
        table[1:] = np.log(fusion.likelihoods(distributions, weights))
    return KeyframeLabels(numbers, table)


def widened(shown: Mask, margin_px: int = 5) -> Mask:
    """Pixels (H, W) of a mask, and those nearly beside it."""
    size = 2 * margin_px + 1
    return np.asarray(cv2.dilate(shown.astype(np.uint8), np.ones((size, size), np.uint8)) > 0)
