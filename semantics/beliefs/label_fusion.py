"""How views of a thing are fused: likelihoods of what masks say, and of what they miss."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import betaln

from bmask_slam.graph.arrays import Array, Floats, Ints
from bmask_slam.semantics.beliefs.class_sizes import ANY, SUPPORT, TOP, ClassSizes


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
    was seen. Where the recall was measured, a and b have its mean and the same sum.

    A mask of what things lie on (a table) covers these too, so it says little against them: it
    raises the log odds of its class over "unknown" to ``support_log_odds`` at most.

    Another view from a viewpoint that was counted already has ``again`` times the usual weight.
    """

    prior_unknown: float = 0.5
    recall_found: float = 2.0
    recall_missed: float = 0.4
    recall_views: float = 10.0
    power: float = 1.0
    max_log_odds: float = 9.0
    again: float = 0.15
    support_log_odds: float = 6.0

    def __post_init__(self) -> None:
        if not 0 < self.power <= 1 or not 1 <= self.max_log_odds < np.inf:
            raise ValueError("power must be in (0, 1], max_log_odds at least 1")
        if not 0 < self.prior_unknown < 1:
            raise ValueError("prior_unknown must be between 0 and 1")
        if min(self.recall_found, self.recall_missed) <= 0:
            raise ValueError("recall_found and recall_missed must be positive")
        if self.recall_views < 1:
            raise ValueError("recall_views must be at least 1")
        if not 0 <= self.again <= 1:
            raise ValueError("again must be in [0, 1]")

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

    def log_likelihoods(self, distributions: Floats, weights: Floats) -> Floats:
        """Their logarithms (N, C) times ``power``, bounded by ``max_log_odds``."""
        floor = np.float32(np.exp(-self.max_log_odds))
        likelihood = np.maximum(self.likelihoods(distributions, weights), floor)
        return np.float32(self.power) * np.log(likelihood)

    def limited(
        self, gained: Floats, distributions: Floats, log_p: Floats, sizes: ClassSizes
    ) -> Floats:
        """What masks of distributions (N, C) add to beliefs (N, C), of supports only so much.

        Nothing is taken from what may lie on them. ``gained`` (N, C) is changed.
        """
        supports = sizes.is_in(SUPPORT)
        labels = distributions[:, 1:].argmax(axis=1) + 1
        rows = np.flatnonzero(supports[labels])
        k = labels[rows]
        over = log_p[rows, k] - log_p[rows, 0]
        room = np.maximum(np.float32(self.support_log_odds) - over, 0)
        own, nothing = gained[rows, k], gained[rows, 0]
        small = np.flatnonzero(sizes.is_in(TOP, ANY))
        at = np.ix_(rows, small)
        gained[at] = np.maximum(gained[at], nothing[:, None])
        gained[rows, k] = np.minimum(own, nothing + room)
        return gained

    def log_missed(self, misses: Floats, recall: Array | None = None) -> Array:
        """log P(m misses (...) | a known class); m is the sum of the views' weights.

        ``recall`` (...) is the class's measured recall.
        """
        a, b = np.array(self.recall_found), np.array(self.recall_missed)
        if recall is not None:
            a, b = recall * (a + b), (1 - recall) * (a + b)
        return np.asarray(betaln(a, b + misses.astype(float)) - betaln(a, b))


def in_turn(ids: Ints) -> Iterator[Ints]:
    """Rows of ids (N,) which may repeat: all first ones, all second ones and so on.

    In each part all ids differ, so views of many things are fused at once, and those of one thing
    one after another.
    """
    order = np.argsort(ids, kind="stable")
    begins = np.flatnonzero(np.diff(ids[order], prepend=-1))
    turn = np.empty(len(ids), np.int64)
    turn[order] = np.arange(len(ids)) - np.repeat(begins, np.diff(begins, append=len(ids)))
    by_turn = np.argsort(turn, kind="stable")
    if len(ids):
        yield from np.split(by_turn, np.cumsum(np.bincount(turn))[:-1])
