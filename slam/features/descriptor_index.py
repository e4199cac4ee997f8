"""Descriptors of all keyframes, searched for those that look like a frame.

An inverted index over all keyframes' BRISK descriptors answers a query in milliseconds: every
descriptor of the query votes for the keyframes that hold a near one.
"""

from __future__ import annotations

from collections.abc import Collection
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass

import faiss
import numpy as np

from bmask_slam.graph.arrays import Array, Bits, Bytes, Ints, Mask

_Found = tuple[Ints, Ints, Ints]
"""What faiss found: where each query's rows begin and end, their distances, the rows."""
BITS = 512
ROWS_PER_LIST = 32  # before the index is partitioned
NOBODY = -1
"""Owner of a removed keyframe's rows; one that is added under its id again has rows of its own."""


@dataclass(frozen=True)
class IndexConfig:
    """A query votes with ``query_keypoints`` of its descriptors.

    A descriptor votes for a keyframe where its nearest neighbour there is within ``max_distance``
    bits, and where that distance times ``ratio`` is at most the one in the best keyframe of all.
    If n of K keyframes have a neighbour within the gate, a vote counts
    log((K + 1) / n) / log(K + 1) (inverse document frequency): 1 for a descriptor of one place
    only, 0 for one that all keyframes have.

    The index is searched exhaustively until it holds 32 times ``lists`` descriptors. Then it is
    partitioned into ``lists``, of which the ``probes`` nearest to a query are searched.
    """

    query_keypoints: int = 450
    max_distance: int = 70
    ratio: float = 0.8
    lists: int = 1024
    probes: int = 16

    def __post_init__(self) -> None:
        if min(self.query_keypoints, self.lists, self.probes) < 1:
            raise ValueError("query_keypoints, lists and probes must be at least 1")


@dataclass(frozen=True)
class Votes:
    """Keyframe ids (K,) with their weighted votes (K,) > 0, by falling votes, then rising id."""

    keyframe_ids: Ints
    scores: Array

    def __len__(self) -> int:
        return len(self.keyframe_ids)


class DescriptorIndex:
    """All keyframes' descriptors in a faiss binary index; grows and shrinks by keyframes.

    The same calls give the same votes. A removed keyframe's rows stay in the index and are
    ignored; the index is rebuilt when they are more than half of it.
    """

    def __init__(self, config: IndexConfig | None = None):
        self.config = config or IndexConfig()
        self._descriptors: dict[int, Bits] = {}
        self._ahead: tuple[Bytes, Future[_Found]] | None = None
        self._searcher = ThreadPoolExecutor(1, "place-search")
        self._clear()

    def __len__(self) -> int:
        """Number of keyframes in the index."""
        return len(self._descriptors)

    @property
    def keyframe_ids(self) -> list[int]:
        """Ids of the keyframes in the index, in the order of insertion."""
        return list(self._descriptors)

    def add(self, keyframe_id: int, descriptors: Bits) -> None:
        """Add a keyframe's descriptors (N, 8); they are not copied and must not be changed.

        Raises:
            ValueError: the keyframe is held already.
        """
        if keyframe_id in self._descriptors:
            raise ValueError(f"keyframe {keyframe_id} is already in the index")
        self._descriptors[keyframe_id] = descriptors
        self._append(keyframe_id, descriptors)
        if not self._partitioned and self._rows >= ROWS_PER_LIST * self.config.lists:
            self.rebuild()

    def restore(self, descriptors: dict[int, Bits]) -> None:
        """Replace the contents by these keyframes, (N, 8) descriptors by id."""
        self._descriptors = dict(descriptors)
        self.rebuild()

    def remove(self, keyframe_id: int) -> None:
        """Remove a keyframe; an id that is not in the index is ignored."""
        descriptors = self._descriptors.pop(keyframe_id, None)
        if descriptors is None:
            return
        self._removed += len(descriptors)
        self._owners[:] = [NOBODY if k == keyframe_id else k for k in self._owners]
        if 2 * self._removed > self._rows:
            self.rebuild()

    def search_ahead(self, descriptors: Bits) -> None:
        """Begin the search for descriptors (N, 8) in a thread; ``votes`` of the same will wait.

        The results are the same: a change of the index ends what was begun.
        """
        self._forget_search()
        query = self._query(descriptors)
        if self._rows and len(query):
            self._ahead = query, self._searcher.submit(self._search, query)

    def votes(self, descriptors: Bits, excluded: Collection[int] = ()) -> Votes:
        """Votes of descriptors (N, 8) for the keyframes in the index, without the excluded ones."""
        excluded = set(excluded)
        candidates = [k for k in self._descriptors if k not in excluded]
        allowed = np.zeros(max(candidates, default=-1) + 2, bool)  # the last, NOBODY's, stays False
        allowed[candidates] = True
        query, keyframe_ids, distance = self._near(descriptors)
        keep = allowed[np.minimum(keyframe_ids, len(allowed) - 1)]
        query, keyframe_ids, distance = query[keep], keyframe_ids[keep], distance[keep]
        best = np.full(len(descriptors), BITS)
        np.minimum.at(best, query, distance)
        pairs, clear = _unique_pairs(
            query, keyframe_ids, self.config.ratio * distance <= best[query]
        )
        common = np.bincount(pairs[0], minlength=len(descriptors))
        total = len(candidates) + 1
        ballots, voted_for = pairs[0][clear], pairs[1][clear]
        weights = np.log(total / common[ballots]) / np.log(total)
        ids, which = np.unique(voted_for, return_inverse=True)
        scores: Array = np.bincount(which, weights, minlength=len(ids)).astype(np.float64)
        order = np.lexsort((ids, -scores))
        return Votes(ids[order].astype(np.int64), scores[order])

    def _near(self, descriptors: Bits) -> tuple[Ints, Ints, Ints]:
        """(query row, keyframe id or NOBODY, Hamming distance) within the gate."""
        query = self._query(descriptors)
        if self._rows == 0 or len(query) == 0:
            return (np.zeros(0, np.int64),) * 3
        if self._ahead is not None and np.array_equal(self._ahead[0], query):
            limits, distance, rows = self._ahead[1].result()
        else:
            limits, distance, rows = self._search(query)
        owner = np.repeat(np.arange(len(query)), limits[1:] - limits[:-1])
        starts = np.array(self._starts)
        owners = np.array(self._owners)
        keyframe_ids = owners[np.searchsorted(starts, rows, side="right") - 1]
        return owner, keyframe_ids, distance

    def _query(self, descriptors: Bits) -> Bytes:
        """Those of the descriptors (N, 8) that vote, (M, 64)."""
        step = max(-(-len(descriptors) // self.config.query_keypoints), 1)
        return _bytes(descriptors[::step])

    def _search(self, query: Bytes) -> _Found:
        # faiss returns distances strictly below the radius
        limits, distance, rows = self._index.range_search(query, self.config.max_distance + 1)
        return limits.astype(np.int64), distance.astype(np.int64), rows

    def _forget_search(self) -> None:
        """Before the index changes: wait for the search that runs ahead, whose rows get invalid."""
        if self._ahead is not None:
            wait([self._ahead[1]])
        self._ahead = None

    def _append(self, keyframe_id: int, descriptors: Bits) -> None:
        self._forget_search()
        if len(descriptors) == 0:
            return
        self._starts.append(self._rows)
        self._owners.append(keyframe_id)
        self._index.add(_bytes(descriptors))
        self._rows += len(descriptors)

    def _clear(self) -> None:
        self._forget_search()
        self._index: faiss.IndexBinary = faiss.IndexBinaryFlat(BITS)
        self._partitioned = False
        self._rows = self._removed = 0
        self._starts: list[int] = []  # first row of each block of rows
        self._owners: list[int] = []  # and the keyframe whose block it is

    def rebuild(self) -> None:
        """Rebuild the index, partitioned if the keyframes have enough descriptors.

        The centres of the lists are descriptors picked at equal intervals. They find the same share
        of neighbours as k-means does, and need no training.
        """
        self._clear()
        total = sum(map(len, self._descriptors.values()))
        if total >= ROWS_PER_LIST * self.config.lists:
            everything = np.concatenate(list(self._descriptors.values()))
            centres = faiss.IndexBinaryFlat(BITS)
            picked = np.linspace(0, total - 1, self.config.lists).astype(np.int64)
            centres.add(_bytes(everything[picked]))
            self._index = faiss.IndexBinaryIVF(centres, BITS, self.config.lists)
            self._index.is_trained = True
            self._index.nprobe = self.config.probes
            self._partitioned = True
        for keyframe_id, descriptors in self._descriptors.items():
            self._append(keyframe_id, descriptors)


def _unique_pairs(query: Ints, keyframe_ids: Ints, clear: Mask) -> tuple[tuple[Ints, Ints], Mask]:
    """The unique (query, keyframe) pairs, and whether any neighbour of each passes the ratio."""
    order = np.lexsort((~clear, keyframe_ids, query))
    query, keyframe_ids = query[order], keyframe_ids[order]
    first = np.ones(len(query), bool)
    first[1:] = (query[1:] != query[:-1]) | (keyframe_ids[1:] != keyframe_ids[:-1])
    return (query[first], keyframe_ids[first]), clear[order][first]


def _bytes(descriptors: Bits) -> Bytes:
    """Descriptors (N, 8) uint64 as the (N, 64) uint8 that faiss and OpenCV take."""
    return np.ascontiguousarray(descriptors).view(np.uint8)
