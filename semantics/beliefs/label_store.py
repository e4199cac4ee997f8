"""Class beliefs of many landmarks or objects at once, by their ids."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaln

from bmask_slam.graph.arrays import Array, Arrays, Floats, Ints
from bmask_slam.graph.files.array_file import check_ids

_MIN_CAPACITY = 1024


@dataclass(frozen=True)
class LabelStoreConfig:
    """How views are fused.

    The prior probability of "unknown" is ``prior_unknown``; the other labels share the rest.
    Errors of one network in views of the same thing are correlated; to give each view less weight,
    its likelihood is raised to a ``power`` below 1. No class falls more than ``max_log_odds``
    below the likeliest one, so that a wrong belief can be corrected.

    A view in which no mask covers a thing is evidence for "unknown", with less weight the more
    such views there are: what a network missed in one view it misses in the next. The network's
    recall of a thing is a Beta variable with the parameters ``recall_found`` a and
    ``recall_missed`` b, so that m misses of a thing of a known class have the probability
    B(a, b + m) / B(a, b). Like what masks say, misses are bounded: m is their sum over about the
    last ``recall_views`` views, so that it tells how often a thing is missed and not how often it
    was seen.
    """

    prior_unknown: float = 0.5
    recall_found: float = 2.0
    recall_missed: float = 0.4
    recall_views: float = 10.0
    power: float = 1.0
    max_log_odds: float = 9.0

    def __post_init__(self) -> None:
        if not 0 < self.power <= 1 or not 1 <= self.max_log_odds < np.inf:
            raise ValueError("power must be in (0, 1], max_log_odds at least 1")
        if not 0 < self.prior_unknown < 1:
            raise ValueError("prior_unknown must be between 0 and 1")
        if min(self.recall_found, self.recall_missed) <= 0:
            raise ValueError("recall_found and recall_missed must be positive")
        if self.recall_views < 1:
            raise ValueError("recall_views must be at least 1")

    def prior(self, classes: int) -> Array:
        """The prior (C,) over classes."""
        if classes == 1:
            return np.ones(1)
        rest = (1 - self.prior_unknown) / (classes - 1)
        return np.array([self.prior_unknown] + [rest] * (classes - 1))

    def likelihoods(self, distributions: Floats, weights: Floats) -> Floats:
        """Likelihoods (N, C) of each class, relative to no view.

        A view is a distribution p (C,) that is right with probability ``weights`` w (N,) and
        uninformative otherwise. A network's distribution is a posterior, so the likelihood is
        w p(c) / prior(c) + 1 - w: after one view the belief is w p + (1 - w) prior.
        """
        prior = self.prior(distributions.shape[1]).astype(np.float32)
        return weights[:, None] * distributions / prior + (1 - weights[:, None])

    def log_missed(self, misses: Floats) -> Array:
        """log P(m misses (N,) | a known class); m is the sum of the views' weights."""
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
    """A categorical distribution over C labels for every id >= 0; label 0 is "unknown".

    Kept as the log likelihood of all views, relative to the prior.
    """

    def __init__(self, classes: int, config: LabelStoreConfig | None = None) -> None:
        self.classes = classes
        self.config = config or LabelStoreConfig()
        self._prior = self.config.prior(classes)
        self._clear()

    def __len__(self) -> int:
        """One more than the largest id that had a view."""
        known = self.known()
        return int(known[-1]) + 1 if len(known) else 0

    def update(self, ids: Ints, distributions: Floats, weights: Floats) -> None:
        """Fuse views of ids (N,), which may repeat.

        Each view is a distribution (N, C) that is right with probability weight (N,) and
        uninformative otherwise.
        """
        if not len(ids):
            return
        self._reserve(int(ids.max()) + 1)
        likelihood = self.config.likelihoods(distributions, weights)
        floor = np.float32(np.exp(-self.config.max_log_odds))
        gained = np.float32(self.config.power) * np.log(np.maximum(likelihood, floor))
        self._add(ids, gained, np.ones(len(ids), np.int32))
        np.multiply.at(self._misses, ids, np.float32(1 - 1 / self.config.recall_views))

    def miss(self, ids: Ints, weights: Floats) -> None:
        """Count views of ids (N,), which may repeat, that no mask covers, with weights (N,)."""
        if len(ids):
            self._reserve(int(ids.max()) + 1)
            np.multiply.at(self._misses, ids, 1 - weights / np.float32(self.config.recall_views))
            np.add.at(self._misses, ids, weights)
            np.add.at(self._views, ids, 1)

    def move(self, from_ids: Ints, to_ids: Ints) -> None:
        """Add all views of from_ids (N,) to those of to_ids (N,): each pair is one thing."""
        if not len(from_ids):
            return
        self._reserve(int(max(from_ids.max(), to_ids.max())) + 1)
        gained, views = self._log_p[from_ids], self._views[from_ids]
        misses = self._misses[from_ids]
        self._reset(from_ids)
        self._add(to_ids, gained, views)
        np.add.at(self._misses, to_ids, misses)
        self._limit_misses(to_ids)
        self._resize(len(self))

    def drop(self, ids: Ints) -> None:
        """Reset ids (N,) to the prior."""
        self._reset(ids[ids < len(self._views)])
        self._resize(len(self))

    def known(self) -> Ints:
        """Ids (N,) that had a view, ascending."""
        return np.flatnonzero(self._views)

    def probabilities(self, ids: Ints) -> Array:
        """Distributions (N, C) of any ids (N,); the prior where there was no view."""
        inside = ids < len(self._views)
        log_p = np.tile(np.log(self._prior), (len(ids), 1))
        log_p[inside] += self._log_p[ids[inside]]
        log_p[inside, 1:] += self.config.log_missed(self._misses[ids[inside]])[:, None]
        p = np.exp(log_p - log_p.max(axis=1, keepdims=True, initial=-np.inf))
        return p / p.sum(axis=1, keepdims=True)

    def estimates(self, ids: Ints) -> LabelEstimates:
        """The likeliest label of any ids (N,), with its probability, entropy and views."""
        p = self.probabilities(ids)
        labels = p.argmax(axis=1) if len(ids) else np.zeros(0, np.int64)
        entropy = -(p * np.log(np.maximum(p, 1e-30))).sum(axis=1)
        views = np.zeros(len(ids), np.int64)
        inside = ids < len(self._views)
        views[inside] = self._views[ids[inside]]
        return LabelEstimates(labels, p[np.arange(len(ids)), labels], entropy, views)

    def state(self) -> Arrays:
        """The store as named arrays with one row for each id that had a view."""
        ids = self.known()
        return {
            "ids": ids,
            "log_p": self._log_p[ids].ravel(),
            "views": self._views[ids],
            "misses": self._misses[ids],
        }

    def restore(self, state: Arrays) -> None:
        """Replace the content by a state.

        Further arrays, as older files hold, are ignored. Older files count all misses.
        """
        ids = state["ids"]
        check_ids(ids, int(ids.max(initial=-1)) + 1)
        self._clear()
        self._reserve(int(ids.max(initial=-1)) + 1)
        self._log_p[ids] = state["log_p"].reshape(len(ids), self.classes)
        self._views[ids] = state["views"]
        self._misses[ids] = state["misses"]
        self._limit_misses(ids)
        self._resize(len(self))

    def _add(self, ids: Ints, gained: Floats, views: NDArray[np.int32]) -> None:
        if len(np.unique(ids)) == len(ids):
            self._log_p[ids] += gained
            self._views[ids] += views
        else:
            np.add.at(self._log_p, ids, gained)
            np.add.at(self._views, ids, views)
        log_p = self._log_p[ids]
        log_p -= log_p.max(axis=1, keepdims=True)
        self._log_p[ids] = np.maximum(log_p, np.float32(-self.config.max_log_odds))

    def _limit_misses(self, ids: Ints) -> None:
        limit = np.float32(self.config.recall_views)
        self._misses[ids] = np.minimum(self._misses[ids], limit)

    def _reset(self, ids: Ints) -> None:
        self._log_p[ids] = 0.0
        self._views[ids] = self._misses[ids] = 0

    def _clear(self) -> None:
        self._log_p: Floats = np.zeros((_MIN_CAPACITY, self.classes), np.float32)
        self._views: NDArray[np.int32] = np.zeros(_MIN_CAPACITY, np.int32)
        self._misses: Floats = np.zeros(_MIN_CAPACITY, np.float32)

    def _reserve(self, size: int) -> None:
        if size > len(self._views):
            self._resize(size)

    def _resize(self, size: int) -> None:
        """Set the capacity to the next power of two: a function of the size alone."""
        capacity = max(_MIN_CAPACITY, 1 << max(size - 1, 0).bit_length())
        if len(self._views) != capacity:
            self._log_p = _resized(self._log_p, capacity)
            self._views = _resized(self._views, capacity)
            self._misses = _resized(self._misses, capacity)


def _resized(table: NDArray[Any], rows: int) -> NDArray[Any]:
    """The table cut, or extended by zeros, to a number of rows."""
    found = np.zeros((rows, *table.shape[1:]), table.dtype)
    kept = min(rows, len(table))
    found[:kept] = table[:kept]
    return found
