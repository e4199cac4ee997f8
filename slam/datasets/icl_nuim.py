"""Conversion of ICL-NUIM's recordings to TUM's layout."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.trajectory import Trajectory, read_tum, write_tum
from bmask_slam.sequences.lists import read_associations

FPS = 30.0
FIRST_POSE = 1
"""Number of the first image's pose: images count from 0, poses from 1."""
FLIP = np.diag([1.0, -1.0, 1.0, 1.0])


def to_tum_layout(folder: Path) -> None:
    """Write rgb.txt, depth.txt and groundtruth.txt in a folder of ICL-NUIM's files.

    Its lists count frames, here 30 a second. Its camera has y upward (fy < 0), so that its world
    is the mirror image of one in which the images' y points down: ``T_world_camera`` becomes
    ``F T F`` with F = diag(1, -1, 1, 1).

    Raises:
        InputError: the lists or the poses are missing or broken.
    """
    poses = sorted(folder.glob("*.gt.freiburg"))
    if len(poses) != 1:
        raise InputError(f"{folder}: {len(poses)} files *.gt.freiburg, expected one")
    images = read_associations(folder / "associations.txt")
    for name, listed in zip(("rgb.txt", "depth.txt"), images, strict=True):
        lines = [
            f"{number / FPS:.6f} {path.relative_to(folder).as_posix()}"
            for number, path in zip(listed.timestamps_s, listed.files, strict=True)
        ]
        (folder / name).write_text("\n".join(lines) + "\n", encoding="utf-8")
    truth = read_tum(poses[0])
    stamps_s = (truth.timestamps_s - FIRST_POSE) / FPS
    mirrored = FLIP @ truth.poses_world_camera @ FLIP
    write_tum(folder / "groundtruth.txt", Trajectory(stamps_s, mirrored))
