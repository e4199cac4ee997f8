"""A movable thing in one keyframe, and over time."""

from __future__ import annotations

from dataclasses import dataclass

from bmask_slam.graph.arrays import Array, Floats


@dataclass(frozen=True, eq=False)
class Sighting:
    """A movable thing in a keyframe.

    Attributes:
        centroid_world: (3,) m.
        half_size: (3,) m, along the image's columns, its rows and the depth.
        distribution: (C,) over classes.
        prior: log odds that it moves, by its class; of what stood still for long that of no class.
        evidence: what this keyframe's geometry adds to them.
        still: it stood still for so long that its class does not count.
    """

    centroid_world: Array
    half_size: Array
    distribution: Floats
    prior: float
    evidence: float = 0.0
    still: bool = False

    @property
    def log_odds(self) -> float:
        """That it moves, by this keyframe alone."""
        return self.prior + self.evidence


@dataclass(frozen=True, eq=False)
class Track:
    """A thing that was seen, as of the last time.

    Attributes:
        id: its number.
        time_s: when it was last seen.
        mean: (6,) centroid m and velocity m/s in the world; covariance: (6, 6).
        half_size, distribution, prior: see Sighting, fused over sightings.
        evidence: of all sightings together, limited.
        sightings: how many.
        missed: how many keyframes in a row showed its place, but not it.
        stood: it was watched and found to stand, so that its class does not count.
    """

    id: int
    time_s: float
    mean: Array
    covariance: Array
    half_size: Array
    distribution: Floats
    prior: float
    evidence: float
    sightings: int
    missed: int = 0
    stood: bool = False

    @property
    def moving(self) -> bool:
        """Whether it is more likely moving than not."""
        return self.prior + self.evidence > 0
