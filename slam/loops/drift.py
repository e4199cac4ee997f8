"""How far the map can have drifted between two keyframes, by the way and by what loops showed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bmask_slam.graph.arrays import Array, Arrays
from bmask_slam.graph.factors.checks import mahalanobis
from bmask_slam.graph.factors.observability import diagonal_covariance
from bmask_slam.graph.geometry import inverse, se3_log
from bmask_slam.loops.noise import DIMENSIONS, NoiseConfig
from bmask_slam.loops.verification import LoopConstraint
from bmask_slam.world.world_map import WorldMap

ROOT_FROM_M = 4.0
"""On longer ways the drift grows with the root of the length, as a sum of independent errors."""
INFORMATIVE = 9.0
"""Loops tell of the drift where its covariance is so many times as large as their own."""


class MapDrift:
    """The drift that is possible on a way through the map, less where loops have shown less.

    Before any loop was closed the map may drift as ``NoiseConfig`` states, which allows for a bad
    camera. Each set of loops that is confirmed shows how far it did drift: the mean square of what
    they imply, over what was possible, scales the covariance from then on, with the weight of
    ``prior_closings`` closings that found all of it, and with a margin.

    A map in which places look alike, as the rooms of an office do, is held to ``alike_share`` of
    the drift: there a wrong loop is likelier than a map that has drifted far. That they do is known
    by a verified loop which is far from possible: by ``alike_excess`` times the chi-square allowed.

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

    def covariance(self, way: Array) -> Array:
        """Covariance (6, 6) of the map's relative pose over a way (3,), see ``CovisiblePaths``."""
        return self._covariance(way, np.sqrt(self.scale))

    def learn(
        self, implied: Sequence[Array], covariances: Sequence[Array], ways: Sequence[Array]
    ) -> None:
        """Learn from N loops that were confirmed together, which count once.

        Args:
            implied: (6,) the drift that each implies, as a tangent [rotation rad, m].
            covariances: (6, 6) of the loops themselves.
            ways: (3,) the ways between their ends, on which the map has drifted.
        """
        shares = []
        for xi, own, way in zip(implied, covariances, ways, strict=True):
            if not np.isfinite(way).all():
                continue
            possible = self._covariance(way, 1.0)
            if (np.diagonal(possible) > INFORMATIVE * np.diagonal(own)).all():
                shares.append(float(mahalanobis(xi[None], possible[None])[0]) / DIMENSIONS)
        if shares:
            self._sum += float(np.mean(shares))
            self._closings += 1

    def _covariance(self, way: Array, share: float) -> Array:
        """With so much of what ``NoiseConfig`` states.

        On a long way independent errors add up as squares, and an error of rotation displaces the
        end as far as the way leads away.
        """
        rules, (turn_rad, length_m, away_m) = self.config, way
        growth_m = np.minimum(length_m, np.sqrt(ROOT_FROM_M * length_m))
        bent, drift_rad = rules.model_share * turn_rad, rules.drift_rad_per_m * growth_m
        sigma_rad = np.hypot(rules.model_sigma_rad + share * bent, share * drift_rad)
        drift_m = np.hypot(rules.drift_m_per_m * growth_m, drift_rad / 2 * away_m)
        sigma_m = np.hypot(rules.model_sigma_m + share * bent, share * drift_m)
        return diagonal_covariance(sigma_rad, sigma_m)


def implied_drift(loop: LoopConstraint, world: WorldMap) -> Array:
    """The tangent (6,) by which the map's relative pose differs from a loop's."""
    a, b = (world.keyframes[k].T_world_camera for k in loop.ends)
    return se3_log(inverse(loop.T_a_b) @ inverse(a) @ b)
