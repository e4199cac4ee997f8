"""Labels of surfaces: instances at a keyframe's pixels, and the fusion of several views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from bmask_slam.graph.arrays import Array, Floats, Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.mapping.products.surface_regions import Regions, StuffFusion, find_regions
from bmask_slam.semantics.beliefs.label_fusion import LabelStoreConfig
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.semantics.instances.surfaces import surfaces_of

OTHER_SHARE = 0.1
"""Probability that an instance's classes do not hold for a point: no view excludes a class."""
STRAY = 0.01
"""Probability that the landmarks on an instance belong to another object."""
MIN_LANDMARKS = 3
NEAREST_M, TOLERANCE_M, TOLERANCE_SHARE = 0.1, 0.02, 0.02
"""A point is seen where it is this near to the keyframe's depth, and this share of it."""


@dataclass(frozen=True, eq=False)
class KeyframeLabels:
    """The instances in a keyframe's image, and regions of stuff where there is none.

    Attributes:
        numbers: (H, W) uint16, the instance at each pixel, from 1; 0 for none. A number above I is
            that of a region plus I.
        log_likelihoods: (I + 1, C) float32 of each class given the instance, relative to no view;
            row 0, for no instance, is zero. Column 0 is the background.
        stuff: the regions.
    """

    numbers: NDArray[np.uint16]
    log_likelihoods: Floats
    stuff: Regions


@dataclass(frozen=True, eq=False)
class InstanceEvidence:
    """Evidence about the classes of a keyframe's instances.

    Attributes:
        log_likelihoods: (I + 1, C) float32 from their masks, as in KeyframeLabels.
        landmark_ids: (L,) landmarks observed on instances.
        landmark_instances: (L,) uint16, the instance of each, from 1.
        stuff: (R, S) float32 log probabilities of the classes ``stuff_names`` of the regions, whose
            numbers follow those of the instances.
        pixels: (H, W) uint16, the instance or region at each undistorted pixel, from 1; 0 for none.
    """

    log_likelihoods: Floats
    landmark_ids: Ints
    landmark_instances: NDArray[np.uint16]
    stuff: Floats = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    stuff_names: tuple[str, ...] = ()
    pixels: NDArray[np.uint16] = field(default_factory=lambda: np.zeros((0, 0), np.uint16))

    def stuff_of(self, names: tuple[str, ...]) -> Floats:
        """``stuff`` (R, S) of regions with these S classes; zeros if they have others."""
        if self.stuff_names == names:
            return self.stuff
        return np.zeros((len(self.stuff), len(names)), np.float32)

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
    """The evidence of the instances and regions of all submaps.

    Attributes:
        log_likelihoods: (I, C) float32 as in KeyframeLabels, one keyframe's rows after the other's;
            zeros for regions.
        submaps: (I,) index of each row's submap, sorted.
        of_things: (I,) whether each row is an instance's: neither no instance's nor a region's.
        fusion: parameters of the fusion of views.
        stuff: (I, S) float32 log probabilities of the regions' classes; zeros for instances.
        stuff_fusion: how these are fused.
    """

    log_likelihoods: Floats
    submaps: Ints
    of_things: Mask
    fusion: LabelStoreConfig
    stuff: Floats
    stuff_fusion: StuffFusion

    @classmethod
    def of(
        cls,
        keyframes: Sequence[Floats],
        fusion: LabelStoreConfig,
        stuff: Sequence[Floats] = (),
        stuff_fusion: StuffFusion | None = None,
    ) -> LabelTable:
        """The table of keyframes, each with its rows (I_k + 1, C) and those of regions (R_k, S).

        Regions of a keyframe with another number of classes keep their rows, which tell nothing.
        """
        together = stuff_fusion or StuffFusion(())
        columns, none = len(together.stuff), np.zeros((0, 0), np.float32)
        regions = [
            r if r.shape[1] == columns else np.zeros((len(r), columns), np.float32)
            for r in stuff or [none] * len(keyframes)
        ]
        pairs = list(zip(keyframes, regions, strict=True))
        likelihoods = [np.pad(k, ((0, len(r)), (0, 0))) for k, r in pairs]
        submaps = np.repeat(np.arange(len(pairs)), [len(rows) for rows in likelihoods])
        below = np.concatenate([np.pad(r, ((len(k), 0), (0, 0))) for k, r in pairs])
        of_things = [np.r_[0, np.ones(len(k) - 1), np.zeros(len(r))] > 0 for k, r in pairs]
        rows = np.concatenate(likelihoods), submaps, np.concatenate(of_things)
        return cls(*rows, fusion, below, together)

    @property
    def first(self) -> Ints:
        """(K,) the row of each submap for no instance."""
        return np.flatnonzero(np.diff(self.submaps, prepend=-1))

    def fused(self, views: csr_matrix) -> Floats:
        """Log probabilities (N, C), up to a constant a point, of points with ``views`` (N, I).

        As the label store fuses views of a landmark: the likelihoods of the instances, and the
        probability that all views without an instance missed the object.
        """
        none = (~self.of_things).astype(np.float32)
        evidence = np.asarray(views @ self.log_likelihoods)
        evidence += np.log(self.fusion.prior(evidence.shape[1])).astype(np.float32)
        missed = self.fusion.log_missed(np.asarray(views @ none))
        evidence[:, 1:] += missed[:, None].astype(np.float32)
        return evidence

    def labels(
        self,
        views: csr_matrix,
        points_world: NDArray[np.floating],
        normals_world: NDArray[np.floating],
    ) -> tuple[NDArray[np.uint16], Floats]:
        """Label (N,) and its probability (N,) of points (N, 3) with ``views`` (N, I).

        A point is a thing if one is likelier than none; else what the regions tell.
        """
        evidence = self.fused(views)
        evidence -= evidence.max(axis=1, keepdims=True)
        label = evidence.argmax(axis=1)
        probability = 1 / np.exp(evidence, out=evidence).sum(axis=1)
        free = np.flatnonzero(label == 0)
        if len(self.stuff_fusion.stuff) and len(free):
            seen = np.asarray(views[free] @ self._is_region.astype(np.float32))
            sums, on = (
                np.asarray(views[free] @ self.stuff),
                (points_world[free], normals_world[free]),
            )
            below, sure = self.stuff_fusion.labels(sums, seen, *on)
            label[free] = below
            probability[free] *= np.where(below > 0, sure, 1)
        return label.astype(np.uint16), probability

    @property
    def _is_region(self) -> Mask:
        return np.asarray(self.stuff.any(axis=1))


def keyframe_labels(
    instances: Sequence[Instance], shape: tuple[int, int], classes: int, fusion: LabelStoreConfig
) -> KeyframeLabels:
    """Number the instances of an image (H, W); where masks overlap the better mask score wins.

    The likelihood of an instance is a mixture of its class distribution, with the mask score over
    the class score as weight, and of no information.
    """
    numbers = np.zeros(shape, np.uint16)
    stuff = find_regions(surfaces_of(instances), _free(instances, shape))
    numbers[stuff.numbers > 0] = stuff.numbers[stuff.numbers > 0] + len(instances)
    order = sorted(range(len(instances)), key=lambda k: instances[k].mask_score)
    for k in order:
        numbers[instances[k].mask] = k + 1
    table = np.zeros((len(instances) + 1, classes), np.float32)
    if instances:
        trust = [i.mask_score / max(i.class_score, 1e-6) for i in instances]
        distributions = np.stack([i.distribution for i in instances]).astype(np.float32)
        weights = (1 - OTHER_SHARE) * np.clip(trust, 0, 1).astype(np.float32)
        table[1:] = np.log(fusion.likelihoods(distributions, weights))
    return KeyframeLabels(numbers, table, stuff)


def _free(instances: Sequence[Instance], shape: tuple[int, int]) -> Mask:
    """The pixels (H, W) without an instance."""
    free = np.ones(shape, bool)
    for instance in instances:
        free &= ~instance.mask
    return free


def dilate(mask: Mask, margin_px: int = 5) -> Mask:
    """A mask (H, W) grown by ``margin_px`` in rows and columns."""
    size = 2 * margin_px + 1
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8)) > 0)


@dataclass(frozen=True, eq=False)
class LabelledView:
    """A keyframe with labels.

    Attributes:
        depth_m: (H, W), NaN where missing.
        numbers: (H, W), the instance or region at each pixel; 0 for none.
        T_world_camera: (4, 4).
        first: row of its instance 0, which stands for none, in the `LabelTable`.
    """

    depth_m: Floats
    numbers: NDArray[np.uint16]
    T_world_camera: Array
    first: int


def rows_seen(
    points_world: NDArray[np.floating], view: LabelledView, camera: Camera
) -> tuple[Ints, Ints]:
    """Which of the points (N, 3) a keyframe sees, (K,), and the row of the table of each (K,)."""
    points = transform(inverse(view.T_world_camera), points_world.astype(float))
    ahead = np.flatnonzero(points[:, 2] > NEAREST_M)
    u, v = np.rint(camera.project(points[ahead])).T
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    rows, pixels = ahead[inside], (v[inside].astype(np.int64), u[inside].astype(np.int64))
    z = points[rows, 2]
    seen = np.abs(view.depth_m[pixels] - z) < TOLERANCE_M + TOLERANCE_SHARE * z
    return rows[seen], view.numbers[pixels][seen].astype(np.int64) + view.first


def views_of(pairs: list[tuple[Ints, Ints]], points: int, instances: int) -> csr_matrix:
    """One in (N, I) where a point is on an instance, from what ``rows_seen`` gave of each view."""
    rows, columns = (
        np.concatenate([np.zeros(0, np.int64), *part]) for part in zip(*pairs, strict=True)
    )
    return csr_matrix((np.ones(len(rows), np.float32), (rows, columns)), (points, instances))
