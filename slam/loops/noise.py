"""How uncertain loops and the map are: cycles of loops, and the real noise of loops."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array, Arrays, Ints, Mask
from bmask_slam.graph.geometry import se3_log
from bmask_slam.graph.pose_graph.loop_consistency import cycle_chi2
from bmask_slam.loops.verification import LoopConstraint
from bmask_slam.world.world_map import WorldMap

DIMENSIONS = 6


@dataclass(frozen=True)
class NoiseConfig:
    """What is assumed of loops and map before they were compared.

    The inliers of a loop share errors, such as those of the camera model and of the landmarks of
    one map, so that its real covariance is a multiple of the one that independent inliers give.
    Before any loops were compared the multiple is ``prior_ratio``, with the weight of
    ``prior_loops``; loops within ``near_m`` of path at both ends are compared.

    The map's relative pose is trusted within ``drift_rad_per_m`` and ``drift_m_per_m`` of its
    path. Errors of the camera model (a wrong focal length, rows exposed in turn) grow with turns:
    ``model_share`` of the angle turned on the way, and as many metres, since points are some metres
    away. Keyframes that share few landmarks, as those of blurred images do, are badly linked: each
    step adds ``link_rad``, and as many metres, over the number of landmarks that its keyframes have
    in common. Without any path the sigmas are ``model_sigma_rad`` and ``model_sigma_m``. How far
    the map can have drifted over long ways is learned from loops (`loops.drift`), with the weight
    of ``prior_closings`` and the factor ``drift_margin`` on the covariance; where places look
    alike, by a loop with ``alike_excess`` times the chi-square allowed, it is ``alike_share`` of
    that, and a loop must be ``alike_odds`` times likelier to be right than to be of one of the
    look-alikes, which are ``alike_spacing_m`` apart. There keyframes are compared only if a loop
    between them could be accepted: those that show one place are within ``reach_m`` of each other.
    """

    prior_ratio: float = 4.0
    prior_loops: float = 3.0
    near_m: float = 1.0
    drift_rad_per_m: float = 0.005
    drift_m_per_m: float = 0.02
    model_sigma_rad: float = 0.003
    model_sigma_m: float = 0.005
    model_share: float = 0.02
    link_rad: float = 0.2
    prior_closings: float = 1.0
    drift_margin: float = 2.0
    alike_excess: float = 9.0
    alike_share: float = 0.2
    alike_spacing_m: float = 3.0
    alike_odds: float = 10.0
    reach_m: float = 8.0

    def __post_init__(self) -> None:
        if min(self.prior_loops, self.prior_closings) <= 0:
            raise ValueError("prior_loops and prior_closings must be positive")


@dataclass(frozen=True)
class Cycles:
    """Cycles that pairs of N loops close over the map.

    Attributes:
        first, second: (P,) rows of the loops.
        paths: (2, P, 2) radians and metres of the map's path between their older and between their
            newer ends.
        T_a_b, covariances: (N, 4, 4), (N, 6, 6) of the loops.
        ends: T_world_a and T_world_b (N, 4, 4), as in the map.
        separate: (P,) whether the loops have no keyframe in common.
    """

    first: Ints
    second: Ints
    paths: Array
    T_a_b: Array
    covariances: Array
    ends: tuple[Array, Array]
    separate: Mask

    @classmethod
    def of(cls, loops: list[LoopConstraint], world: WorldMap) -> Cycles:
        """Those of all pairs."""
        first, second = np.triu_indices(len(loops), 1)
        a, b = np.array([loop.ends for loop in loops], np.int64).reshape(-1, 2).T
        poses = np.array([k.T_world_camera for k in world.keyframes.values()])
        ids, travelled = world.travelled()
        rows = np.searchsorted(ids, a), np.searchsorted(ids, b)
        return cls(
            first,
            second,
            np.stack([np.abs(travelled[k[first]] - travelled[k[second]]) for k in rows]),
            np.array([loop.T_a_b for loop in loops]).reshape(-1, 4, 4),
            np.array([loop.covariance for loop in loops]).reshape(-1, 6, 6),
            (poses[rows[0]], poses[rows[1]]),
            (a[first] != a[second]) & (b[first] != b[second]),
        )

    def chi2(self, ratio: float, map_covariances: Array) -> Array:
        """Chi-square (P,) with 6 degrees of freedom, covariances of loops times ``ratio``."""
        pairs, covariances = (self.first, self.second), ratio * self.covariances
        return cycle_chi2(self.T_a_b, covariances, self.ends, pairs, map_covariances)


class LoopNoise:
    """The real covariance of loops, learned from cycles of loops that agree.

    Short cycles hardly contain errors of the map, so their mean chi-square over its expectation is
    the ratio of the loops' real covariance to the stated one. That it is one number was measured:
    it depends neither on the loops' motion nor on their inliers (docs/graph.md).
    """

    def __init__(self, config: NoiseConfig):
        self.config = config
        self._sum, self._loops = 0.0, 0.0

    @property
    def ratio(self) -> float:
        """Real covariance of a loop over that of independent inliers."""
        prior, weight = self.config.prior_ratio, self.config.prior_loops
        return (weight * prior + self._sum) / (weight + self._loops)

    def state(self) -> Arrays:
        """What was learned."""
        return {"learned": np.array([self._sum, self._loops])}

    def restore(self, state: Arrays) -> None:
        """Go on from a state."""
        self._sum, self._loops = state["learned"].tolist()

    def learn(self, loops: list[LoopConstraint], world: WorldMap) -> None:
        """Learn from loops that agree; N of them that can be compared count as N - 1."""
        cycles = Cycles.of(loops, world)
        usable = cycles.separate & (cycles.paths[..., 1] < self.config.near_m).all(axis=0)
        if not usable.any():
            return
        exact_map = np.zeros((2, len(usable), DIMENSIONS, DIMENSIONS))
        compared = np.union1d(cycles.first[usable], cycles.second[usable])
        weight = len(compared) - 1
        self._sum += weight * float(cycles.chi2(1.0, exact_map)[usable].mean()) / DIMENSIONS
        self._loops += weight

    def covariance(self, loop: LoopConstraint) -> Array:
        """Covariance (6, 6) of a loop in the graph."""
        return self.ratio * loop.covariance

    def bent(self, T_a_b: Array) -> Array:
        """Covariances (N, 6, 6) of what a bent map adds to relative poses T_a_b (N, 4, 4).

        The graph does not know these errors, and is too sure of the path between two keyframes.
        """
        change = np.linalg.norm(se3_log(T_a_b).reshape(-1, 2, 3), axis=2)
        rules = self.config
        floor = np.array([rules.model_sigma_rad, rules.model_sigma_m])
        return _diagonal(floor + rules.model_share * change)

    def map_covariances(self, paths: Array) -> Array:
        """Covariances (..., 6, 6) of the map's relative pose over paths (..., 2) in rad and metres.

        A rotation error that grows along a path displaces its end by half of it times the length.
        """
        rules, turns_rad, lengths_m = self.config, paths[..., 0], paths[..., 1]
        bent, drift_rad = rules.model_share * turns_rad, rules.drift_rad_per_m * lengths_m
        sigmas_rad = rules.model_sigma_rad + drift_rad + bent
        sigmas_m = rules.model_sigma_m + (rules.drift_m_per_m + drift_rad / 2) * lengths_m + bent
        return _diagonal(np.stack([sigmas_rad, sigmas_m], axis=-1))


def _diagonal(sigmas: Array) -> Array:
    """Covariances (..., 6, 6) of sigmas (..., 2), one for the rotations, one for translations."""
    return np.repeat(sigmas**2, 3, axis=-1)[..., None] * np.eye(DIMENSIONS)
