"""Which objects of a map are reported: fitted, judged by size and place, merged, or withheld."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.semantics.beliefs.class_sizes import FLOOR, NEVER, SUPPORT, TOP, WALL, ClassSizes
from bmask_slam.semantics.beliefs.label_store import LabelStore
from bmask_slam.semantics.beliefs.surface_geometry import Ground
from bmask_slam.semantics.objects.boxes3d import (
    OrientedBox,
    box_around,
    main_part,
    seen_again,
    supported,
    without_noise,
)
from bmask_slam.semantics.objects.config import BoxConfig, ObjectConfig, PublicationConfig
from bmask_slam.semantics.objects.points import ObjectPoints

_SAME_MARGIN_M, _TOGETHER = 0.05, 0.5
SMALLEST_M, LARGEST_M = 0.05, 3.5
"""Longest sides of what can be seen in a room."""
LANDMARK_MARGIN_M = 0.1


@dataclass(frozen=True, eq=False)
class MapObject:
    """One object.

    Attributes:
        id: unique, never reused.
        label: the likeliest class, or what it looks like before it is judged.
        distribution: (C,) over all classes.
        centroid_world: (3,) m, mean of its points without outliers. box: around them.
        keyframe_ids: keyframes that observed it. landmark_ids: landmarks on it.
        first_seen_s, last_seen_s: timestamps of the first and last of these keyframes.
    """

    id: int
    label: int
    distribution: Array
    centroid_world: Array
    box: OrientedBox
    keyframe_ids: Ints
    landmark_ids: Ints
    first_seen_s: float
    last_seen_s: float

    def with_landmarks_at(self, points_world: Array) -> MapObject:
        """Without landmarks that are elsewhere, seen past its edge; points (N, 3) by landmark id.

        Depth at a rim is now and then that of the background, and where the box ends is not exact:
        they may be LANDMARK_MARGIN_M outside.
        """
        around = replace(self.box, size_m=self.box.size_m + 2 * LANDMARK_MARGIN_M)
        inside = around.contains(points_world[self.landmark_ids])
        return replace(self, landmark_ids=self.landmark_ids[inside])


@dataclass(frozen=True, eq=False)
class ObjectSurface:
    """An object's points.

    Attributes:
        points_world: (N, 3) m. noise_world: (N, 3) their displacement by one sigma of the depth.
        views: (N,) the keyframes that saw them.
        covered: (N,) of the views that show the object and the point, the share whose mask of the
            object is on the point.
    """

    points_world: Array
    noise_world: Array
    views: Ints
    covered: Array

    @classmethod
    def joined(cls, parts: Sequence[ObjectSurface]) -> ObjectSurface:
        """All points of some."""
        fields = ("points_world", "noise_world", "views", "covered")
        return cls(*(np.concatenate([getattr(p, name) for p in parts]) for name in fields))


def fitted(surface: ObjectSurface, up_world: Array, config: BoxConfig) -> tuple[Array, OrientedBox]:
    """The centroid (3,) of the points of an object and the box around them.

    Without outliers, what only one view shows, what fewer masks are on than not, and noise.
    """
    points, noise = surface.points_world, surface.noise_world
    near = supported(points, config.neighbours, config.support_m)
    inside = near & (surface.covered >= config.covered)
    near = inside if inside.any() else near
    near[near] = seen_again(points[near], surface.views[near], config.support_m)
    near[near] = main_part(points[near], config.cell_m, config.part)
    inner = without_noise(points[near], noise[near], up_world, config.trim)
    return np.asarray(points[near].mean(axis=0)), box_around(inner, up_world)


def size_and_place(
    box: OrientedBox, ground: Ground, sizes: ClassSizes, config: PublicationConfig
) -> Array:
    """log of P(size and place of a box | class) (C,) relative to what is of no class.

    The logarithm of the longest side is uniform over the usual range with normal tails, and uniform
    over what can be seen of anything for the unknown. Of classes without a range nothing is said.
    What is taller than its class speaks against it as what is longer does.
    """
    longest_m, tall_m = float(box.size_m.max()), float(box.size_m[2])
    above = np.maximum(np.log(longest_m / sizes.longest_m), np.log(tall_m / sizes.tallest_m))
    above = np.maximum(above, 0) / config.large_sigma
    below = np.maximum(np.log(sizes.shortest_m / longest_m), 0) / config.small_sigma
    tails = np.sqrt(np.pi / 2) * (config.large_sigma + config.small_sigma)
    width = np.log(sizes.longest_m / sizes.shortest_m) + tails
    anything = np.log(LARGEST_M / SMALLEST_M)
    found = np.log(anything / width) - 0.5 * (above**2 + below**2)
    found[sizes.longest_m > LARGEST_M] = np.minimum(found, 0)[sizes.longest_m > LARGEST_M]
    if np.isfinite(ground.floor_m):
        heights_m = ground.heights_m(box.corners_world)
        bottom_m, top_m = float(heights_m.min()), float(heights_m.max())
        beyond_m = np.zeros(len(found))
        on_floor = sizes.is_in(FLOOR, SUPPORT)
        beyond_m[on_floor] = np.maximum(top_m - 1.15 * sizes.tallest_m, 0)[on_floor]
        beyond_m[on_floor] += max(bottom_m - 0.9, 0.0)
        beyond_m[sizes.is_in(TOP)] = max(0.2 - bottom_m, bottom_m - 2.2, 0.0)
        beyond_m[sizes.is_in(WALL)] = max(0.3 - bottom_m, 0.0)
        found -= 0.5 * (beyond_m / config.height_sigma_m) ** 2
    found[0] = 0.0
    return np.clip(found, -config.most, config.most)


def judged(distribution: Array, log_factors: Array) -> Array:
    """A distribution (C,) after evidence of its classes (C,)."""
    p = distribution * np.exp(log_factors)
    return np.asarray(p / p.sum())


def same_things(objects: Sequence[MapObject]) -> NDArray[np.int64]:
    """For each object (N,) the index of the one that it is a part of, often itself.

    Of two objects of a class, the one that fewer keyframes saw is a part of the other if the centre
    of its box lies in the other's, or _SAME_MARGIN_M outside, unless most of these keyframes have a
    mask on each: books side by side are thinner than that.
    """
    order = sorted(range(len(objects)), key=lambda k: (-len(objects[k].keyframe_ids), k))
    whole = np.arange(len(objects))
    kept: list[int] = []
    for k in order:
        for other in kept:
            box = objects[other].box
            both = np.isin(objects[k].keyframe_ids, objects[other].keyframe_ids)
            margin_m = 0.0 if both.mean() > _TOGETHER else _SAME_MARGIN_M
            grown = replace(box, size_m=box.size_m + 2 * margin_m)
            centre = objects[k].box.T_world_box[:3, 3]
            if objects[k].label == objects[other].label and grown.contains(centre[None])[0]:
                whole[k] = other
                break
        else:
            kept.append(k)
    return whole


def stands_still(sizes: ClassSizes) -> NDArray[np.bool_]:
    """Which classes (C,) are things of a room, which do not move by themselves."""
    return ~sizes.is_in(NEVER)


class ObjectPublisher:
    """Objects as they are reported, from the tables of their points and classes."""

    def __init__(
        self,
        points: ObjectPoints,
        labels: LabelStore,
        config: ObjectConfig,
        sizes: ClassSizes | None = None,
    ) -> None:
        self._points, self._labels, self._config, self._sizes = points, labels, config, sizes

    def objects(self, poses: dict[int, Array], ground: Ground) -> list[MapObject]:
        """The current objects by id, from the keyframes whose poses are given."""
        found = [self._judged(o, ground) for o in self._whole(poses, ground.up_world)]
        return sorted((o for o in found if o is not None), key=lambda o: o.id)

    def landmark_evidence(
        self, poses: dict[int, Array], ground: Ground
    ) -> tuple[Ints, Ints, Array]:
        """Landmarks (N,) on objects, each one's class (N,), and log P(size and place | class)."""
        ids, labels, factors = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros(0)]
        if self._labels.model is not None and self._sizes is not None:
            for o in self._whole(poses, ground.up_world):
                of_class = size_and_place(o.box, ground, self._sizes, self._config.publication)
                ids.append(o.landmark_ids)
                labels.append(np.full(len(o.landmark_ids), o.label))
                factors.append(np.full(len(o.landmark_ids), of_class[o.label]))
        return np.concatenate(ids), np.concatenate(labels), np.concatenate(factors)

    def _whole(self, poses: dict[int, Array], up_world: Array) -> list[MapObject]:
        """All objects that enough keyframes observed, with their parts."""
        points = self._points_by_object(poses)
        candidates = self._candidates(points, up_world)
        whole = same_things(candidates)
        found = []
        for k in np.unique(whole).tolist():
            parts = [candidates[j] for j in np.flatnonzero(whole == k).tolist()]
            found.append(self._joined(candidates[k], parts, points, up_world))
        return found

    def _points_by_object(self, poses: dict[int, Array]) -> dict[int, ObjectSurface]:
        """The points of each object."""
        owners, points = self._points.in_world(poses)
        noise = self._config.association.depth_sigma_m * self._points.rays_in_world(poses)
        views = self._points.views(poses)
        covered = self._points.covered_shares(poses)
        rows = {i: owners == i for i in np.unique(owners).tolist()}
        tables = points, noise, views, covered
        return {i: ObjectSurface(*(t[k] for t in tables)) for i, k in rows.items()}

    def _candidates(self, by_object: dict[int, ObjectSurface], up_world: Array) -> list[MapObject]:
        """All objects that enough keyframes observed."""
        box_config = self._config.box
        found = []
        for i, surface in by_object.items():
            keyframe_ids, stamps_s = self._points.sightings(i)
            if len(keyframe_ids) < self._config.min_keyframes:
                continue
            distribution = self._labels.probabilities(np.array([i]))[0]
            label = int(self._labels.appearance(np.array([i]))[0].argmax())
            centroid, box = fitted(surface, up_world, box_config)
            landmarks = self._points.landmarks_of(i)
            first_s, last_s = float(stamps_s.min()), float(stamps_s.max())
            rest = keyframe_ids, landmarks, first_s, last_s
            found.append(MapObject(i, label, distribution, centroid, box, *rest))
        return found

    def _joined(
        self,
        whole: MapObject,
        parts: list[MapObject],
        points: dict[int, ObjectSurface],
        up_world: Array,
    ) -> MapObject:
        """An object with those that are parts of it, itself among them."""
        if len(parts) == 1:
            return whole
        own = ObjectSurface.joined([points[o.id] for o in parts])
        centroid, box = fitted(own, up_world, self._config.box)
        return replace(
            whole,
            centroid_world=centroid,
            box=box,
            keyframe_ids=np.unique(np.concatenate([o.keyframe_ids for o in parts])),
            landmark_ids=np.unique(np.concatenate([o.landmark_ids for o in parts])),
            first_seen_s=min(o.first_seen_s for o in parts),
            last_seen_s=max(o.last_seen_s for o in parts),
        )

    def _judged(self, o: MapObject, ground: Ground) -> MapObject | None:
        """An object after its size and place are considered; None if it is not reported."""
        config = self._config.publication
        if self._sizes is not None and not stands_still(self._sizes)[o.label]:
            return None
        if self._labels.model is None or self._sizes is None:
            return o
        factors = size_and_place(o.box, ground, self._sizes, config)
        p = judged(o.distribution, factors)
        label = int(p.argmax())
        named = self._labels.named(np.array([o.id]))[0, label]
        enough = self._labels.evidence(np.array([o.id]))[0] >= config.min_evidence
        sure = label > 0 and p[label] >= config.min_probability and stands_still(self._sizes)[label]
        reported = named and enough and sure
        return replace(o, label=label, distribution=p) if reported else None
