"""A segmenter that adds random errors, like those of networks, to the masks of another."""

from __future__ import annotations

from dataclasses import dataclass
from zlib import crc32

import cv2
import numpy as np

from bmask_slam.graph.arrays import Image
from bmask_slam.semantics.instances.instances import Instance, mask_box
from bmask_slam.semantics.segmenters.segmenter import Segmenter


@dataclass(frozen=True)
class Errors:
    """Rates and sizes of a segmenter's errors.

    Attributes:
        missed: share of the instances that it does not find.
        confused: share of the classes that it confuses with a fixed other one in 3 of 10 views.
        invented: masks on nothing, an image.
        joined: share of the instances whose mask also covers a neighbour's.
        border_px: standard deviation by which masks grow or shrink.
    """

    missed: float = 0.25
    confused: float = 0.2
    invented: float = 1.0
    joined: float = 0.05
    border_px: float = 2.0


class ImperfectSegmenter:
    """Gives the inner segmenter's instances with errors; an image has the same ones each time."""

    def __init__(self, inner: Segmenter, errors: Errors, seed: int = 0) -> None:
        self.inner, self.errors, self.seed = inner, errors, seed
        self.labels = inner.labels

    def segment(self, image: Image, name: str) -> list[Instance]:
        """Instances in an image (H, W, 3), best mask score first."""
        rng = np.random.default_rng([self.seed, crc32(name.encode())])
        found = [self._with_errors(i, rng) for i in self.inner.segment(image, name)]
        kept = [i for i in found if i is not None and rng.random() >= self.errors.missed]
        for _ in range(rng.poisson(self.errors.invented)):
            kept.append(self._invented(image.shape[:2], rng))
        for k in range(1, len(kept)):
            if rng.random() < self.errors.joined:
                kept[k] = self._joined(kept[k], kept[k - 1])
        return sorted(kept, key=lambda i: -i.mask_score)

    def _with_errors(self, instance: Instance, rng: np.random.Generator) -> Instance | None:
        """With a mask that is too large or small, and perhaps another class."""
        change = int(np.clip(np.rint(rng.normal(0, self.errors.border_px)), -5, 5))
        kernel = np.ones((2 * abs(change) + 1,) * 2, np.uint8)
        morph = cv2.dilate if change > 0 else cv2.erode
        mask = morph(instance.mask.astype(np.uint8), kernel).astype(bool)
        if mask.sum() < 20:
            return None
        iou = (mask & instance.mask).sum() / (mask | instance.mask).sum()
        own = np.random.default_rng([self.seed, instance.label, len(self.labels)])
        hard = own.random() < self.errors.confused
        other = int(own.integers(1, len(self.labels)))
        label = other if hard and rng.random() < 0.3 else instance.label
        second = instance.label if label == other else other
        score = float(rng.uniform(0.5, 0.75) if hard else rng.uniform(0.75, 0.99))
        return self._instance(mask, (label, second), score, float(iou))

    def _instance(
        self, mask: np.ndarray, labels: tuple[int, int], s: float, iou: float
    ) -> Instance:
        p = np.full(len(self.labels), 0.1 * (1 - s) / (len(self.labels) - 2), np.float32)
        p[0], p[labels[1]], p[labels[0]] = 0.5 * (1 - s), 0.4 * (1 - s), s
        return Instance(mask, mask_box(mask), labels[0], p / p.sum(), s, s * iou)

    def _invented(self, size: tuple[int, int], rng: np.random.Generator) -> Instance:
        mask = np.zeros(size, np.uint8)
        centre = (int(rng.integers(40, size[1] - 40)), int(rng.integers(40, size[0] - 40)))
        cv2.ellipse(mask, centre, tuple(rng.integers(10, 40, 2).tolist()), 0, 0, 360, 1, -1)
        label, other = rng.permutation(np.arange(1, len(self.labels)))[:2].tolist()
        return self._instance(mask > 0, (label, other), float(rng.uniform(0.5, 0.7)), 0.6)

    def _joined(self, a: Instance, b: Instance) -> Instance:
        mask = a.mask | b.mask
        return Instance(
            mask, mask_box(mask), a.label, a.distribution, a.class_score, 0.7 * a.mask_score
        )
