"""Accuracy of labels and dense depth of a run on a rendered sequence."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from bmask_slam.config.configuration import resolve
from bmask_slam.datasets.weights import find_weights
from bmask_slam.dense.folder import DenseFolder
from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.json_file import STRICT, Name, read_json
from bmask_slam.graph.files.ply import POINTS, read_ply
from bmask_slam.graph.geometry import inverse, se3_exp, se3_log, transform
from bmask_slam.graph.trajectory import associate, nearest_indices, read_tum
from bmask_slam.run_folder.frame_file import FRAMES, read_frames
from bmask_slam.run_folder.semantic_files import LABELS, read_labels
from bmask_slam.semantics.instances.image_files import decode_image, reduced_labels
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.segmenters.segmenter_table import make_segmenter
from bmask_slam.sequences.sequence import Sequence, open_sequence
from bmask_slam.system_config import SystemConfig

MAX_INSTANCE = 65_535
MIN_DEPTH_M, OUTLIER_M = 0.1, 0.05
NEAR_M = (0.02, 0.01)  # a + b z^2


class _Category(BaseModel):
    model_config = STRICT
    id: int
    name: Name


class _Annotation(BaseModel):
    model_config = STRICT
    instance_id: Annotated[int, Field(ge=0, le=MAX_INSTANCE)]
    category_id: int


class _Truth(BaseModel):
    """What is read of a rendered sequence's annotations."""

    model_config = STRICT
    categories: list[_Category]
    annotations: list[_Annotation]


def truth_figures(run: Path, folder: Path) -> dict[str, float]:
    """Figures by metric; those that the run or the truth allow."""
    sequence = open_sequence(folder)
    found = {"label_accuracy": label_accuracy(run, sequence)}
    found["depth_rmse_ratio"] = depth_ratio(run, sequence)
    return {name: value for name, value in found.items() if value is not None}


def label_accuracy(run: Path, sequence: Sequence) -> float | None:
    """The share of landmarks with the right label, of those on objects of the segmenter's classes.

    A landmark's true class is that of most keyframes in which it is visible.
    """
    folder = sequence.folder
    if not (run / LABELS).is_file() or not (folder / "annotations.json").is_file():
        return None
    config = resolve(SystemConfig, run / "config.yaml")
    names = make_segmenter(config.semantics.segmenter, folder, find_weights).labels
    if sequence.groundtruth is None:
        return None
    keyframes, truth = associate(read_tum(run / "keyframes.txt"), sequence.groundtruth)
    if not len(keyframes):
        return None
    cloud, labels = read_ply(run / "landmarks.ply", POINTS[:3]), read_labels(run)
    if len(labels.ids) != len(cloud["x"]):
        raise InputError(f"{run / LABELS}: not a line for each of landmarks.ply; run again")
    points_world = np.column_stack([cloud[axis] for axis in "xyz"]).astype(float)
    points_truth = transform(
        truth_from_world(keyframes.poses_world_camera, truth.poses_world_camera), points_world
    )
    classes = true_classes(folder, names)
    counts = np.zeros((len(points_truth), len(names)), int)
    indices = nearest_indices(sequence.timestamps_s, truth.timestamps_s)
    for index, T_truth_camera in zip(indices.tolist(), truth.poses_world_camera, strict=True):
        instances = truth_image(sequence, "instances", index).astype(np.int64)
        points_camera = transform(inverse(T_truth_camera), points_truth)
        rows, pixels = visible(points_camera, true_depth(sequence, index), sequence.camera)
        counts[rows, classes[instances[pixels[:, 1], pixels[:, 0]]]] += 1
    true = counts.argmax(axis=1)  # 0, the background, for landmarks visible in no keyframe
    found = np.array([names.number(name) for name in labels.labels])
    on_objects = true > 0
    return float((found[on_objects] == true[on_objects]).mean()) if on_objects.any() else None


def depth_ratio(run: Path, sequence: Sequence) -> float | None:
    """RMSE of the dense map's depth divided by that of the sensor's, at the same pixels.

    Pixels of keyframes count where both depths and the truth are known and both errors are below
    5 cm, so that outliers do not dominate.
    """
    exact, finished = sequence.folder / "depth_true", run / "dense" / "dense.json"
    if not exact.is_dir() or not finished.is_file():
        return None
    dense = DenseFolder.open(run)
    squares = np.zeros(2)
    for index, keyframe in keyframe_frames(run):
        if dense.is_done(keyframe):
            truth = true_depth(sequence, index)
            both = np.stack([dense.fused(keyframe).depth_m(), sequence.load(index).depth_m])
            errors = both - truth
            near = (np.abs(errors) < OUTLIER_M).all(axis=0)  # False where one is NaN
            squares += (errors[:, near].astype(float) ** 2).sum(axis=1)
    return float(np.sqrt(squares[0] / squares[1])) if squares[1] > 0 else None


def keyframe_frames(run: Path) -> list[tuple[int, int]]:
    """(index of the frame, id) of every keyframe that was made."""
    frames = read_frames(run / FRAMES)
    made = frames.keyframe_ids >= 0
    return list(zip(frames.index[made].tolist(), frames.keyframe_ids[made].tolist(), strict=True))


def truth_from_world(poses_world_camera: Array, poses_truth_camera: Array) -> Array:
    """T_truth_world (4, 4), the mean over poses (K, 4, 4) of the same images."""
    T = poses_truth_camera @ inverse(poses_world_camera)
    return np.asarray(T[0] @ se3_exp(se3_log(inverse(T[0]) @ T).mean(axis=0)))


def true_classes(folder: Path, names: LabelSet) -> Ints:
    """The label of each instance number, 0 for background and classes that the set lacks."""
    content = read_json(folder / "annotations.json", _Truth, "render the sequence again")
    by_id = {c.id: c.name for c in content.categories}
    classes = np.zeros(MAX_INSTANCE + 1, np.int64)
    for annotation in content.annotations:
        classes[annotation.instance_id] = names.number(by_id.get(annotation.category_id, ""))
    return classes


def visible(points_camera: Array, depth_m: Array, camera: Camera) -> tuple[Ints, Ints]:
    """Visible points of (N, 3): their rows (M,), and pixels (M, 2) as (u, v)."""
    ahead = np.flatnonzero(points_camera[:, 2] > MIN_DEPTH_M)
    pixels = np.rint(camera.project(points_camera[ahead])).astype(np.int64)
    inside = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1)
    rows, pixels = ahead[inside], pixels[inside]
    z = points_camera[rows, 2]
    near = np.abs(depth_m[pixels[:, 1], pixels[:, 0]] - z) < NEAR_M[0] + NEAR_M[1] * z**2
    return rows[near], pixels[near]


def true_depth(sequence: Sequence, index: int) -> Array:
    """Depth (H, W) in metres, NaN where missing; the sensor's if there is no exact one."""
    kept = (sequence.folder / "depth_true").is_dir()
    depth = truth_image(sequence, "depth_true" if kept else "depth", index)
    return np.where(depth > 0, depth / sequence.camera.depth_scale, np.nan)


def truth_image(sequence: Sequence, kind: str, index: int) -> NDArray[np.uint16]:
    """The image of a frame in the folder ``kind`` of a rendered sequence, reduced as its images."""
    name, k = sequence.pairs.rgb_files[index].name, sequence.camera.reduced_by
    return reduced_labels(decode_image(sequence.folder / kind / name, cv2.IMREAD_UNCHANGED), k)
