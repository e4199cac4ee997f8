"""Marginalised landmarks: their observations, and the factors that replace them in the graph.

A chunk is a set of observations that were marginalised together, and the relative poses (kind
MARGINAL) that replace them. A marginalised landmark has a summary: one observation in one keyframe
that says all that is known of it given the poses.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from bmask_slam.graph.arrays import Array, Ints, Mask
from bmask_slam.graph.factors.graph_update import Observations

_Index = dict[int, tuple[int, ...]]
"""Numbers by id, ascending: most ids have one or a few, which take a fifth of a set's memory."""


@dataclass(frozen=True)
class Chunk:
    """Observations that were marginalised together.

    Attributes:
        observations: as they were in the graph.
        is_summary: (M,) those that were themselves summaries of earlier chunks.
        numbers: of the pose factors that replace them.
    """

    observations: Observations
    is_summary: Mask
    numbers: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Summary:
    """One observation ``(u_left, v, u_right)`` with sigmas of u, v and disparity in pixels."""

    keyframe_id: int
    measurement: Array
    sigmas_px: Array


@dataclass
class MarginalisedLandmarks:
    """Chunks by number, and the summary of every landmark that is out of the graph or came back.

    Attributes:
        summaries: of landmarks that are out of the graph.
        returned: of landmarks that came back with it as an observation.
        bases: keyframes that the relative poses of others refer to
            (`graph.marginals.sparsification`).
        observers: keyframes of each landmark's marginalised observations, without summaries.
    """

    chunks: dict[int, Chunk] = field(default_factory=dict)
    summaries: dict[int, Summary] = field(default_factory=dict)
    returned: dict[int, Summary] = field(default_factory=dict)
    bases: set[int] = field(default_factory=set)
    observers: _Index = field(default_factory=dict)
    next_number: int = 0
    _of_landmark: _Index = field(default_factory=dict)
    _of_keyframe: _Index = field(default_factory=dict)

    def add(self, chunk: Chunk, number: int) -> None:
        """Add a chunk, under ``next_number`` or the number that it had before."""
        self.next_number = max(self.next_number, number + 1)
        self.chunks[number], observations = chunk, chunk.observations
        for landmark in np.unique(observations.landmark_ids).tolist():
            _add(self._of_landmark, landmark, number)
        for keyframe in np.unique(observations.keyframe_ids).tolist():
            _add(self._of_keyframe, keyframe, number)
        for keyframe, landmark in chunk.observations.select(~chunk.is_summary).pairs.tolist():
            _add(self.observers, landmark, keyframe)

    def number_on(self) -> None:
        """Number further chunks after those that there are, as if all were read from a file."""
        self.next_number = max(self.chunks, default=-1) + 1

    def remove(self, number: int) -> Chunk:
        """Remove a chunk and return it."""
        chunk = self.chunks.pop(number)
        for landmark in np.unique(chunk.observations.landmark_ids).tolist():
            _discard(self._of_landmark, landmark, number)
        for keyframe in np.unique(chunk.observations.keyframe_ids).tolist():
            _discard(self._of_keyframe, keyframe, number)
        for keyframe, landmark in chunk.observations.select(~chunk.is_summary).pairs.tolist():
            _discard(self.observers, landmark, keyframe)
        return chunk

    def chunks_with(self, keyframes: Iterable[int], landmarks: Iterable[int]) -> list[int]:
        """Numbers of the chunks with any of these, ascending."""
        found: set[int] = set()
        for index, ids in ((self._of_keyframe, keyframes), (self._of_landmark, landmarks)):
            found.update(*(index.get(i, ()) for i in ids))
        return sorted(found)

    def newest_with(self, landmark: int) -> int:
        """Number of the last chunk that has observations of a landmark; -1 for none."""
        return max(self._of_landmark.get(landmark, ()), default=-1)

    def contains(self, keyframe: int, landmark: int) -> bool:
        """Whether this observation was marginalised; it must not enter the graph a second time.

        False in the keyframe of the landmark's summary, where the summary itself enters.
        """
        summary = self.summaries.get(landmark)
        if summary is not None and summary.keyframe_id == keyframe:
            return False
        return keyframe in self.observers.get(landmark, ())

    def are_summaries(self, keyframes: Ints, landmarks: Ints) -> Mask:
        """Mask (M,) of the pairs that are the summary with which a landmark came back."""
        hosts = [
            -1 if (s := self.returned.get(j)) is None else s.keyframe_id for j in landmarks.tolist()
        ]
        return np.array(hosts, np.int64) == keyframes


def _add(index: _Index, key: int, number: int) -> None:
    known = index.get(key, ())
    if number not in known:
        index[key] = tuple(sorted((*known, number)))


def _discard(index: _Index, key: int, number: int) -> None:
    left = tuple(n for n in index.get(key, ()) if n != number)
    if left:
        index[key] = left
    else:
        index.pop(key, None)
