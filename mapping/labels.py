"""Labels of surfaces: what masks say of a keyframe's pixels, and how views of a place are fused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semantics.instances import Instance

OTHER_SHARE = 0.1
"""Of every distribution, spread over all classes: no view rules a class out."""
MIN_LANDMARKS = 3
BACKGROUND_TRUST = 0.7
"""Probability that a pixel outside all masks shows the background."""


@dataclass(frozen=True, eq=False)
class KeyframeLabels:
    """The instances in a keyframe's image.

    Attributes:
        numbers: (H, W) uint16, the instance that each pixel shows, from 1; 0 for none.
        log_likelihoods: (I + 1, C) float32 of each class given the instance; row 0 is that of no
            instance. Column 0 is the background.
    """

    numbers: NDArray[np.uint16]
    log_likelihoods: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class InstanceEvidence:
    """What is known of the classes of a keyframe's instances.

    Attributes:
        log_likelihoods: (I + 1, C) float32 by their masks, as in KeyframeLabels.
        landmark_ids: (L,) landmarks seen on instances.
        landmark_instances: (L,) uint16 which, from 1.
    """

    log_likelihoods: NDArray[np.float32]
    landmark_ids: NDArray[np.int64]
    landmark_instances: NDArray[np.uint16]

    def with_landmarks(
        self, distributions: NDArray[np.floating], known: NDArray[np.bool_]
    ) -> NDArray[np.float32]:
        """The likelihoods (I + 1, C) with what the map believes of the landmarks on instances.

        ``distributions`` (L, C) of the landmarks that are ``known`` (L,): where an instance has
        MIN_LANDMARKS of them their mean, which rests on all keyframes, replaces the mask's word.
        """
        rows, classes = self.log_likelihoods.shape
        total, instances = np.zeros((rows, classes)), self.landmark_instances[known]
        np.add.at(total, instances, distributions[known])
        count = np.bincount(instances, minlength=rows)[:, None]
        mean = total / np.maximum(count, 1)
        mixed = (1 - OTHER_SHARE) * mean + OTHER_SHARE / classes
        believed = np.log(mixed).astype(np.float32)
        return np.where(count >= MIN_LANDMARKS, believed, self.log_likelihoods)


def keyframe_labels(
    instances: Sequence[Instance], shape: tuple[int, int], classes: int
) -> KeyframeLabels:
    """Number the instances of an image (H, W); where masks overlap the better score wins.

    The likelihood of an instance is its class distribution, trusted as far as its mask: with the
    mask score s over the class score as weight, the rest spread evenly.
    """
    numbers = np.zeros(shape, np.uint16)
    order = sorted(range(len(instances)), key=lambda k: instances[k].mask_score)
    for k in order:
        numbers[instances[k].mask] = k + 1
    none = np.full(classes, (1 - BACKGROUND_TRUST) / max(classes - 1, 1))
    none[0] = BACKGROUND_TRUST
    rows = [none, *(_trusted(instance, classes) for instance in instances)]
    mixed = (1 - OTHER_SHARE) * np.stack(rows) + OTHER_SHARE / classes
    return KeyframeLabels(numbers, np.log(mixed).astype(np.float32))


def _trusted(instance: Instance, classes: int) -> NDArray[np.floating]:
    trust = np.clip(instance.mask_score / max(instance.class_score, 1e-6), 0, 1)
    return trust * instance.distribution + (1 - trust) / classes


def widened(shown: NDArray[np.bool_], margin_px: int = 5) -> NDArray[np.bool_]:
    """Pixels (H, W) of a mask, and those nearly beside it."""
    size = 2 * margin_px + 1
    return np.asarray(cv2.dilate(shown.astype(np.uint8), np.ones((size, size), np.uint8)) > 0)
