"""The results of mapping: what became of masks, landmarks with their labels, and objects."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from bmask_slam.graph.arrays import Array, Bytes, Ints
from bmask_slam.semantics.beliefs.label_store import LabelEstimates
from bmask_slam.semantics.beliefs.pixel_assignment import PixelAssignment
from bmask_slam.semantics.beliefs.surface_store import SurfaceEstimates
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.objects.publication import MapObject


@dataclass(frozen=True)
class Attachment:
    """What became of a keyframe's masks.

    Attributes:
        keyframe_id: of the keyframe.
        instances: number of instances.
        landmark_ids: (N,) landmarks that they voted on.
        refused: why they were not used; "" if they were.
    """

    keyframe_id: int
    instances: int = 0
    landmark_ids: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    refused: str = ""


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
    """The objects of a map's largest segment, with labels of ``names``.

    Attributes:
        up_world: (3,) the direction of up. floor_m: the floor's height along it, NaN if unknown.
    """

    names: LabelSet
    objects: list[MapObject]
    up_world: Array
    floor_m: float = float("nan")


@dataclass(frozen=True, eq=False)
class PlacedInstances:
    """The instances of a keyframe in its image and in the map.

    Attributes:
        assignment: the instance of every pixel.
        landmark_ids: (N,) landmarks that surely lie on one.
        instances: (N,) the index of the instance that each lies on.
    """

    assignment: PixelAssignment
    landmark_ids: Ints
    instances: Ints
