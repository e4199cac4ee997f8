"""Evidence that two objects are one, or that one object is two."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.semantics.objects.association import Overlap, class_affinity


@dataclass(frozen=True)
class RevisionConfig:
    """When objects are merged or split.

    A keyframe is evidence for a merge where one detection covers the share ``covered`` of both
    objects, the two make up that share of the detection (or it would be what they lie on), and
    their class distributions have an affinity (Bhattacharyya) of ``min_affinity``; against it,
    where each object has a detection of its own. It is evidence for a split where two detections
    cover the share ``part`` or more of one object each; a split gives the points nearest
    to the other detection, within ``reach_m``, to a new object. A revision is made when the
    keyframes for it outnumber those against it by ``needed``; the difference is limited to
    ``most`` against, so that it can be reversed.
    """

    covered: float = 0.5
    part: float = 0.2
    reach_m: float = 0.5
    min_affinity: float = 0.5
    needed: int = 2
    most: int = 4


class MergeEvidence:
    """Number of keyframes for a revision less those against it, by pair of object ids."""

    def __init__(self, config: RevisionConfig) -> None:
        self.config = config
        self._counts: dict[tuple[int, int], int] = {}

    def add(self, key: tuple[int, int], step: int) -> None:
        """Count a keyframe for (+1) or against (-1) a revision."""
        value = self._counts.get(key, 0) + step
        self._counts[key] = max(-self.config.most, min(self.config.needed, value))

    def decided(self, key: tuple[int, int]) -> bool:
        """Whether there is enough evidence for the revision."""
        return self._counts.get(key, 0) >= self.config.needed

    def drop(self, object_id: int) -> None:
        """Drop every pair that holds an object."""
        self._counts = {key: v for key, v in self._counts.items() if object_id not in key}

    def state(self) -> Ints:
        """Rows (N, 3) of pair and count, sorted by pair."""
        rows = [(a, b, n) for (a, b), n in sorted(self._counts.items())]
        return np.array(rows, np.int64).reshape(-1, 3)

    def restore(self, rows: Ints) -> None:
        """Replace the content by a state."""
        self._counts = {(a, b): n for a, b, n in rows.tolist()}


def merges(
    overlap: Overlap, assigned: Ints, known: Array, config: RevisionConfig
) -> list[tuple[int, int, int]]:
    """Pairs of objects a < b and +1 (one detection covers both) or -1 (each has its own).

    ``assigned`` (D,) is the object of each detection or -1, ``known`` (O, C) the objects'
    class distributions.
    """
    covers = (overlap.of_object >= config.covered) & (overlap.in_view > 0)
    alike = class_affinity(known, known) >= config.min_affinity
    share = np.where(covers, overlap.of_detection, -1.0)
    whole = share[:, :, None] + share[:, None] >= config.covered  # no sum with -1 reaches it
    joint = whole.any(axis=0) & alike
    own = np.zeros(overlap.of_object.shape[1], bool)
    own[assigned[assigned >= 0]] = True
    apart = own[:, None] & own[None]
    found = [(a, b, 1) for a, b in np.argwhere(np.triu(joint & ~apart, 1)).tolist()]
    near = overlap.in_view > 0
    against = np.triu(apart & alike & near[:, None] & near[None], 1)
    return found + [(a, b, -1) for a, b in np.argwhere(against).tolist()]


def splits(overlap: Overlap, config: RevisionConfig) -> list[tuple[int, int]]:
    """Objects with +1 (two detections share it) or -1 (one detection covers all of it)."""
    shared = (overlap.of_object >= config.part).sum(axis=0) >= 2
    whole = (overlap.of_object >= 1 - config.part / 2).any(axis=0)
    return [(o, 1) for o in np.flatnonzero(shared).tolist()] + [
        (o, -1) for o in np.flatnonzero(whole).tolist()
    ]
