"""A movable instance in one keyframe, and its track over time."""

from __future__ import annotations

from dataclasses import dataclass

from bmask_slam.graph.arrays import Array, Floats


@dataclass(frozen=True, eq=False)
class Sighting:
    """A movable instance in a keyframe.

    Attributes:
        centroid_world: (3,) m.
        half_size: (3,) m, along the image's columns, its rows and the depth.
        distribution: (C,) over classes.
        prior: log odds of moving by its class; those without a class if ``still``.
        evidence: log odds that the geometry of this keyframe adds.
        still: it stood still for so long that its class no longer counts.
    """

    centroid_world: Array
    half_size: Array
    distribution: Floats
    prior: float
    evidence: float = 0.0
    still: bool = False

    @property
    def log_odds(self) -> float:
        """Log odds of moving, from this keyframe alone."""
        return self.prior + self.evidence


@dataclass(frozen=True, eq=False)
class Track:
    """A movable instance as of its last sighting.

    Attributes:
        id: unique number.
        time_s: time of the last sighting.
        mean: (6,) centroid m and velocity m/s in the world; covariance: (6, 6).
        half_size, distribution, prior: as of a Sighting, fused over sightings.
        evidence: log odds added by all sightings, limited.
        sightings: number of sightings.
        missed: consecutive keyframes that showed its position without a sighting.
        stood: it was verified to stand still, so that its class no longer counts.
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


def load_filters() -> None:
    """Load filterpy before it is needed: it takes most of a second, as it loads scipy.stats."""
    import filterpy.common  # noqa: PLC0415
    import filterpy.kalman  # noqa: F401, PLC0415
