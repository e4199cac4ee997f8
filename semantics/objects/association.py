"""Association of detections to objects: one gated linear assignment a keyframe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from bmask_slam.graph.arrays import Array, Ints, Mask

_IMPOSSIBLE = 1e6
JOINED_DEPTH_M = 2.0
"""From about so far the objects of different maps were seen."""


@dataclass(frozen=True)
class AssociationConfig:
    """When a detection may be an object.

    Points belong to the same surface if they are within ``radius_m`` plus three sigmas of the
    depth, ``depth_sigma_m`` at 1 m, which grows with the square of the depth. One of the two must
    cover the share ``min_overlap`` of the other. The cost of a pair is the share that is not
    covered, plus ``class_weight`` times one minus the affinity of the class distributions, plus
    ``time_weight`` (1 - exp(-t / ``forget_s``)) where t is the time since the object's last
    sighting; it must not be above ``max_cost``. A part of a thing, or what it lies on, overlaps it
    wholly on one side and is of another class: with 1.0 it would be the same thing.
    """

    radius_m: float = 0.03
    depth_sigma_m: float = 0.002
    min_overlap: float = 0.2
    class_weight: float = 0.5
    time_weight: float = 0.05
    forget_s: float = 30.0
    max_cost: float = 0.75

    def reach_m(self, z_m: Array) -> Array:
        """Largest distance of points of one surface, at depths (...)."""
        return self.radius_m + 3 * self.depth_sigma_m * z_m**2


@dataclass(frozen=True, eq=False)
class Overlap:
    """Overlap of the surfaces of D detections and O objects.

    Attributes:
        of_detection: (D, O) share of the detection's points that lie on the object; each point
            counts for the object that is nearest to it.
        of_object: (D, O) share of the object's visible points that the detection covers.
        in_view: (O,) number of visible points of the object.
    """

    of_detection: Array
    of_object: Array
    in_view: Ints

    @classmethod
    def of_points(
        cls, detected: tuple[Array, Ints], known: tuple[Array, Ints], config: AssociationConfig
    ) -> Overlap:
        """Of points (N, 3) in one frame, all in view, each with its detection or object."""
        sizes = [np.bincount(numbers) for _, numbers in (detected, known)]
        reach_m, found = float(config.reach_m(np.array(JOINED_DEPTH_M))), []
        for a, b in ((0, 1), (1, 0)):
            (points, numbers), (others, owners) = (detected, known)[a], (detected, known)[b]
            hit = points_on_objects(points, others, owners, np.full(len(points), reach_m))
            on, shape = hit >= 0, (len(sizes[a]), len(sizes[b]))
            found.append(shares(numbers[on], hit[on], sizes[a], shape))
        return cls(found[0], found[1].T, sizes[1])


@dataclass(frozen=True, eq=False)
class Evidence:
    """Classes and times of a keyframe's D detections and O objects.

    Attributes:
        detected: (D, C) class distributions of the detections; ``known``: (O, C) of the objects.
        unseen_s: (O,) time since the object's last sighting.
    """

    detected: Array
    known: Array
    unseen_s: Array


def shares(first: Ints, second: Ints, sizes: Ints, shape: tuple[int, int]) -> Array:
    """Counts (A, B) of the pairs (first, second), as shares of sizes (A,)."""
    counts = np.zeros(shape)
    np.add.at(counts, (first, second), 1.0)
    return counts / np.maximum(sizes, 1)[:, None]


def points_on_objects(points: Array, object_points: Array, owners: Ints, reach_m: Array) -> Ints:
    """The object (P,) within reach (P,) that is nearest to each point (P, 3), -1 for none.

    ``object_points`` (N, 3) belong to objects ``owners`` (N,); all points in one frame.
    """
    found = np.full(len(points), -1)
    if not len(object_points) or not len(points):
        return found
    distance_m, nearest = KDTree(object_points).query(
        points, distance_upper_bound=float(reach_m.max())
    )
    near = distance_m <= reach_m
    found[near] = owners[nearest[near]]
    return found


def class_affinity(detected: Array, known: Array) -> Array:
    """Bhattacharyya coefficients (D, O) of distributions (D, C) and (O, C): 1 for equal ones."""
    return np.sqrt(detected) @ np.sqrt(known).T


def assign(overlap: Overlap, evidence: Evidence, config: AssociationConfig) -> Ints:
    """The object of each detection (D,), -1 for a new one; at most one detection an object."""
    found = np.full(overlap.of_detection.shape[0], -1)
    if not overlap.of_detection.size:
        return found
    affinity = class_affinity(evidence.detected, evidence.known)
    covered = 0.5 * (overlap.of_detection + overlap.of_object)
    age = 1.0 - np.exp(-evidence.unseen_s / config.forget_s)
    cost = 1.0 - covered + config.class_weight * (1.0 - affinity) + config.time_weight * age
    possible = allowed(overlap, config) & (cost <= config.max_cost)
    from scipy.optimize import linear_sum_assignment  # noqa: PLC0415 - loads slowly

    rows, columns = linear_sum_assignment(np.where(possible, cost, _IMPOSSIBLE))
    good = possible[rows, columns]
    found[rows[good]] = columns[good]
    return found


def allowed(overlap: Overlap, config: AssociationConfig) -> Mask:
    """Which pairs (D, O) overlap enough."""
    return np.asarray(
        np.maximum(overlap.of_detection, overlap.of_object) >= config.min_overlap, bool
    )
