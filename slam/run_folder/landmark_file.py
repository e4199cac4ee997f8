"""The landmarks of a map as they leave it: as arrays, and as a PLY file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bmask_slam.graph.arrays import Array, Bytes, Ints
from bmask_slam.graph.files.ply import write_ply
from bmask_slam.labelling.results import LandmarkLabels

LANDMARKS_COMMENT = "bmask-slam landmarks, world frame, metres"


@dataclass(frozen=True)
class LandmarkCloud:
    """The living landmarks: ids (N,), points_world (N, 3) m, colours (N, 3), observations (N,).

    ``labels`` says what they are, if there was a segmenter.
    """

    ids: Ints
    points_world: Array
    colours: Bytes
    observations: Ints
    labels: LandmarkLabels | None = None


def write_landmarks(path: Path, cloud: LandmarkCloud) -> None:
    """Landmarks as PLY: position in the world in metres, colour, number of keyframes, id."""
    x, y, z = cloud.points_world.T.astype(np.float32)
    red, green, blue = cloud.colours.T.astype(np.uint8)
    columns = {"x": x, "y": y, "z": z, "red": red, "green": green, "blue": blue}
    columns["observations"] = cloud.observations.astype(np.int32)
    columns["id"] = cloud.ids.astype(np.int32)
    if cloud.labels is not None:
        found = cloud.labels.estimates
        columns["label"] = found.labels.astype(np.int32)
        columns["probability"] = found.probability.astype(np.float32)
        columns["entropy"] = found.entropy.astype(np.float32)
    write_ply(path, columns, LANDMARKS_COMMENT)
