"""Reference trajectories: what a file or a sequence folder says of the colour camera.

A folder's groundtruth.txt may hold the poses of another body on the camera, such as markers. Those
of the Bonn RGB-D Dynamic dataset do; for others a groundtruth.yaml beside it tells where they are.
"""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.yaml_file import format_yaml, read_yaml
from bmask_slam.graph.geometry import orthonormalised
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.graph.trajectory_formats import read_trajectory

logger = logging.getLogger(__name__)

TRUTH, TRUTH_BODY = "groundtruth.txt", "groundtruth.yaml"
MARKERS = "groundtruth_markers.txt"
"""What a Bonn sequence's truth is kept as where its groundtruth.txt is converted already."""
MAX_SKEWNESS = 1e-3
"""Of a rotation in a groundtruth.yaml, whose digits are rounded."""
_CURE = "write T_body_camera: [16 numbers, row by row]"


@dataclass(frozen=True, eq=False)
class TruthBody:
    """The body whose poses groundtruth.txt has: T_world_camera = T_world_given T T_body_camera.

    Attributes:
        T_body_camera: (4, 4).
        T_world_given: (4, 4), from the frame of the poses in the file.
    """

    T_body_camera: Array = field(default_factory=lambda: np.eye(4))
    T_world_given: Array = field(default_factory=lambda: np.eye(4))

    def camera_of(self, given: Trajectory) -> Trajectory:
        """The camera's trajectory where ``given`` is the body's."""
        poses = self.T_world_given @ given.poses_world_camera @ self.T_body_camera
        return Trajectory(given.timestamps_s, poses)

    def yaml(self) -> str:
        """The text of a groundtruth.yaml."""
        return format_yaml({name: T.ravel().tolist() for name, T in vars(self).items()})


_T_ROS = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
_T_M = np.array(
    [
        [1.0157, 0.1828, -0.2389, 0.0113],
        [0.0009, -0.8431, -0.6413, -0.0098],
        [-0.3009, 0.6147, -0.8085, 0.0111],
        [0, 0, 0, 1],
    ]
)
BONN = TruthBody(_T_ROS @ orthonormalised(_T_M), _T_ROS)
"""Of the Bonn RGB-D Dynamic dataset (Palazzolo et al., IROS 2019): T_ros T T_ros T_m, in the frame
of its laser scan, as in the loader of its own laboratory's PINGS (dataset/dataloaders/bonn.py). T_m
has a scale of 1.059, which is left out, as a pose has none."""
_BONN_FOLDER = re.compile(r"rgbd_bonn_\w+")


def find_truth_body(folder: Path) -> TruthBody | None:
    """Whose poses the groundtruth.txt of a folder has; None: the camera's.

    By its groundtruth.yaml, or else by its name, which is that of the published Bonn sequences.

    Raises:
        InputError: a broken groundtruth.yaml.
    """
    file = folder / TRUTH_BODY
    if file.is_file():
        return _read_truth_body(file)
    published = _BONN_FOLDER.fullmatch(folder.resolve().name.lower())
    return BONN if published and not (folder / MARKERS).is_file() else None


def _read_truth_body(file: Path) -> TruthBody:
    values = read_yaml(file)
    keys = {"T_body_camera", "T_world_given"}
    if not isinstance(values, dict) or not set(values) <= keys or "T_body_camera" not in values:
        raise InputError(f"{file}: the keys are T_body_camera and perhaps T_world_given; {_CURE}")
    return TruthBody(**{name: _pose(file, name, numbers) for name, numbers in values.items()})


def _pose(file: Path, name: str, numbers: object) -> Array:
    """The pose (4, 4) of 16 numbers. Raises InputError."""
    given = numbers if isinstance(numbers, list) else []
    if len(given) != 16 or not all(isinstance(number, int | float) for number in given):
        raise InputError(f"{file}: {name} is not 16 numbers; {_CURE}")
    T = np.array(given, float).reshape(4, 4)
    R = T[:3, :3]
    rigid = np.isfinite(T).all() and np.allclose(T[3], [0, 0, 0, 1])
    if not rigid or np.abs(R @ R.T - np.eye(3)).max() > MAX_SKEWNESS or np.linalg.det(R) < 0:
        raise InputError(f"{file}: {name} is no rotation and translation; {_CURE}")
    return orthonormalised(T)


def read_reference(path: Path, stamps_s: Array | None = None) -> Trajectory:
    """The trajectory in a file, or T_world_camera of a sequence folder's ground truth.

    ``stamps_s`` are the stamps of the lines of a file in the format of KITTI.

    Raises:
        InputError: the file is missing or broken.
    """
    file = reference_file(path)
    trajectory = read_trajectory(file, stamps_s)
    body = find_truth_body(file.parent) if file.name == TRUTH else None
    if body is None:
        return trajectory
    by = TRUTH_BODY if (file.parent / TRUTH_BODY).is_file() else "the folder's name: Bonn's markers"
    logger.info("%s: poses of another body, converted to the camera's by %s", file, by)
    return body.camera_of(trajectory)


def reference_file(path: Path) -> Path:
    """The file itself, or the groundtruth.txt of a folder. Raises InputError."""
    return file_in(path, TRUTH, "a sequence with ground truth or a trajectory file")


def file_in(path: Path, name: str, expected: str) -> Path:
    """The file itself, or the file of this name in a folder. Raises InputError."""
    file = path / name if path.is_dir() else path
    if not file.is_file():
        raise InputError(f"{file}: no such file; give {expected}")
    return file
