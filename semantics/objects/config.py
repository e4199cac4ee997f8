"""Settings of objects: how they are made, fitted and reported."""

from __future__ import annotations

from dataclasses import dataclass, field

from bmask_slam.semantics.objects.association import AssociationConfig
from bmask_slam.semantics.objects.detections import DetectionConfig
from bmask_slam.semantics.objects.revision import RevisionConfig


@dataclass(frozen=True)
class BoxConfig:
    """How a box is fitted.

    To the points with ``neighbours`` others within ``support_m`` that hang together over cells of
    ``cell_m``, without parts of fewer points than the share ``part`` of the largest; each side is
    moved in by one sigma of the depth, but leaves at most the share ``trim`` of the points outside.
    Of the views that show a point and have a mask on the object, the share ``covered`` must have it
    on the point: what masks show beside an object differs from view to view.
    """

    neighbours: int = 2
    support_m: float = 0.03
    trim: float = 0.02
    cell_m: float = 0.12
    part: float = 0.35
    covered: float = 0.5


@dataclass(frozen=True)
class PublicationConfig:
    """When an object is reported.

    It must have been seen from enough places: the sum of its views' mask scores, in which further
    ones from one viewpoint hardly count, must be ``min_evidence``; it must be of a class with the
    probability ``min_probability``, of one that masks named (how often a network takes one thing
    for another is known from a few photographs each: enough to doubt a name, not to give one), and
    of one that stands still in rooms. Without a measured model
    of the masks' errors neither evidence nor probability are asked for.

    The longest side of a thing of a class has a log-normal tail beyond its usual range: a standard
    deviation ``large_sigma`` of the logarithm above, and ``small_sigma`` below, since things are
    often seen in part. Heights above the floor have the standard deviation ``height_sigma_m``
    beyond where things of the class are. Each counts ``most`` at most.
    """

    min_evidence: float = 1.2
    min_probability: float = 0.5
    large_sigma: float = 0.15
    small_sigma: float = 0.4
    height_sigma_m: float = 0.15
    most: float = 6.0


@dataclass(frozen=True)
class ObjectConfig:
    """How objects are made of detections.

    Objects observed by fewer than ``min_keyframes`` are not reported; each keeps at most
    ``max_points`` points. Its box is fitted to the points with ``neighbours`` others within
    ``support_m``; each side is moved in by one sigma of the depth, but leaves at most the share
    ``trim`` of the points outside. An object is missed by a keyframe that shows the share
    ``shown`` of its points and has no detection on the share ``on`` of those.
    """

    enabled: bool = True
    min_keyframes: int = 2
    max_points: int = 2000
    neighbours: int = 2
    support_m: float = 0.03
    trim: float = 0.02
    shown: float = 0.5
    on: float = 0.1
    publication: PublicationConfig = field(default_factory=PublicationConfig)
    detections: DetectionConfig = field(default_factory=DetectionConfig)
    association: AssociationConfig = field(default_factory=AssociationConfig)
    revision: RevisionConfig = field(default_factory=RevisionConfig)

    @property
    def box(self) -> BoxConfig:
        """How boxes are fitted."""
        return BoxConfig(self.neighbours, self.support_m, self.trim)
