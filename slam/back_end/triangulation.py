"""Landmarks from keypoints without depth, triangulated from two views with parallax."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from bmask_slam.features.matching import MatchConfig, match_brute_force
from bmask_slam.graph.arrays import Array, Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.tracking.pose.pose_optimisation import CHI2_2DOF
from bmask_slam.world.covisibility import MIN_SHARED
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.world_map import WorldMap


@dataclass(frozen=True)
class TriangulationConfig:
    """``neighbours`` covisible keyframes are searched; their rays must cross at some angle."""

    neighbours: int = 3
    min_parallax_deg: float = 1.5
    max_depth_m: float = 20.0
    match: MatchConfig = field(default_factory=lambda: MatchConfig(max_distance=80, ratio=0.8))


def triangulate_landmarks(
    world: WorldMap, keyframe: Keyframe, camera: Camera, config: TriangulationConfig
) -> Ints:
    """Landmarks from keypoints without depth that match in a covisible keyframe; returns ids."""
    _, observed_ids = world.observed(keyframe)
    neighbours = [k for _, k in world.covisible(observed_ids, MIN_SHARED) if k is not keyframe]
    made = [np.zeros(0, np.int64)]
    for neighbour in neighbours[: config.neighbours]:
        rows, neighbour_rows = _free_without_depth(keyframe), _free_without_depth(neighbour)
        a, b = keyframe.features.descriptors[rows], neighbour.features.descriptors[neighbour_rows]
        matches = match_brute_force(a, b, config.match)
        rows, neighbour_rows = rows[matches.query], neighbour_rows[matches.train]
        pixels = (keyframe.features.pixels[rows], neighbour.features.pixels[neighbour_rows])
        sigmas = (
            keyframe.features.sigmas_px[rows, 0],
            neighbour.features.sigmas_px[neighbour_rows, 0],
        )
        poses = (keyframe.T_world_camera, neighbour.T_world_camera)
        points_world, good = triangulate(pixels, sigmas, poses, camera, config)
        ids = world.make_landmarks(keyframe, rows[good], points_world[good])
        world.attach(neighbour, neighbour_rows[good][ids >= 0], ids[ids >= 0])
        made.append(ids[ids >= 0])
    return np.concatenate(made)


def triangulate(
    pixels: tuple[Array, Array],
    sigmas_px: tuple[Array, Array],
    poses_world_camera: tuple[Array, Array],
    camera: Camera,
    config: TriangulationConfig,
) -> tuple[Array, Mask]:
    """Midpoints (N, 3) in metres of the two rays of every match, and which of them are landmarks.

    A match counts if the point lies in front of both cameras and not too far, the rays' angle
    gives parallax, and it projects into both images within the chi-square gate of 95 %.
    """
    rays = []
    for uv, T in zip(pixels, poses_world_camera, strict=True):
        ray = camera.backproject(uv, np.ones(len(uv))) @ T[:3, :3].T
        rays.append(ray / np.linalg.norm(ray, axis=1, keepdims=True))
    origins = [T[:3, 3] for T in poses_world_camera]
    cosine = np.einsum("ij,ij->i", rays[0], rays[1])
    baseline = origins[1] - origins[0]
    # the closest points o0 + s r0 and o1 + t r1 of two lines
    determinant = np.maximum(1 - cosine**2, 1e-12)
    p, q = rays[0] @ baseline, rays[1] @ baseline
    s, t = (p - cosine * q) / determinant, (cosine * p - q) / determinant
    points = (origins[0] + s[:, None] * rays[0] + origins[1] + t[:, None] * rays[1]) / 2
    good = (cosine < np.cos(np.deg2rad(config.min_parallax_deg))) & (s > 0) & (t > 0)
    for uv, sigma, T in zip(pixels, sigmas_px, poses_world_camera, strict=True):
        points_camera = transform(inverse(T), points)
        good &= (points_camera[:, 2] > 0.1) & (points_camera[:, 2] < config.max_depth_m)
        points_camera[:, 2] = np.maximum(points_camera[:, 2], 0.1)
        error = (camera.project(points_camera) - uv) / sigma[:, None]
        good &= np.einsum("ij,ij->i", error, error) < CHI2_2DOF
    return points, good


def _free_without_depth(keyframe: Keyframe) -> Ints:
    return np.flatnonzero(keyframe.free & ~np.isfinite(keyframe.features.depth_m))
