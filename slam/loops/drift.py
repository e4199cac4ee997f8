"""How far the map can have drifted between two keyframes, by the way and by what loops showed."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from bmask_slam.graph.arrays import Array, Arrays
from bmask_slam.graph.factors.checks import mahalanobis
from bmask_slam.graph.factors.observability import diagonal_covariance
from bmask_slam.graph.geometry import adjoint, inverse, se3_exp, se3_log
from bmask_slam.loops.noise import DIMENSIONS, NoiseConfig
from bmask_slam.loops.verification import LoopConstraint
from bmask_slam.world.covisibility import CovisiblePaths, Way
from bmask_slam.world.world_map import WorldMap

ALIKE_FOR_M = 4.0
"""For so much of a way errors are alike; on longer ways they are a sum of independent ones."""
LEAST_SHARED = 10
"""A link of fewer landmarks is held as well as by so many: by tracking and what else is near."""
INFORMATIVE = 9.0
"""Loops tell of the drift where its covariance is so many times as large as their own."""


class MapDrift:
    """The drift that is possible on a way through the map, less where loops have shown less.

    Before any loop was closed the map may drift as ``NoiseConfig`` states, which allows for a bad
    camera. Each set of loops that is confirmed shows how far it did drift: the mean square of what
    they imply, over what was possible, scales the covariance from then on, with the weight of
    ``prior_closings`` closings that found all of it, and with a margin.

    A map in which places look alike, as the rooms of an office do, is held to ``alike_share`` of
    the drift: there a wrong loop is likelier than a map that has drifted far (`alike_elsewhere`).
    That they do is known by a verified loop which is far from possible: by ``alike_excess`` times
    the chi-square allowed.

    Attributes:
        places_look_alike: whether such a loop was found.
    """

    def __init__(self, config: NoiseConfig) -> None:
        self.config = config
        self.places_look_alike = False
        self._sum, self._closings = 0.0, 0

    @property
    def scale(self) -> float:
        """Factor of the covariances, at most 1."""
        rules = self.config
        ratio = (rules.prior_closings + self._sum) / (rules.prior_closings + self._closings)
        alike = rules.alike_share**2 if self.places_look_alike else 1.0
        return alike * min(rules.drift_margin * ratio, 1.0)

    def state(self) -> Arrays:
        """What was learned."""
        return {"learned": np.array([self._sum, self._closings, self.places_look_alike], float)}

    def restore(self, state: Arrays) -> None:
        """Go on from a state."""
        learned_sum, closings, alike = state["learned"].tolist()
        self._sum, self._closings, self.places_look_alike = learned_sum, int(closings), bool(alike)

    def covariance(self, way: Way) -> Array:
        """Covariance (6, 6) of T_a_b, as a tangent in b, by a way from a to b."""
        return self.floor + self.scale * self._possible(way)

    def alike_elsewhere(self, implied: Array, S: Array) -> bool:
        """Whether a loop is explained better by a place that looks alike than by drift.

        Drift puts the camera (6,) ``implied`` away with a density that falls with S (6, 6), the
        covariances of the loop and of the way; places that look alike are one in
        ``alike_spacing_m`` cubed. The longer the way, the less tells even a loop that implies no
        drift.
        """
        if not self.places_look_alike:
            return False
        moved, S_moved = implied[None, 3:], S[3:, 3:]
        return self._alike_likelier(float(mahalanobis(moved, S_moved[None])[0]), S_moved)

    def _alike_likelier(self, chi2: float, S_moved: Array) -> bool:
        """Whether a look-alike is likelier than drift by this chi-square, of S_moved (3, 3)."""
        minus_2_log = chi2 + float(np.linalg.slogdet(2 * np.pi * S_moved)[1])
        rules = self.config
        return minus_2_log > 2 * math.log(rules.alike_spacing_m**3 / rules.alike_odds)

    def out_of_reach(self, ends: tuple[int, int], paths: CovisiblePaths, gate: float) -> bool:
        """Whether any loop between two keyframes is refused where places look alike.

        Keyframes that show the same place are within ``reach_m``. Those that the map has further
        apart imply so much drift at least: too much, or less likely than a look-alike.
        """
        if not self.places_look_alike or not len((way := paths.way(*ends)).poses):
            return False
        S_moved = self.covariance(way)[3:, 3:]
        apart_m = float(np.linalg.norm(way.poses[0, :3, 3] - way.poses[-1, :3, 3]))
        beyond_m = max(apart_m - self.config.reach_m, 0.0)
        least_chi2 = beyond_m**2 / float(np.linalg.eigvalsh(S_moved)[-1])
        return least_chi2 > gate or self._alike_likelier(least_chi2, S_moved)

    def learn(
        self, implied: Sequence[Array], covariances: Sequence[Array], ways: Sequence[Way]
    ) -> None:
        """Learn from N loops that were confirmed together, which count once.

        Args:
            implied: (6,) the drift that each implies, as a tangent [rotation rad, m].
            covariances: (6, 6) of the loops themselves.
            ways: those between their ends.
        """
        shares = []
        for xi, own, way in zip(implied, covariances, ways, strict=True):
            possible = self.floor + self._possible(way)
            if len(way.poses) and (np.diagonal(possible) > INFORMATIVE * np.diagonal(own)).all():
                shares.append(float(mahalanobis(xi[None], possible[None])[0]) / DIMENSIONS)
        if shares:
            self._sum += float(np.mean(shares))
            self._closings += 1

    @property
    def floor(self) -> Array:
        """Covariance (6, 6) of T_a_b without any way between a and b."""
        return diagonal_covariance(self.config.model_sigma_rad, self.config.model_sigma_m)

    def _possible(self, way: Way) -> Array:
        """The drift that ``NoiseConfig`` states, carried to the end of a way by adjoints.

        An error of the camera model or of the depth's scale is the same for the whole way, so that
        those of turns to the left and to the right cancel, and those of the way there and back:
        each component of a turn adds an unknown multiple of itself to all six of the step, each
        move is too long by an unknown share. Other errors are alike for ``ALIKE_FOR_M`` of a way.
        Each step adds the error of its own link, which few landmarks in common hold badly.
        """
        poses, shared = way
        if len(poses) < 2:
            return np.zeros((DIMENSIONS, DIMENSIONS))
        rules = self.config
        steps = se3_log(inverse(poses[:-1]) @ poses[1:])
        to_end = adjoint(inverse(poses[-1]) @ poses[:-1] @ se3_exp(steps / 2))
        bent = np.einsum("nij,nk->ijk", to_end, steps[:, :3]).reshape(DIMENSIONS, -1)
        lengths_m = np.linalg.norm(steps[:, 3:], axis=1)
        walked_m = np.cumsum(lengths_m) - lengths_m
        begins = np.flatnonzero(np.diff(walked_m // ALIKE_FOR_M, prepend=-1.0))
        walked = np.add.reduceat(to_end * lengths_m[:, None, None], begins)
        per_m = diagonal_covariance(rules.drift_rad_per_m, rules.drift_m_per_m)
        drifted = (walked @ per_m @ walked.swapaxes(1, 2)).sum(axis=0)
        too_long = np.einsum("nij,nj->i", to_end[:, :, 3:], steps[:, 3:])
        scale = rules.drift_m_per_m**2 * np.outer(too_long, too_long)
        linked = to_end * (rules.link_rad / np.maximum(shared, LEAST_SHARED))[:, None, None]
        links = (linked @ linked.swapaxes(1, 2)).sum(axis=0)
        return rules.model_share**2 * bent @ bent.T + scale + drifted + links


def implied_drift(loop: LoopConstraint, world: WorldMap) -> Array:
    """The tangent (6,) by which the map's relative pose differs from a loop's."""
    a, b = (world.keyframes[k].T_world_camera for k in loop.ends)
    return se3_log(inverse(loop.T_a_b) @ inverse(a) @ b)
