"""Labels of surfaces: instances at a keyframe's pixels, and the fusion of several views."""

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
"""Probability that an instance's classes do not hold for a point: no view excludes a class."""
STRAY = 0.01
"""Probability that the landmarks on an instance belong to another object."""
MIN_LANDMARKS = 3


@dataclass(frozen=True, eq=False)
class KeyframeLabels:
    """The instances in a keyframe's image.

    Attributes:
        numbers: (H, W) uint16, the instance at each pixel, from 1; 0 for none.
        log_likelihoods: (I + 1, C) float32 of each class given the instance, relative to no view;
            row 0, for no instance, is zero. Column 0 is the background.
    """

    numbers: NDArray[np.uint16]
    log_likelihoods: Floats


@dataclass(frozen=True, eq=False)
class InstanceEvidence:
    """Evidence about the classes of a keyframe's instances.

    Attributes:
        log_likelihoods: (I + 1, C) float32 from their masks, as in KeyframeLabels.
        landmark_ids: (L,) landmarks observed on instances.
        landmark_instances: (L,) uint16, the instance of each, from 1.
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
        """The log likelihoods (I + 1, C) combined with the map's labels of the landmarks.

        ``distributions`` (L, C) are those of the landmarks, of which some are ``known`` (L,). The
        probability of an object, against background, is that of the mask. Which object it is comes
        from both: where an instance has MIN_LANDMARKS with a class, the mean of their
        distributions, which come from all keyframes, is the prior of its class c > 0. The mask
        counts half, since it is part of that mean: p(c) ~ (mask(c) / prior(c))^(1/2) mean(c).
        """
        rows, classes = self.log_likelihoods.shape
        total, instances = np.zeros((rows, classes)), self.landmark_instances[known]
        np.add.at(total, instances, distributions[known])
        total[:, 0] = 0
        count = total.sum(axis=1, keepdims=True)
        mean = (1 - STRAY) * total / np.maximum(count, 1) + STRAY / max(classes - 1, 1)
        mask = np.exp(self.log_likelihoods)
        which = np.sqrt(mask[:, 1:]) * mean[:, 1:]
        is_object = (mask * prior)[:, 1:].sum(axis=1, keepdims=True)
        combined = mask.copy()
        combined[:, 1:] = is_object * which / which.sum(axis=1, keepdims=True) / prior[1:]
        mixed = np.log((1 - OTHER_SHARE) * combined + OTHER_SHARE).astype(np.float32)
        return np.where(count >= MIN_LANDMARKS, mixed, self.log_likelihoods)


@dataclass(frozen=True, eq=False)
class LabelTable:
    """The log likelihoods of the instances of all submaps.

    Attributes:
        log_likelihoods: (I, C) float32 as in KeyframeLabels, one keyframe's rows after the other's.
        submaps: (I,) index of each row's submap, sorted.
        fusion: parameters of the fusion of views.
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
        """Log probabilities (N, C), up to a constant a point, of points with ``views`` (N, I).

        As the label store fuses views of a landmark: the likelihoods of the instances, and the
        probability that all views without an instance missed the object.
        """
        none = np.zeros(len(self.submaps), np.float32)
        none[self.first] = 1
        evidence = np.asarray(views @ self.log_likelihoods)
        evidence += np.log(self.fusion.prior(evidence.shape[1])).astype(np.float32)
        missed = self.fusion.log_missed(np.asarray(views @ none))
        evidence[:, 1:] += missed[:, None].astype(np.float32)
        return evidence


def keyframe_labels(
    instances: Sequence[Instance], shape: tuple[int, int], classes: int, fusion: LabelStoreConfig
) -> KeyframeLabels:
    """Number the instances of an image (H, W); where masks overlap the better mask score wins.

    The likelihood of an instance is a mixture of its class distribution, with the mask score over
    the class score as weight, and of no information.
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


def dilate(mask: Mask, margin_px: int = 5) -> Mask:
    """A mask (H, W) grown by ``margin_px`` in rows and columns."""
    size = 2 * margin_px + 1
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8)) > 0)
