"""The results of mapping: landmarks with their labels, and objects."""

from __future__ import annotations

from dataclasses import dataclass

from bmask_slam.graph.arrays import Array, Bytes, Ints
from bmask_slam.semantics.beliefs.label_store import LabelEstimates
from bmask_slam.semantics.beliefs.surface_store import SurfaceEstimates
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.objects.object_map import MapObject


@dataclass(frozen=True)
class LandmarkLabels:
    """The labels of landmarks (N,): estimates of ``names``, and of what they lie on.

    ``surfaces`` is None where the segmenter tells instances alone.
    """

    names: LabelSet
    estimates: LabelEstimates
    surfaces: SurfaceEstimates | None = None


@dataclass(frozen=True)
class LandmarkCloud:
    """The landmarks of a map's largest segment, without those that were removed.

    Attributes:
        ids: (N,).
        points_world: (N, 3) in metres.
        colours: (N, 3), red first.
        observations: (N,), number of keyframes that observed each.
        labels: of the same landmarks; None without a segmenter.
    """

    ids: Ints
    points_world: Array
    colours: Bytes
    observations: Ints
    labels: LandmarkLabels | None = None


@dataclass(frozen=True)
class MapObjects:
    """The objects of a map's largest segment, with labels of ``names``; ``up_world`` (3,)."""

    names: LabelSet
    objects: list[MapObject]
    up_world: Array
