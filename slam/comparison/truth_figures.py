"""What a run on a rendered sequence says of things, against what was drawn."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from graph.camera import Camera
from graph.geometry import Array, inverse, se3_exp, se3_log, transform
from graph.ply import read_ply
from graph.trajectory import Trajectory, associate, nearest_indices, read_tum
from semantics.labels import LabelSet
from semantics.segmenter_table import make_segmenter
from slam.configuration import resolve
from slam.semantic_files import LABELS, read_labels
from slam.sequences import Sequence, open_sequence
from slam.system_config import SystemConfig

MIN_DEPTH_M = 0.1
NEAR_M = (0.02, 0.01)  # at 0 m, and what the square of the depth adds


def truth_figures(run: Path, folder: Path) -> dict[str, float]:
    """Figures by metric; none where the run has no labels or the sequence no truth of them.

    ``label_accuracy``: of the landmarks that lie on an object of a class that the segmenter knows,
    the share with its label. A landmark lies where most keyframes that can see it show it.
    """
    if not (run / LABELS).is_file() or not (folder / "annotations.json").is_file():
        return {}
    config = resolve(SystemConfig, run / "config.yaml")
    names = make_segmenter(config.semantics.segmenter, folder).labels
    sequence = open_sequence(folder)
    if sequence.groundtruth is None:
        return {}
    keyframes, truth = associate(read_tum(run / "keyframes.txt"), sequence.groundtruth)
    if not len(keyframes):
        return {}
    cloud, labels = read_ply(run / "landmarks.ply"), read_labels(run)
    points_world = np.column_stack([cloud[axis] for axis in "xyz"]).astype(float)
    points_truth = transform(truth_from_world(keyframes, truth), points_world)
    classes = true_classes(folder, names)
    counts = np.zeros((len(points_truth), len(names)), int)
    for stamp_s, T_truth_camera in zip(truth.timestamps_s, truth.poses_world_camera, strict=True):
        index = int(nearest_indices(sequence.timestamps_s, np.array([stamp_s]))[0])
        instances, depth_m = _true_images(sequence, index)
        points_camera = transform(inverse(T_truth_camera), points_truth)
        rows, pixels = visible(points_camera, depth_m, sequence.camera)
        counts[rows, classes[instances[pixels[:, 1], pixels[:, 0]]]] += 1
    true = counts.argmax(axis=1)  # the background, 0, for those that no keyframe sees
    found = np.array([names.number(name) for name in labels.labels])
    on_objects = true > 0
    if not on_objects.any():
        return {}
    return {"label_accuracy": float((found[on_objects] == true[on_objects]).mean())}


def truth_from_world(keyframes: Trajectory, truth: Trajectory) -> Array:
    """T_truth_world (4, 4), the mean over poses that belong together."""
    T = truth.poses_world_camera @ inverse(keyframes.poses_world_camera)
    return np.asarray(T[0] @ se3_exp(se3_log(inverse(T[0]) @ T).mean(axis=0)))


def true_classes(folder: Path, names: LabelSet) -> NDArray[np.int64]:
    """The label of each instance number, 0 for background and classes that the set lacks."""
    content = json.loads((folder / "annotations.json").read_text(encoding="utf-8"))
    by_id = {c["id"]: c["name"] for c in content["categories"]}
    classes = np.zeros(np.iinfo(np.uint16).max + 1, np.int64)
    for annotation in content["annotations"]:
        classes[annotation["instance_id"]] = names.number(by_id[annotation["category_id"]])
    return classes


def visible(
    points_camera: Array, depth_m: Array, camera: Camera
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Which points (N, 3) an image shows: their rows (M,), and pixels (M, 2) as (u, v)."""
    ahead = np.flatnonzero(points_camera[:, 2] > MIN_DEPTH_M)
    pixels = np.rint(camera.project(points_camera[ahead])).astype(np.int64)
    inside = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1)
    rows, pixels = ahead[inside], pixels[inside]
    z = points_camera[rows, 2]
    near = np.abs(depth_m[pixels[:, 1], pixels[:, 0]] - z) < NEAR_M[0] + NEAR_M[1] * z**2
    return rows[near], pixels[near]


def _true_images(sequence: Sequence, index: int) -> tuple[NDArray[np.int64], Array]:
    """Instances (H, W) and depth (H, W) in metres, NaN where nothing is; exact if it was kept."""
    name = sequence.pairs.rgb_files[index].name
    exact = sequence.folder / "depth_true" / name
    stored = exact if exact.is_file() else sequence.pairs.depth_files[index]
    depth = cv2.imread(str(stored), cv2.IMREAD_UNCHANGED)
    instances = cv2.imread(str(sequence.folder / "instances" / name), cv2.IMREAD_UNCHANGED)
    depth_m = np.where(depth > 0, depth / sequence.camera.depth_scale, np.nan)
    return instances.astype(np.int64), depth_m
