"""Beliefs about what landmarks lie on: a wall, the floor, a table, from all views of each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Arrays, Floats, Ints
from bmask_slam.graph.files.array_file import check_ids
from bmask_slam.semantics.beliefs.id_tables import IdTables
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


class SurfaceStore(IdTables):
    """A distribution over the classes of surfaces for every id >= 0, and its number of views."""

    TABLES: ClassVar = {"_log_sums": np.add, "_views": np.add}

    def __init__(self) -> None:
        self._begin(label_set(()))

    def update(self, names: LabelSet, ids: Ints, probabilities: Floats) -> None:
        """Add views of ids (N,), which may repeat, with distributions (N, C).

        Views with another label set than the first ones' are not used.
        """
        if len(self.names) == 1:
            self._begin(names)
        if names != self.names or not len(ids):
            return
        at, gained = self._rows(ids), log_view(probabilities)
        for part in in_turn(at):
            self._log_sums[at[part]] += gained[part]
        np.add.at(self._views, at, 1)

    def known(self) -> Ints:
        """Ids (N,) that had a view, ascending."""
        return self._ids

    def probabilities(self, ids: Ints) -> Array:
        """Distributions (N, C) of any ids (N,); uniform where there was no view."""
        sums, views = self._of(self._log_sums, ids), self._of(self._views, ids)
        return pooled(sums.astype(float), views)

    def state(self) -> Arrays:
        """The store as named arrays with one row for each id that had a view."""
        return {
            "names": np.array(self.names.names),
            "ids": self._ids,
            "log_sums": self._log_sums.ravel(),
            "views": self._views,
        }

    def restore(self, state: Arrays) -> None:
        """Replace the content by a state."""
        ids = state["ids"]
        check_ids(ids, int(ids.max(initial=-1)) + 1)
        self._begin(LabelSet(tuple(state["names"].tolist())))
        rows = self._rows(ids)
        self._log_sums[rows] = state["log_sums"].reshape(len(ids), len(self.names) - 1)
        self._views[rows] = state["views"]

    def _begin(self, names: LabelSet) -> None:
        """Begin with an empty store of the classes of a label set."""
        self._ids = np.zeros(0, np.int64)
        self.names = names
        self._log_sums: Floats = np.zeros((0, len(names) - 1), np.float32)
        self._views: NDArray[np.int32] = np.zeros(0, np.int32)
