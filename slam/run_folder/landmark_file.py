"""landmarks.ply: the landmarks of a map, written, and read back as arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bmask_slam.graph.files.ply import write_ply
from bmask_slam.labelling.results import LandmarkCloud

LANDMARKS = "landmarks.ply"
LANDMARKS_COMMENT = "bmask-slam landmarks, world frame, metres"


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
