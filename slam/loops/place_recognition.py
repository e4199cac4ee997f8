"""Which old keyframes show the same place: descriptors vote, and votes must repeat.

Candidates are grouped by covisibility, and a group must be found in consecutive queries (as in
ORB-SLAM, Mur-Artal 2015, VII.A). The result are candidates; slam/loops/verification.py decides
whether they are loops.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np

from bmask_slam.features.descriptor_index import DescriptorIndex, Votes
from bmask_slam.graph.arrays import Arrays, Bits
from bmask_slam.graph.files.array_file import split_rows

Neighbours = Callable[[int], Collection[int]]  # keyframe id -> ids of the covisible ones


@dataclass(frozen=True)
class PlaceConfig:
    """Conditions for a candidate.

    The ``recent`` last keyframes and those covisible with the query are no candidates. A keyframe
    needs ``min_votes``; a group needs ``group_share`` of the best group's votes, and must have
    been found by ``consistent_queries`` queries in a row. At most ``candidates`` are returned. A
    place that was dismissed is none for ``patience`` keyframes.
    """

    recent: int = 10
    min_votes: float = 8.0
    group_share: float = 0.6
    consistent_queries: int = 2
    candidates: int = 3
    patience: int = 10


@dataclass(frozen=True)
class PlaceCandidate:
    """A keyframe that may show the same place as the query.

    Attributes:
        keyframe_id: the one with the most votes in its group.
        votes: of this keyframe; ``group_votes``: of it and the keyframes covisible with it.
        queries: how many queries in a row, this one included, found this group.
    """

    keyframe_id: int
    votes: float
    group_votes: float
    queries: int


@dataclass(frozen=True)
class _Group:
    """Keyframes covisible with their best one; its votes, and all that no better group has."""

    members: frozenset[int]
    best: int
    votes: float
    all_votes: float


class PlaceRecogniser:
    """Keeps the groups of the last query; the index may be shared with relocalisation."""

    def __init__(self, index: DescriptorIndex, config: PlaceConfig | None = None):
        self.index = index
        self.config = config or PlaceConfig()
        self._previous: list[tuple[frozenset[int], int]] = []
        # Keyframe of a place, and the last that looked like it
        self._dismissed: dict[int, int] = {}

    def state(self) -> Arrays:
        """The groups that the last query found, and what was dismissed."""
        groups = [sorted(group) for group, _ in self._previous]
        return {
            "members": np.array([k for group in groups for k in group], np.int64),
            "sizes": np.array([len(group) for group in groups], np.int64),
            "queries": np.array([queries for _, queries in self._previous], np.int64),
            "dismissed": np.array(list(self._dismissed.items()), np.int64).reshape(-1, 2),
        }

    def restore(self, state: Arrays) -> None:
        """Become the recogniser of a state; the index is not part of it."""
        groups = split_rows(state["members"], state["sizes"])
        self._previous = [
            (frozenset(group.tolist()), queries)
            for group, queries in zip(groups, state["queries"].tolist(), strict=True)
        ]
        self._dismissed = dict(state["dismissed"].tolist())

    def dismiss(self, place: int, keyframe_id: int) -> None:
        """A keyframe looks like a place, that of another one, but cannot be there.

        Nor can those that follow, which look like it too.
        """
        self._dismissed[place] = keyframe_id

    def query(
        self, keyframe_id: int, descriptors: Bits, covisible: Neighbours
    ) -> list[PlaceCandidate]:
        """Candidates for a keyframe's place, best group first; call it once a keyframe.

        ``covisible`` gives the ids of the keyframes that share landmarks with one.
        """
        since = keyframe_id - self.config.patience
        self._dismissed = {k: last for k, last in self._dismissed.items() if last >= since}
        votes = self.index.votes(descriptors, self.excluded(keyframe_id, covisible))
        groups = self._groups(votes, covisible)
        found = [
            PlaceCandidate(g.best, g.votes, g.all_votes, self._repeats(g.members) + 1)
            for g in groups
        ]
        self._previous = [(g.members, c.queries) for g, c in zip(groups, found, strict=True)]
        needed = self.config.consistent_queries
        consistent = [candidate for candidate in found if candidate.queries >= needed]
        return consistent[: self.config.candidates]

    def excluded(self, keyframe_id: int, covisible: Neighbours) -> set[int]:
        """The keyframes that are no candidates: recent ones, and those covisible with this one."""
        recent = self.index.keyframe_ids[-self.config.recent :] if self.config.recent else []
        return {keyframe_id, *recent, *covisible(keyframe_id)}

    def _groups(self, votes: Votes, covisible: Neighbours) -> list[_Group]:
        """The groups with most votes, best first; each keyframe's votes count once."""
        counts = dict(zip(votes.keyframe_ids.tolist(), votes.scores.tolist(), strict=True))
        groups: list[_Group] = []
        used: set[int] = set()
        for best, own in counts.items():  # most votes first
            if own < self.config.min_votes:
                break
            if best in used:
                continue
            members = frozenset({best, *covisible(best)})
            total = sum(counts.get(member, 0.0) for member in sorted(members - used))
            used |= members
            if members.isdisjoint(self._dismissed):
                groups.append(_Group(members, best, own, total))
        groups.sort(key=lambda group: (-group.all_votes, group.best))
        limit = self.config.group_share * groups[0].all_votes if groups else 0.0
        return [group for group in groups if group.all_votes >= limit]

    def _repeats(self, group: frozenset[int]) -> int:
        """The largest number of consecutive earlier queries that found this group."""
        return max((queries for old, queries in self._previous if old & group), default=0)
