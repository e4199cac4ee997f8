"""Beliefs about what landmarks lie on: a wall, the floor, a table, from all views of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array, Arrays, Floats, Ints
from bmask_slam.graph.files.array_file import check_ids
from bmask_slam.semantics.beliefs.label_fusion import in_turn
from bmask_slam.semantics.labels import LabelSet, label_set

CORRELATION = 0.6
"""Of the errors of one network in two views of a place. With 0.5 to 0.75 the landmarks of a real
room are calibrated to 0.06 to 0.08 (benchmarks/semantics/room_surfaces.py), with less too sure."""
LEAST_PROBABILITY = 1e-3
"""Least probability of a class in one view."""
MIN_PROBABILITY = 0.4
"""Below it a landmark is on nothing known."""
SURFACES_OF_THINGS = {
    "book": "books",
    "couch": "sofa",
    "dining table": "table",
    "tv": "television",
}
"""COCO's things that NYU40 has under another name."""


def independent_views(views: Array) -> Array:
    """To how many independent views n views (N,) amount: n / (1 + (n - 1) r), Kish 1965.

    r is CORRELATION. It is bounded by 1 / r: a belief does not become certain by looking on.
    """
    return np.asarray(views / (1 + np.maximum(views - 1, 0) * CORRELATION))


def pooled(log_sums: Array, views: Array) -> Array:
    """Distributions (N, C) of sums (N, C) of the logarithms of as many views (N,).

    The geometric mean of the views' distributions, raised to ``independent_views``; uniform where
    there is no view.
    """
    share = independent_views(views) / np.maximum(views, 1e-9)
    log_p = log_sums * share[:, None]
    p = np.exp(log_p - log_p.max(axis=1, keepdims=True))
    return np.asarray(p / p.sum(axis=1, keepdims=True))


def with_things(names: LabelSet, p: Array, things: LabelSet, p_things: Array) -> Array:
    """Distributions (N, C) of surfaces, with what is known of the things (N, T) at these places.

    What is on a thing has that thing's surface, if there is a class for it; of what is on none, or
    on one without a class, no more is known than p: sum_t P(t) [c is t's] + (1 - sum_t P(t)) p(c).
    """
    found = np.zeros_like(p)
    for k, name in enumerate(things.names[1:], start=1):
        if surface := names.number(SURFACES_OF_THINGS.get(name, name)):
            found[:, surface - 1] += p_things[:, k]
    return found + np.maximum(1 - found.sum(axis=1, keepdims=True), 0) * p


def log_view(probabilities: Floats) -> Floats:
    """The logarithm of a view's distributions (N, C), from which no class is excluded."""
    return np.log(np.maximum(probabilities, np.float32(LEAST_PROBABILITY)))


@dataclass(frozen=True)
class SurfaceEstimates:
    """What landmarks (N,) lie on: labels of ``names``, 0 where it is not known; probabilities."""

    names: LabelSet
    labels: Ints
    probability: Array

    @classmethod
    def of(cls, names: LabelSet, p: Array) -> SurfaceEstimates:
        """The likeliest classes of distributions (N, C)."""
        labels, best = p.argmax(axis=1) + 1, p.max(axis=1)
        return cls(names, np.where(best < MIN_PROBABILITY, 0, labels), best)


class SurfaceStore:
    """A distribution over the classes of surfaces for every id >= 0, and its number of views."""

    def __init__(self) -> None:
        self.names = label_set(())
        self._log_sums = np.zeros((0, 0), np.float32)
        self._views = np.zeros(0, np.int32)

    def update(self, names: LabelSet, ids: Ints, probabilities: Floats) -> None:
        """Add views of ids (N,), which may repeat, with distributions (N, C).

        Views with another label set than the first ones' are not used.
        """
        if len(self.names) == 1:
            self.names = names
            self._log_sums = np.zeros((0, len(names) - 1), np.float32)
        if names != self.names or not len(ids):
            return
        self._reserve(int(ids.max()) + 1)
        gained = log_view(probabilities)
        for rows in in_turn(ids):
            self._log_sums[ids[rows]] += gained[rows]
        np.add.at(self._views, ids, 1)

    def move(self, from_ids: Ints, to_ids: Ints) -> None:
        """Add all views of from_ids (N,) to those of to_ids (N,): each pair is one thing."""
        inside = from_ids < len(self._views)
        from_ids, to_ids = from_ids[inside], to_ids[inside]
        if not len(from_ids):
            return
        self._reserve(int(to_ids.max()) + 1)
        sums, views = self._log_sums[from_ids], self._views[from_ids]
        self.drop(from_ids)
        np.add.at(self._log_sums, to_ids, sums)
        np.add.at(self._views, to_ids, views)

    def drop(self, ids: Ints) -> None:
        """Forget ids (N,)."""
        ids = ids[ids < len(self._views)]
        self._log_sums[ids] = 0
        self._views[ids] = 0

    def known(self) -> Ints:
        """Ids (N,) that had a view, ascending."""
        return np.flatnonzero(self._views)

    def probabilities(self, ids: Ints) -> Array:
        """Distributions (N, C) of any ids (N,); uniform where there was no view."""
        sums, views = np.zeros((len(ids), len(self.names) - 1)), np.zeros(len(ids))
        inside = ids < len(self._views)
        sums[inside], views[inside] = self._log_sums[ids[inside]], self._views[ids[inside]]
        return pooled(sums, views)

    def state(self) -> Arrays:
        """The store as named arrays with one row for each id that had a view."""
        ids = self.known()
        return {
            "names": np.array(self.names.names),
            "ids": ids,
            "log_sums": self._log_sums[ids].ravel(),
            "views": self._views[ids],
        }

    def restore(self, state: Arrays) -> None:
        """Replace the content by a state."""
        ids = state["ids"]
        check_ids(ids, int(ids.max(initial=-1)) + 1)
        self.names = LabelSet(tuple(state["names"].tolist()))
        self._log_sums = np.zeros((0, len(self.names) - 1), np.float32)
        self._views = np.zeros(0, np.int32)
        self._reserve(int(ids.max(initial=-1)) + 1)
        self._log_sums[ids] = state["log_sums"].reshape(len(ids), len(self.names) - 1)
        self._views[ids] = state["views"]

    def _reserve(self, size: int) -> None:
        """Make room for ids below ``size``: the next power of two of rows."""
        if size > len(self._views):
            more = (1 << max(size - 1, 1023).bit_length()) - len(self._views)
            self._log_sums = np.pad(self._log_sums, ((0, more), (0, 0)))
            self._views = np.pad(self._views, (0, more))
