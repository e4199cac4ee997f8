"""Class beliefs of many landmarks or objects at once, by their ids."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Arrays, Floats, Ints, Mask
from bmask_slam.graph.files.array_file import check_ids
from bmask_slam.semantics.beliefs.id_tables import IdTables
from bmask_slam.semantics.beliefs.label_fusion import LabelStoreConfig, in_turn
from bmask_slam.semantics.beliefs.observation import GROUPS, ObservationModel, score_logits

_VIEWPOINTS = 64
_NAMED = 2.0
"""Log likelihood by which a class that a mask named is above what none named."""
_NEWER = ("scores", "seen", "judged")
"""Tables that states of older versions lack."""


@dataclass(frozen=True)
class LabelEstimates:
    """Labels (N,), their probability (N,), entropy (N,) in nats, number of views (N,)."""

    labels: Ints
    probability: Array
    entropy: Array
    views: Ints


class LabelStore(IdTables):
    """A categorical distribution over C labels for every id >= 0; label 0 is "unknown".

    Kept as the log likelihood of all views, relative to the prior. With a ``model`` this says what
    a thing looks like; what it is then follows from the model's precision and confusion, for
    landmarks or ``of_objects``.
    """

    TABLES: ClassVar = {
        **dict.fromkeys(("_log_p", "_views", "_misses", "_scores"), np.add),
        "_seen": np.bitwise_or,
        "_judged": None,
    }

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
        at = self._rows(ids)
        new = self._novelty(at, viewpoints)
        np.add.at(self._views, at, 1)
        added = np.zeros((len(ids), self._misses.shape[1]), np.float32)
        added[missed] = misses * new[missed, None]
        worth = np.where(missed[:, None], added, new[:, None])
        kept = 1 - worth / np.float32(self.config.recall_views)
        for part in in_turn(at):
            rows = at[part]
            self._misses[rows] = self._misses[rows] * kept[part] + added[part]
        self._fuse_masks(at[~missed], *told, new[~missed])

    def _fuse_masks(self, rows: Ints, distributions: Floats, weights: Floats, new: Floats) -> None:
        """Fuse what masks tell of rows (N,), by how ``new`` (N,) their viewpoints are."""
        gained = self.config.log_likelihoods(distributions, weights) * new[:, None]
        worth = weights * new
        scored = np.stack([worth * score_logits(distributions), worth], axis=1)
        np.add.at(self._scores, rows, scored)
        sizes = None if self.model is None or self._of_objects else self.model.sizes
        for turn in in_turn(rows):
            at, part = rows[turn], gained[turn]
            if sizes is not None:
                part = self.config.limited(part, distributions[turn], self._log_p[at], sizes)
            self._log_p[at] += part
            self._bound(at)

    def move(self, from_ids: Ints, to_ids: Ints) -> None:
        """Add all views of from_ids (N,) to those of to_ids (N,): each pair is one thing."""
        super().move(from_ids, to_ids)
        rows = self._found(to_ids)[1]
        self._bound(rows)
        self._limit_misses(rows)

    def known(self) -> Ints:
        """Ids (N,) that had a view, ascending."""
        return self._ids[self._views > 0]

    def appearance(self, ids: Ints) -> Array:
        """P(class that it looks like) (N, C) of any ids (N,); the prior where there was no view."""
        log_p = np.log(self._prior) + self._of(self._log_p, ids)
        log_p[:, 1:] += self._log_missed(self._of(self._misses, ids))
        p = np.exp(log_p - log_p.max(axis=1, keepdims=True, initial=-np.inf))
        return np.asarray(p / p.sum(axis=1, keepdims=True))

    def probabilities(self, ids: Ints) -> Array:
        """Distributions (N, C) of any ids (N,): what they are, as far as that is known."""
        p = self.appearance(ids)
        if self.model is None:
            return p
        scores = self._of(self._scores, ids).astype(float)
        scores[:, 0] /= np.maximum(scores[:, 1], 1e-9)
        if self._of_objects:
            return self.model.truth(p, scores, self.model.object_precision(scores))
        right = self.model.thing_precision(scores)
        judged = self._of(self._judged, ids)
        of_label = np.arange(len(ids)), judged[:, 0].astype(int)
        odds = right[of_label] / (1 - right[of_label]) * np.exp(judged[:, 1])
        right[of_label] = odds / (1 + odds)
        return self.model.truth(p, scores, right * self.model.on_thing(scores))

    def named(self, ids: Ints) -> Mask:
        """Whether masks named each class (N, C), of ids (N,) that have views.

        One that others outvoted by nearly ``max_log_odds`` is forgotten.
        """
        log_p = self._of(self._log_p, ids)
        found: Mask = log_p > log_p.min(axis=1, keepdims=True) + np.float32(_NAMED)
        found[:, 0] = False
        return found

    def evidence(self, ids: Ints) -> Array:
        """Number of views (N,) of any ids (N,) by their weights and whether they were new."""
        return self._of(self._scores, ids)[:, 1].astype(float)

    def judge(self, ids: Ints, labels: Ints, log_factors: Array) -> None:
        """Set what else is known of ids (N,), in place of all that was set before.

        A log likelihood (N,) of one class (N,) of the thing that each is on, relative to others.
        """
        self._judged[:] = 0
        self.drop(self._ids[self._views == 0])  # that only were judged before
        if len(ids):
            rows = self._rows(ids)
            self._judged[rows] = np.stack([labels, log_factors], axis=1)

    def _log_missed(self, misses: Floats) -> Array:
        """log P(misses | class) (N, C - 1) or (N, 1) of misses (N, GROUPS or 1)."""
        recall = None
        if self.model is not None:
            misses, recall = misses[:, self.model.groups[1:]], self.model.best_recall[1:]
        found, some = np.zeros(misses.shape), misses.any(axis=1)  # the others have 0
        found[some] = self.config.log_missed(misses[some], recall)
        return found

    def estimates(self, ids: Ints) -> LabelEstimates:
        """The likeliest label of any ids (N,), with its probability, entropy and views."""
        p = self.probabilities(ids)
        labels = p.argmax(axis=1) if len(ids) else np.zeros(0, np.int64)
        entropy = -(p * np.log(np.maximum(p, 1e-30))).sum(axis=1)
        views = self._of(self._views, ids).astype(np.int64)
        return LabelEstimates(labels, p[np.arange(len(ids)), labels], entropy, views)

    def state(self) -> Arrays:
        """The store as named arrays with one row for each id that had a view."""
        rows = np.flatnonzero(self._views)
        return {
            "ids": self._ids[rows],
            "log_p": self._log_p[rows].ravel(),
            "views": self._views[rows],
            "misses": self._misses[rows].ravel(),
            **{name: getattr(self, f"_{name}")[rows] for name in _NEWER},
        }

    def restore(self, state: Arrays) -> None:
        """Replace the content by a state."""
        ids = state["ids"]
        check_ids(ids, int(ids.max(initial=-1)) + 1)
        self._clear()
        rows = self._rows(ids)
        self._log_p[rows] = state["log_p"].reshape(len(ids), self.classes)
        self._views[rows] = state["views"]
        if len(ids):
            misses = state["misses"].reshape(len(ids), -1)
            fits = misses.shape[1] == self._misses.shape[1]
            self._misses[rows] = misses if fits else misses.mean(axis=1, keepdims=True)
        for name in _NEWER:
            getattr(self, f"_{name}")[rows] = state.get(name, 0)
        self._limit_misses(rows)

    def _bound(self, rows: Ints) -> None:
        log_p = self._log_p[rows]
        log_p -= log_p.max(axis=1, keepdims=True)
        self._log_p[rows] = np.maximum(log_p, np.float32(-self.config.max_log_odds))

    def _novelty(self, rows: Ints, viewpoints: Ints | None) -> Floats:
        """Weights (N,) of views by whether their viewpoints (N,) are new; they then are no more."""
        if viewpoints is None:
            return np.ones(len(rows), np.float32)
        bits = np.left_shift(np.uint64(1), viewpoints.astype(np.uint64))
        known = (self._seen[rows] & bits) > 0
        again = np.ones(len(rows), bool)
        again[np.unique(rows * _VIEWPOINTS + viewpoints, return_index=True)[1]] = False
        known |= again
        np.bitwise_or.at(self._seen, rows, bits)
        return np.where(known, np.float32(self.config.again), np.float32(1))

    def _limit_misses(self, rows: Ints) -> None:
        self._misses[rows] = np.minimum(self._misses[rows], np.float32(self.config.recall_views))

    def _clear(self) -> None:
        self._ids = np.zeros(0, np.int64)
        groups = 1 if self.model is None else GROUPS
        self._log_p: Floats = np.zeros((0, self.classes), np.float32)
        self._views: NDArray[np.int32] = np.zeros(0, np.int32)
        self._misses: Floats = np.zeros((0, groups), np.float32)
        self._scores: Floats = np.zeros((0, 2), np.float32)
        self._seen: NDArray[np.uint64] = np.zeros(0, np.uint64)
        self._judged: Floats = np.zeros((0, 2), np.float32)
