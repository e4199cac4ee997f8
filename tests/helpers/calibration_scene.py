"""Exact views of small planes by a camera with distortion, wrong depth and late depth images."""

from __future__ import annotations

import cv2
import numpy as np
from synthetic_room import make_room

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.calibration.model import CalibrationViews
from bmask_slam.graph.calibration.problem import CalibrationProblem
from bmask_slam.graph.camera import Camera, depth_distortion_terms
from bmask_slam.graph.geometry import inverse, make_pose, se3_exp, so3_exp, transform

TRUTH = np.array(
    [
        *(525.0, 520.0, 318.5, 241.5, 0.05, -0.08, 0.001, -0.002, 0.0, 0.97, 0.012, 0.010, 0.0),
        *(0.004, -0.006, 0.010, 0.014, -0.005),
    ]
)
PRIORS = np.array(
    [30.0, 30, 10, 10, 0.2, 0.4, 0.01, 0.01, 0.0, 0.05, 0.05, 0.02, 0.02, *(0.02,) * 5]
)
SIZE = (640, 480)
PLACES = Camera(*SIZE, 525.0, 520.0, 318.5, 241.5).image_places


def project(points: Array, truth: Array) -> Array:
    """Raw pixels (M, 2) of camera points (M, 3) by OpenCV."""
    K = np.array([[truth[0], 0, truth[2]], [0, truth[1], truth[3]], [0, 0, 1.0]])
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, truth[4:9])[0][:, 0]


def rays_of(pixels: Array, truth: Array) -> Array:
    """Rays (M, 3) with z = 1 of raw pixels (M, 2) by OpenCV."""
    K = np.array([[truth[0], 0, truth[2]], [0, truth[1], truth[3]], [0, 0, 1.0]])
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    xy = cv2.undistortPointsIter(
        pixels[:, None].copy(), K, truth[4:9], np.eye(3), np.eye(3), criteria
    )[:, 0]
    return np.column_stack([xy, np.ones(len(xy))])


def inverse_depth_of(pixels: Array, n: Array, d: Array, truth: Array) -> Array:
    """The depth image's 1 / raw (M,) at raw pixels of planes n . p = d, n (M, 3)."""
    z = d / (n * rays_of(pixels, truth)).sum(axis=1)
    z_sensor = 1 / (1 / z + depth_distortion_terms(PLACES(pixels)) @ truth[13:])
    inverse_depth: Array = truth[9] / (z_sensor - truth[10])
    return inverse_depth


def rolled(points: Array, pixels: Array, twists: Array, truth: Array) -> tuple[Array, Array, Array]:
    """Camera points (M, 3) and pixels when their rows are exposed, and T_middle_row (M, 4, 4)."""
    then, T = points, np.tile(np.eye(4), (len(points), 1, 1))
    for _ in range(5):
        later_s = truth[12] * ((pixels[:, 1] + 0.5) / SIZE[1] - 0.5)
        T = se3_exp(later_s[:, None] * twists)
        then = transform(inverse(T), points[:, None])[:, 0]
        pixels = project(then, truth) if truth[12] else pixels
    return then, pixels, T


def make_problem(
    seed: int = 0,
    noise: float = 0.0,
    truth: Array = TRUTH,
    start: Array | None = None,
    keyframes: int = 14,
    points: int = 150,
    *,
    still_from: int | None = None,
) -> tuple[CalibrationProblem, Array, Array]:
    """A problem that starts at ``start`` (18,), and its true poses and points.

    ``noise`` is a factor on sigmas of 0.3 px and 0.002 / m, which the problem states. Poses and
    points start a little beside the truth, the first pose at it. From keyframe ``still_from`` on
    the camera stands still while an image is taken.
    """
    rng = np.random.default_rng(seed)
    room = make_room(keyframes, points)
    roll = so3_exp(rng.uniform(-1, 1, (keyframes, 3)) * [0.1, 0.1, 0.6])
    poses = room.poses_world_camera @ make_pose(roll, np.zeros((keyframes, 3)))
    poses[:, :3, 3] += rng.uniform(-0.5, 0.5, (keyframes, 3))
    velocities = rng.uniform(-1, 1, (keyframes, 6)) * [0.5, 0.5, 0.5, 0.6, 0.6, 0.6]
    velocities[keyframes if still_from is None else still_from :] = 0.0
    k, point_ids = (i.ravel() for i in np.indices((keyframes, points)))
    points_camera = transform(inverse(poses), room.points_world)[k, point_ids]
    pixels = project(points_camera, truth)
    # Planes within 60 degrees of facing the camera.
    normals = rng.normal(0, 1, (points, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    n = np.einsum("mji,mj->mi", poses[k, :3, :3], normals[point_ids])
    facing = np.abs((n * points_camera).sum(axis=1)) > 0.5 * np.linalg.norm(points_camera, axis=1)
    # farther out the distortion folds back
    facing &= np.abs(points_camera[:, :2]).max(axis=1) < 0.7 * points_camera[:, 2]
    inside = (
        (pixels > 0).all(axis=1)
        & (pixels < SIZE).all(axis=1)
        & (points_camera[:, 2] > 0.5)
        & facing
    )
    k, point_ids = k[inside], point_ids[inside]
    points_camera, pixels, n = points_camera[inside], pixels[inside], n[inside]
    points_camera, pixels, T_row = rolled(points_camera, pixels, velocities[k], truth)
    n = np.einsum("mji,mj->mi", T_row[:, :3, :3], n)
    pixels = pixels + noise * 0.3 * rng.standard_normal(pixels.shape)

    def inverse_depth_at(time_s: float) -> Array:
        """The depth image at the pixels if it is taken with this delay."""
        T = inverse(se3_exp(velocities * time_s))[k]
        n_then = np.einsum("mij,mj->mi", T[:, :3, :3], n)
        point = np.einsum("mij,mj->mi", T[:, :3, :3], points_camera) + T[:, :3, 3]
        return inverse_depth_of(pixels, n_then, (n_then * point).sum(axis=1), truth)

    share = (pixels[:, 1] + 0.5) / SIZE[1] - 0.5
    point_velocities = -np.cross(velocities[k, :3], points_camera) - velocities[k, 3:]
    w = [inverse_depth_at(truth[11] + dt) for dt in (-1 / 30, 0, 1 / 30)]
    views = CalibrationViews(
        keyframes=k,
        landmarks=point_ids,
        pixels=pixels,
        places=PLACES(pixels),
        inverse_depth=w[1] + noise * 0.002 * rng.standard_normal(len(k)),
        inverse_depth_rate=15 * (w[2] - w[0]),
        lag_s=np.zeros(len(k)),
        sigma_px=np.full(len(k), 0.3),
        sigma_inverse=np.full(len(k), 0.002),
        shutter_velocity=share[:, None] * point_velocities,
    )
    disturbed = poses @ se3_exp(rng.normal(0, [0.002] * 3 + [0.01] * 3, (keyframes, 6)))
    disturbed[0] = poses[0]
    problem = CalibrationProblem(
        views,
        disturbed,
        room.points_world + rng.normal(0, 0.02, room.points_world.shape),
        truth.copy() if start is None else start,
        PRIORS,
        np.full(6, 1e-6),
    )
    return problem, poses, room.points_world
