"""Class beliefs of many landmarks or objects at once, by their ids."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Arrays, Floats, Ints, Mask
from bmask_slam.graph.files.array_file import check_ids
from bmask_slam.semantics.beliefs.label_fusion import LabelStoreConfig, in_turn
from bmask_slam.semantics.beliefs.observation import GROUPS, ObservationModel, score_logits

_MIN_CAPACITY = 1024
_VIEWPOINTS = 64
_NAMED = 2.0
"""Log likelihood by which a class that a mask named is above what none named."""
_NEWER = ("scores", "seen", "judged")
"""Tables that states of older versions lack."""
_TABLES = ("_log_p", "_views", "_misses", *(f"_{name}" for name in _NEWER))


@dataclass(frozen=True)
class LabelEstimates:
    """Labels (N,), their probability (N,), entropy (N,) in nats, number of views (N,)."""

    labels: Ints
    probability: Array
    entropy: Array
    views: Ints


class LabelStore:
    """A categorical distribution over C labels for every id >= 0; label 0 is "unknown".

    Kept as the log likelihood of all views, relative to the prior. With a ``model`` this says what
    a thing looks like; what it is then follows from the model's precision and confusion, for
    landmarks or ``of_objects``.
    """

    def __init__(
        self,
        classes: int,
        config: LabelStoreConfig | None = None,
        model: ObservationModel | None = None,
        of_objects: bool = False,
    ) -> None:
        self.classes = classes
        self.config = config or LabelStoreConfig()
        self.model = model
        self._of_objects = of_objects
        self._prior = self.config.prior(classes)
        self._clear()

    def __len__(self) -> int:
        """One more than the largest id that had a view."""
        known = self.known()
        return int(known[-1]) + 1 if len(known) else 0

    def update(
        self, ids: Ints, distributions: Floats, weights: Floats, viewpoints: Ints | None = None
    ) -> None:
        """``fuse`` views (N,) that masks cover, with distributions (N, C) and weights (N,)."""
        none = np.zeros((0, 1), np.float32)
        self.fuse(ids, np.zeros(len(ids), bool), (distributions, weights), none, viewpoints)

    def miss(self, ids: Ints, weights: Floats, viewpoints: Ints | None = None) -> None:
        """``fuse`` views (N,) that no mask covers, with weights (N,) or (N, GROUPS)."""
        none = np.zeros((0, self.classes), np.float32), np.zeros(0, np.float32)
        if len(ids):
            misses = weights.reshape(len(ids), -1)
            self.fuse(ids, np.ones(len(ids), bool), none, misses, viewpoints)

    def fuse(
        self,
        ids: Ints,
        missed: Mask,
        told: tuple[Floats, Floats],
        misses: Floats,
        viewpoints: Ints | None = None,
    ) -> None:
        """Fuse views of ids (N,), one after another where these repeat.

        Where a view is not ``missed`` (N,), masks ``told`` a distribution (M, C) that is right with
        probability weight (M,) and uninformative otherwise. Where it is, no mask covers the thing:
        ``misses`` (N - M, GROUPS or 1) are weights, for each group of classes of like size.
        ``viewpoints`` (N,) below 64 say from where.
        """
        if not len(ids):
            return
        self._reserve(int(ids.max()) + 1)
        new = self._novelty(ids, viewpoints)
        np.add.at(self._views, ids, 1)
        added = np.zeros((len(ids), self._misses.shape[1]), np.float32)
        added[missed] = misses * new[missed, None]
        worth = np.where(missed[:, None], added, new[:, None])
        kept = 1 - worth / np.float32(self.config.recall_views)
        for rows in in_turn(ids):
            at = ids[rows]
            self._misses[at] = self._misses[at] * kept[rows] + added[rows]
        self._fuse_masks(ids[~missed], *told, new[~missed])

    def _fuse_masks(self, ids: Ints, distributions: Floats, weights: Floats, new: Floats) -> None:
        """Fuse what masks tell of ids (N,), by how ``new`` (N,) their viewpoints are."""
        gained = self.config.log_likelihoods(distributions, weights) * new[:, None]
        worth = weights * new
        scored = np.stack([worth * score_logits(distributions), worth], axis=1)
        np.add.at(self._scores, ids, scored)
        sizes = None if self.model is None or self._of_objects else self.model.sizes
        for rows in in_turn(ids):
            at, part = ids[rows], gained[rows]
            if sizes is not None:
                part = self.config.limited(part, distributions[rows], self._log_p[at], sizes)
            self._log_p[at] += part
            self._bound(at)

    def move(self, from_ids: Ints, to_ids: Ints) -> None:
        """Add all views of from_ids (N,) to those of to_ids (N,): each pair is one thing."""
        if not len(from_ids):
            return
        self._reserve(int(max(from_ids.max(), to_ids.max())) + 1)
        gained, views = self._log_p[from_ids], self._views[from_ids]
        misses, scores, seen = (t[from_ids] for t in (self._misses, self._scores, self._seen))
        self._reset(from_ids)
        np.add.at(self._log_p, to_ids, gained)
        self._bound(to_ids)
        np.add.at(self._views, to_ids, views)
        np.add.at(self._misses, to_ids, misses)
        np.add.at(self._scores, to_ids, scores)
        np.bitwise_or.at(self._seen, to_ids, seen)
        self._limit_misses(to_ids)
        self._resize(len(self))

    def drop(self, ids: Ints) -> None:
        """Reset ids (N,) to the prior."""
        self._reset(ids[ids < len(self._views)])
        self._resize(len(self))

    def known(self) -> Ints:
        """Ids (N,) that had a view, ascending."""
        return np.flatnonzero(self._views)

    def appearance(self, ids: Ints) -> Array:
        """P(class that it looks like) (N, C) of any ids (N,); the prior where there was no view."""
        inside = ids < len(self._views)
        log_p = np.tile(np.log(self._prior), (len(ids), 1))
        log_p[inside] += self._log_p[ids[inside]]
        log_p[inside, 1:] += self._log_missed(ids[inside])
        p = np.exp(log_p - log_p.max(axis=1, keepdims=True, initial=-np.inf))
        return np.asarray(p / p.sum(axis=1, keepdims=True))

    def probabilities(self, ids: Ints) -> Array:
        """Distributions (N, C) of any ids (N,): what they are, as far as that is known."""
        p = self.appearance(ids)
        if self.model is None:
            return p
        inside, scores = ids < len(self._views), np.zeros((len(ids), 2))
        scores[inside] = self._scores[ids[inside]]
        scores[:, 0] /= np.maximum(scores[:, 1], 1e-9)
        if self._of_objects:
            return self.model.truth(p, scores, self.model.object_precision(scores))
        right = self.model.thing_precision(scores)
        rows, judged = np.flatnonzero(inside), self._judged[ids[inside]]
        at = rows, judged[:, 0].astype(int)
        odds = right[at] / (1 - right[at]) * np.exp(judged[:, 1])
        right[at] = odds / (1 + odds)
        return self.model.truth(p, scores, right * self.model.on_thing(scores))

    def named(self, ids: Ints) -> Mask:
        """Whether masks named each class (N, C), of ids (N,) that have views.

        One that others outvoted by nearly ``max_log_odds`` is forgotten.
        """
        log_p = self._log_p[ids]
        found: Mask = log_p > log_p.min(axis=1, keepdims=True) + np.float32(_NAMED)
        found[:, 0] = False
        return found

    def evidence(self, ids: Ints) -> Array:
        """Number of views (N,) of any ids (N,) by their weights and whether they were new."""
        found, inside = np.zeros(len(ids)), ids < len(self._views)
        found[inside] = self._scores[ids[inside], 1]
        return found

    def judge(self, ids: Ints, labels: Ints, log_factors: Array) -> None:
        """Set what else is known of ids (N,), in place of all that was set before.

        A log likelihood (N,) of one class (N,) of the thing that each is on, relative to others.
        """
        self._judged[:] = 0
        if len(ids):
            self._reserve(int(ids.max()) + 1)
            self._judged[ids] = np.stack([labels, log_factors], axis=1)

    def _log_missed(self, ids: Ints) -> Array:
        """log P(misses | class) (N, C - 1) or (N, 1) of ids (N,) in the tables."""
        misses, recall = self._misses[ids], None
        if self.model is not None:
            misses, recall = misses[:, self.model.groups[1:]], self.model.best_recall[1:]
        found, rows = np.zeros(misses.shape), misses.any(axis=1)  # the others have 0
        found[rows] = self.config.log_missed(misses[rows], recall)
        return found

    def estimates(self, ids: Ints) -> LabelEstimates:
        """The likeliest label of any ids (N,), with its probability, entropy and views."""
        p = self.probabilities(ids)
        labels = p.argmax(axis=1) if len(ids) else np.zeros(0, np.int64)
        entropy = -(p * np.log(np.maximum(p, 1e-30))).sum(axis=1)
        views, inside = np.zeros(len(ids), np.int64), ids < len(self._views)
        views[inside] = self._views[ids[inside]]
        return LabelEstimates(labels, p[np.arange(len(ids)), labels], entropy, views)

    def state(self) -> Arrays:
        """The store as named arrays with one row for each id that had a view."""
        ids = self.known()
        return {
            "ids": ids,
            "log_p": self._log_p[ids].ravel(),
            "views": self._views[ids],
            "misses": self._misses[ids].ravel(),
            **{name: getattr(self, f"_{name}")[ids] for name in _NEWER},
        }

    def restore(self, state: Arrays) -> None:
        """Replace the content by a state."""
        ids = state["ids"]
        check_ids(ids, int(ids.max(initial=-1)) + 1)
        self._clear()
        self._reserve(int(ids.max(initial=-1)) + 1)
        self._log_p[ids] = state["log_p"].reshape(len(ids), self.classes)
        self._views[ids] = state["views"]
        if len(ids):
            misses = state["misses"].reshape(len(ids), -1)
            fits = misses.shape[1] == self._misses.shape[1]
            self._misses[ids] = misses if fits else misses.mean(axis=1, keepdims=True)
        for name in _NEWER:
            getattr(self, f"_{name}")[ids] = state.get(name, 0)
        self._limit_misses(ids)
        self._resize(len(self))

    def _bound(self, ids: Ints) -> None:
        log_p = self._log_p[ids]
        log_p -= log_p.max(axis=1, keepdims=True)
        self._log_p[ids] = np.maximum(log_p, np.float32(-self.config.max_log_odds))

    def _novelty(self, ids: Ints, viewpoints: Ints | None) -> Floats:
        """Weights (N,) of views by whether their viewpoints (N,) are new; they then are no more."""
        if viewpoints is None:
            return np.ones(len(ids), np.float32)
        bits = np.left_shift(np.uint64(1), viewpoints.astype(np.uint64))
        known = (self._seen[ids] & bits) > 0
        again = np.ones(len(ids), bool)
        again[np.unique(ids * _VIEWPOINTS + viewpoints, return_index=True)[1]] = False
        known |= again
        np.bitwise_or.at(self._seen, ids, bits)
        return np.where(known, np.float32(self.config.again), np.float32(1))

    def _limit_misses(self, ids: Ints) -> None:
        self._misses[ids] = np.minimum(self._misses[ids], np.float32(self.config.recall_views))

    def _reset(self, ids: Ints) -> None:
        for name in _TABLES:
            getattr(self, name)[ids] = 0

    def _clear(self) -> None:
        self._log_p: Floats = np.zeros((_MIN_CAPACITY, self.classes), np.float32)
        self._views: NDArray[np.int32] = np.zeros(_MIN_CAPACITY, np.int32)
        groups = 1 if self.model is None else GROUPS
        self._misses: Floats = np.zeros((_MIN_CAPACITY, groups), np.float32)
        self._scores: Floats = np.zeros((_MIN_CAPACITY, 2), np.float32)
        self._seen: NDArray[np.uint64] = np.zeros(_MIN_CAPACITY, np.uint64)
        self._judged: Floats = np.zeros((_MIN_CAPACITY, 2), np.float32)

    def _reserve(self, size: int) -> None:
        if size > len(self._views):
            self._resize(size)

    def _resize(self, size: int) -> None:
        """Set the capacity to the next power of two: a function of the size alone."""
        capacity = max(_MIN_CAPACITY, 1 << max(size - 1, 0).bit_length())
        if len(self._views) != capacity:
            for name in _TABLES:
                setattr(self, name, _resized(getattr(self, name), capacity))


def _resized(table: NDArray[Any], rows: int) -> NDArray[Any]:
    """The table cut, or extended by zeros, to a number of rows."""
    found = np.zeros((rows, *table.shape[1:]), table.dtype)
    kept = min(rows, len(table))
    found[:kept] = table[:kept]
    return found
