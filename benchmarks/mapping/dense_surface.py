"""Clouds against the true surface of a rendered room: distance, F-score, labels."""

from __future__ import annotations

import dataclasses
from typing import Any

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree

from benchmarks.mapping.open3d_tsdf import DepthView, integrated
from bmask_slam.dense.keyframe_input import image_name
from bmask_slam.dense.saved_map import MappedRun
from bmask_slam.graph.arrays import Array, Floats
from bmask_slam.graph.geometry import make_pose, transform
from bmask_slam.mapping.inverse_depth.backprojection import back_project, surface_normals
from bmask_slam.mapping.inverse_depth.dense_mapper import DenseKeyframe
from bmask_slam.mapping.inverse_depth.depth_map import InverseDepthMap
from bmask_slam.mapping.products.submaps import surest_per_voxel
from bmask_slam.semantics.segmenters.segmenter import CocoSegmenter

F_SCORE_M = 0.01
VOXEL_M = 0.01


@dataclasses.dataclass(frozen=True, eq=False)
class Truth:
    """What a keyframe really sees: depth (H, W) and its pose in the estimate's world."""

    depth_m: Floats
    T_world_camera: Array


def aligned(estimated: Array, true: Array) -> Array:
    """T_mine_true (4, 4) that brings true poses (N, 4, 4) nearest to mine, in turn and place.

    By turns first: positions alone leave open the turn about a path that is nearly straight.
    """
    u, _, vt = np.linalg.svd(np.einsum("nij,nkj->ik", estimated[:, :3, :3], true[:, :3, :3]))
    R = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return make_pose(R, (estimated[:, :3, 3] - true[:, :3, 3] @ R.T).mean(axis=0))


def read_truth(run: MappedRun) -> list[Truth]:
    """True depth and poses of the keyframes, aligned to the estimate as a whole."""
    assert run.sequence.groundtruth is not None
    poses = run.sequence.groundtruth.poses_world_camera
    true = np.stack([poses[k.frame_index] for k in run.keyframes])
    estimated = np.stack([k.T_world_camera for k in run.keyframes])
    T_estimated_true = aligned(estimated, true)
    found = []
    for keyframe, T in zip(run.keyframes, true, strict=True):
        name = run.sequence.pairs.depth_files[keyframe.frame_index].name
        stored = cv2.imread(str(run.sequence.folder / "depth_true" / name), cv2.IMREAD_UNCHANGED)
        depth_m = (stored / run.camera.depth_scale).astype(np.float32)
        found.append(Truth(np.where(stored > 0, depth_m, np.nan), T_estimated_true @ T))
    return found


def surface(truths: list[Truth], run: MappedRun, max_depth_m: float = 5.0) -> dict[str, Any]:
    """Points and normals of the true surface that the keyframes see, and their labels."""
    points, normals, labels = [], [], []
    file = run.sequence.folder / "annotations.json"
    segmenter = CocoSegmenter(file) if file.is_file() else None
    for truth, keyframe in zip(truths, run.keyframes, strict=True):
        rho = torch.from_numpy(1 / truth.depth_m)
        true_map = InverseDepthMap(rho, rho)
        grid = back_project(true_map, run.camera)
        normal = surface_normals(true_map, run.camera)
        keep = (torch.isfinite(normal).all(-1) & (rho > 1 / max_depth_m)).numpy()
        image = np.zeros(truth.depth_m.shape, np.uint16)
        if segmenter is not None:
            rgb = np.zeros((*image.shape, 3), np.uint8)
            for instance in reversed(segmenter.segment(rgb, image_name(run, keyframe))):
                image[instance.mask] = instance.label
        labels.append(image[keep])
        points.append(transform(truth.T_world_camera, grid.numpy()[keep].astype(float)))
        normals.append(normal.numpy()[keep] @ truth.T_world_camera[:3, :3].T)
    p, n, label = (np.concatenate(a) for a in (points, normals, labels))
    kept = surest_per_voxel(p.astype(np.float32), np.zeros(len(p), np.float32), VOXEL_M / 2)
    return {"points": p[kept], "normals": n[kept], "labels": label[kept]}


def thinned(points: Array, edge_m: float) -> Array:
    """One of the points (N, 3) in each voxel of this edge."""
    flat = points.astype(np.float32)
    return points[surest_per_voxel(flat, np.zeros(len(flat), np.float32), edge_m)]


def distances_m(points: Array, true: dict[str, Any]) -> Array:
    """Distances (N,) of points (N, 3) to the true surface, along its normal where it is near."""
    distance, index = cKDTree(true["points"]).query(points, workers=1)
    offset = points - true["points"][index]
    along = np.abs(np.einsum("ij,ij->i", offset, true["normals"][index]))
    return np.where(distance < 3 * VOXEL_M, along, distance)


def surface_errors(points: Array, true: dict[str, Any]) -> dict[str, float]:
    """Distance to the true surface along its normal, and the F-score at 1 cm."""
    error = distances_m(points, true)
    precision = float(np.mean(error < F_SCORE_M))
    back, _ = cKDTree(points).query(thinned(true["points"], VOXEL_M), workers=1)
    recall = float(np.mean(back < F_SCORE_M))
    return {
        "points": len(points),
        "mean_distance_mm": 1e3 * float(np.mean(error)),
        "precision": precision,
        "recall": recall,
        "f_score": 2 * precision * recall / max(precision + recall, 1e-9),
    }


def open3d_points(run: MappedRun, keyframes: list[DenseKeyframe]) -> Array:
    """Points (N, 3) of Open3D's TSDF of the sensor's depth."""
    views = [DepthView(k.depth_m, k.rgb, k.T_world_camera) for k in keyframes]
    volume = integrated(views, run.camera, VOXEL_M, 4.0)
    cloud = volume.extract_point_cloud(weight_threshold=1.0)
    return np.asarray(cloud.point.positions.numpy(), float)


def label_errors(cloud: dict[str, Any], true: dict[str, Any]) -> dict[str, float]:
    """Accuracy of the labels of points within 2 cm of the true surface, and the mean IoU."""
    points = np.stack([cloud[c] for c in "xyz"], axis=1).astype(float)
    distance, index = cKDTree(true["points"]).query(points, workers=1)
    near = distance < 0.02
    estimated, real = cloud["label"][near].astype(int), true["labels"][index[near]].astype(int)
    classes = np.unique(real)
    ious = [
        np.sum((estimated == c) & (real == c)) / np.sum((estimated == c) | (real == c))
        for c in classes
    ]
    return {"accuracy": float(np.mean(estimated == real)), "mean_iou": float(np.mean(ious))}
