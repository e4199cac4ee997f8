"""The truth of real rooms, written by eye, at the places where a run's depth puts it.

A truth is outlines and points in the pictures; their places in the world follow from the depth
images and the reference poses. Structured light bends depth (``Camera.depth_distortion``), and a
run straightens it: at 4 m things move by up to 0.3 m. So places are read again with the depth as
the run sees it: a point at depth z in the frame that it was outlined in moves along its ray to
1 / (1 / z - d), d what the run's camera says of its pixel, less the ``depth_distortion`` that the
truth was written with (none, where the file does not say it).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.paths import ROOT, SHARED
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import NO_DEPTH_DISTORTION, Camera, depth_distortion_terms
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.graph.trajectory import read_tum


def read_truth(name: str, camera: Camera) -> dict[str, Any]:
    """The truth of a recording, its places as the depth of a run with this camera has them."""
    path = ROOT / "tests" / "data" / f"{name}_truth.json"
    truth: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    poses = poses_of_frames(SHARED / name)
    written = truth.get("depth_distortion", NO_DEPTH_DISTORTION)
    bend = np.array(camera.depth_distortion) - np.array(written)
    for point in truth["points"]:
        place, pose = np.array(point[:3]), poses[point[3]]
        point[:3] = moved(place, np.array(point[4:6], float), pose, camera, bend).tolist()
    for thing in truth["objects"]:
        centre = np.array(thing["centre_m"])
        seen = [centre_in(centre, poses[k], camera, bend) for k in thing["frames"]]
        if any(seen):
            thing["centre_m"] = np.mean([again for again in seen if again], axis=0).tolist()
    return truth


def poses_of_frames(folder: Path) -> list[Array]:
    """T_world_camera (4, 4) of each line of rgb.txt, of the nearest stamp of the reference."""
    lines = (folder / "rgb.txt").read_text(encoding="utf-8").split("\n")
    stamps_s = np.array([float(line.split()[0]) for line in lines if line and line[0] != "#"])
    reference = read_tum(folder / "groundtruth.txt")
    nearest = np.abs(stamps_s[:, None] - reference.timestamps_s).argmin(axis=1)
    return list(reference.poses_world_camera[nearest])


def moved(
    point_world: Array, pixel: Array, T_world_camera: Array, camera: Camera, bend: Array
) -> Array:
    """A point (3,) at a pixel (2,) where depth puts it that is straightened by ``bend`` (5,)."""
    local = transform(inverse(T_world_camera), point_world[None])[0]
    added = float(depth_distortion_terms(camera.image_places(pixel)) @ bend)
    return np.asarray(transform(T_world_camera, local[None] / (1 - local[2] * added))[0])


def centre_in(
    centre_world: Array, T_world_camera: Array, camera: Camera, bend: Array
) -> list[float]:
    """An object's centre (3,) as ``moved`` in a frame; nothing where it is not in the image."""
    local = transform(inverse(T_world_camera), centre_world[None])
    if local[0, 2] <= 0:
        return []
    pixel = camera.project_distorted(local)[0]
    if not ((pixel >= 0) & (pixel < [camera.width, camera.height])).all():
        return []
    again: list[float] = moved(centre_world, pixel, T_world_camera, camera, bend).tolist()
    return again
