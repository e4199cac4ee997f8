"""What is told of the map's things: the labels of its landmarks, its objects."""

from __future__ import annotations

from dataclasses import dataclass

from bmask_slam.graph.arrays import Array
from bmask_slam.semantics.beliefs.label_store import LabelEstimates
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.objects.object_map import MapObject


@dataclass(frozen=True)
class LandmarkLabels:
    """What landmarks (N,) are: estimates of ``names``."""

    names: LabelSet
    estimates: LabelEstimates


@dataclass(frozen=True)
class MapObjects:
    """The objects of a map's largest segment, with labels of ``names``; ``up_world`` (3,)."""

    names: LabelSet
    objects: list[MapObject]
    up_world: Array
