"""What is known of the class of many things at once: landmarks or objects, by their ids."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaln

from bmask_slam.graph.arrays import Array, Arrays, Floats, Ints

_FIRST_CAPACITY = 1024


@dataclass(frozen=True)
class LabelStoreConfig:
    """How views are fused.

    Before the first view "unknown" has a probability of ``prior_unknown``, and the other labels
    share the rest. Views of one thing by one network err together; to count each for less, take
    its likelihood to the ``power`` of less than 1. No class becomes less likely than the
    likeliest one by more than ``max_log_odds``, so that a wrong belief can be overcome.

    A view in which no mask lies on a thing speaks for "unknown", the less the more there are: what
    a network missed in one view it misses in the next. The share of views in which it finds a
    thing is a Beta variable of the thing, with ``recall_found`` and ``recall_missed`` as its
    parameters, so m misses of a thing with a class have the probability B(a, b + m) / B(a, b).
    """

    prior_unknown: float = 0.5
    recall_found: float = 2.0
    recall_missed: float = 0.4
    power: float = 1.0
    max_log_odds: float = 9.0

    def __post_init__(self) -> None:
        if not 0 < self.power <= 1 or not 1 <= self.max_log_odds < np.inf:
            raise ValueError("power must be in (0, 1], max_log_odds at least 1")
        if not 0 < self.prior_unknown < 1:
            raise ValueError("prior_unknown must be between 0 and 1")
        if min(self.recall_found, self.recall_missed) <= 0:
            raise ValueError("recall_found and recall_missed must be positive")

    def prior(self, classes: int) -> Array:
        """(C,) what a thing is before the first view."""
        rest = (1 - self.prior_unknown) / max(classes - 1, 1)
        return (
            np.array([self.prior_unknown] + [rest] * (classes - 1)) if classes > 1 else np.ones(1)
        )

    def likelihoods(self, distributions: Floats, weights: Floats) -> Floats:
        """Of each class given views (N, C) that are right with probability weight (N,) and else
        say nothing, relative to no view.

        A network's distribution is a posterior, so the likelihood is w p(c) / prior(c) + 1 - w:
        after one view the belief is w p + (1 - w) prior.
        """
        prior = self.prior(distributions.shape[1]).astype(np.float32)
        return weights[:, None] * distributions / prior + (1 - weights[:, None])

    def log_missed(self, misses: Floats) -> Array:
        """log P(m misses (N,) | a thing with a class), m not whole where a view was half sure."""
        a, b = self.recall_found, self.recall_missed
        return np.asarray(betaln(a, b + misses.astype(float)) - betaln(a, b))


@dataclass(frozen=True)
class LabelEstimates:
    """Labels (N,), their probability (N,), entropy (N,) in nats, number of views (N,)."""

    labels: Ints
    probability: Array
    entropy: Array
    views: Ints


class LabelStore:
    """A categorical distribution over C labels for every id from 0 on; label 0 is "unknown".

    Kept in log space, as what views have added to the prior. Beside it are kept Dirichlet counts,
    which tell a thing that was seen often from one that was seen once.
    """

    def __init__(self, classes: int, config: LabelStoreConfig | None = None) -> None:
        self.classes = classes
        self.config = config or LabelStoreConfig()
        self._prior = self.config.prior(classes)
        self._clear()

    def __len__(self) -> int:
        """One more than the largest id that had a view."""
        seen = np.flatnonzero(self._views)
        return int(seen[-1]) + 1 if len(seen) else 0

    def update(self, ids: Ints, distributions: Floats, weights: Floats) -> None:
        """Views of things ids (N,), each by a distribution (N, C) that is right with probability
        weight (N,) and else says nothing. An id may repeat.
        """
        if not len(ids):
            return
        self._reserve(int(ids.max()) + 1)
        likelihood = self.config.likelihoods(distributions, weights)
        floor = np.float32(np.exp(-self.config.max_log_odds))
        gained = np.float32(self.config.power) * np.log(np.maximum(likelihood, floor))
        counts = weights[:, None] * distributions
        self._add(ids, gained, counts, np.ones(len(ids), np.int32))

    def miss(self, ids: Ints, weights: Floats) -> None:
        """Views of things ids (N,) on which no mask lies, with weights (N,). An id may repeat."""
        if len(ids):
            self._reserve(int(ids.max()) + 1)
            np.add.at(self._misses, ids, weights)
            np.add.at(self._views, ids, 1)

    def move(self, from_ids: Ints, to_ids: Ints) -> None:
        """What is known of from_ids (N,) is known of to_ids (N,) as well; both are one thing."""
        if not len(from_ids):
            return
        self._reserve(int(max(from_ids.max(), to_ids.max())) + 1)
        gained, counts = self._log_p[from_ids], self._counts[from_ids]
        views, misses = self._views[from_ids], self._misses[from_ids]
        self.drop(from_ids)
        self._add(to_ids, gained, counts, views)
        np.add.at(self._misses, to_ids, misses)

    def drop(self, ids: Ints) -> None:
        """Forget things (N,)."""
        ids = ids[ids < len(self._views)]
        self._log_p[ids] = self._counts[ids] = 0.0
        self._views[ids] = self._misses[ids] = 0
        self._resize(len(self))

    def known(self) -> Ints:
        """Ids (N,) of which there was a view, rising."""
        return np.flatnonzero(self._views)

    def probabilities(self, ids: Ints) -> Array:
        """(N, C) for any ids (N,); the prior where there was no view."""
        inside = ids < len(self._views)
        log_p = np.tile(np.log(self._prior), (len(ids), 1))
        log_p[inside] += self._log_p[ids[inside]]
        log_p[inside, 1:] += self.config.log_missed(self._misses[ids[inside]])[:, None]
        p = np.exp(log_p - log_p.max(axis=1, keepdims=True, initial=-np.inf))
        return p / p.sum(axis=1, keepdims=True)

    def dirichlet(self, ids: Ints) -> Array:
        """Concentrations (N, C) of any ids (N,): the prior and all views by their weights."""
        inside = ids < len(self._views)
        alpha = np.tile(self._prior, (len(ids), 1))
        alpha[inside] += self._counts[ids[inside]]
        alpha[inside, 0] += self._misses[ids[inside]]
        return alpha

    def estimates(self, ids: Ints) -> LabelEstimates:
        """The likeliest label of each of any ids (N,), and how sure that is."""
        p = self.probabilities(ids)
        labels = p.argmax(axis=1) if len(ids) else np.zeros(0, np.int64)
        entropy = -(p * np.log(np.maximum(p, 1e-30))).sum(axis=1)
        views = np.zeros(len(ids), np.int64)
        inside = ids < len(self._views)
        views[inside] = self._views[ids[inside]]
        return LabelEstimates(labels, p[np.arange(len(ids)), labels], entropy, views)

    def state(self) -> Arrays:
        """What is known, as named arrays with one row for each id that had a view."""
        ids = self.known()
        return {
            "ids": ids,
            "log_p": self._log_p[ids].ravel(),
            "counts": self._counts[ids].ravel(),
            "views": self._views[ids],
            "misses": self._misses[ids],
        }

    def restore(self, state: Arrays) -> None:
        """Become the store of a state."""
        ids = state["ids"]
        self._clear()
        self._reserve(int(ids.max(initial=-1)) + 1)
        self._log_p[ids] = state["log_p"].reshape(len(ids), self.classes)
        self._counts[ids] = state["counts"].reshape(len(ids), self.classes)
        self._views[ids] = state["views"]
        self._misses[ids] = state["misses"]
        self._resize(len(self))

    def _add(self, ids: Ints, gained: Floats, counts: Floats, views: NDArray[np.int32]) -> None:
        if len(np.unique(ids)) == len(ids):
            self._log_p[ids] += gained
            self._counts[ids] += counts
            self._views[ids] += views
        else:
            np.add.at(self._log_p, ids, gained)
            np.add.at(self._counts, ids, counts)
            np.add.at(self._views, ids, views)
        log_p = self._log_p[ids]
        log_p -= log_p.max(axis=1, keepdims=True)
        self._log_p[ids] = np.maximum(log_p, np.float32(-self.config.max_log_odds))

    def _clear(self) -> None:
        self._log_p: Floats = np.zeros((_FIRST_CAPACITY, self.classes), np.float32)
        self._counts: Floats = np.zeros((_FIRST_CAPACITY, self.classes), np.float32)
        self._views: NDArray[np.int32] = np.zeros(_FIRST_CAPACITY, np.int32)
        self._misses: Floats = np.zeros(_FIRST_CAPACITY, np.float32)

    def _reserve(self, size: int) -> None:
        if size > len(self._views):
            self._resize(size)

    def _resize(self, size: int) -> None:
        """Room for a number of ids: the next power of two, so that it depends on that alone."""
        capacity = max(_FIRST_CAPACITY, 1 << max(size - 1, 0).bit_length())
        if len(self._views) != capacity:
            self._log_p = _resized(self._log_p, capacity)
            self._counts = _resized(self._counts, capacity)
            self._views = _resized(self._views, capacity)
            self._misses = _resized(self._misses, capacity)


def _resized(table: NDArray[Any], rows: int) -> NDArray[Any]:
    """A table with so many rows, zeros where it had none."""
    found = np.zeros((rows, *table.shape[1:]), table.dtype)
    kept = min(rows, len(table))
    found[:kept] = table[:kept]
    return found
