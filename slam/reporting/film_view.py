"""The view of a film's map: a camera above the room, and what it draws."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from bmask_slam.graph.arrays import Array, Bytes, Image, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, make_pose, transform
from bmask_slam.reporting.film_cloud import FilmCloud
from bmask_slam.semantics.objects.boxes3d import gravity_axes

ELEVATION_DEG, SWING_DEG = 48.0, 14.0
FILLED, FIT_QUANTILE = 0.94, 0.99
FOCAL_SHARE = 1.2
HEAD_ROOM_M = 0.4
"""What is so much higher than the highest camera, as a ceiling, is left out, unless all is."""
FRUSTUM_M, MIN_DISTANCE_M = 0.25, 0.5
SIZES_PX = (2, 4)
BACKGROUND = (250, 250, 248)
NEAR_M = 0.05
Colour = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class MapView:
    """A cloud as it is shown, and the camera that looks at it.

    Attributes:
        cloud: without ceilings.
        towards: (N, 3) unit vectors from the points to the cameras that saw them first.
        camera: of the view.
        R_world_level: (3, 3), axes right, away and up of the view at rest.
        target_world: (3,), the middle of the picture.
        distance_m: of the camera from it.
    """

    cloud: FilmCloud
    towards: Array
    camera: Camera
    R_world_level: Array
    target_world: Array
    distance_m: float

    def pose(self, turn_deg: float) -> Array:
        """T_world_view (4, 4), turned about the vertical through the target."""
        turn, tilt = np.deg2rad(turn_deg), np.deg2rad(ELEVATION_DEG)
        away = np.array([np.sin(turn), np.cos(turn), 0.0])
        forward = self.R_world_level @ (np.cos(tilt) * away - np.sin(tilt) * np.array([0, 0, 1.0]))
        right = self.R_world_level @ np.array([away[1], -away[0], 0.0])
        R_world_view = np.stack([right, np.cross(forward, right), forward], axis=1)
        return make_pose(R_world_view, self.target_world - self.distance_m * forward)


def make_view(
    cloud: FilmCloud, poses_world_camera: Array, up_world: Array, size_px: tuple[int, int]
) -> MapView:
    """A view of the whole cloud from behind and above the cameras (S, 4, 4) of the shots."""
    R_world_level = _level(poses_world_camera, up_world)
    cameras = poses_world_camera[:, :3, 3]
    highest_m = (cameras @ up_world).max() + HEAD_ROOM_M
    kept = cloud.points_world @ up_world < highest_m
    cloud = cloud.select(kept if kept.any() else ~kept)
    towards = cameras[cloud.first] - cloud.points_world
    towards /= np.linalg.norm(towards, axis=1, keepdims=True) + 1e-9
    width, height = size_px
    focal = FOCAL_SHARE * width
    camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    shown = np.concatenate([cloud.points_world, cameras])
    outer = np.quantile(cloud.points_world @ R_world_level, (0.02, 0.98), axis=0)
    outer = np.concatenate([outer, cameras @ R_world_level])
    target = (outer.min(axis=0) + outer.max(axis=0)) / 2
    view = MapView(cloud, towards, camera, R_world_level, R_world_level @ target, 0.0)
    half, distance_m = 0.5 * FILLED * np.array(size_px), MIN_DISTANCE_M
    for turn_deg in (-SWING_DEG, SWING_DEG):
        points = transform(inverse(view.pose(turn_deg)), shown)
        needed_m = (np.abs(points[:, :2]) * focal / half).max(axis=1) - points[:, 2]
        most_m = float(np.quantile(needed_m, FIT_QUANTILE))
        distance_m = max(distance_m, most_m, float(needed_m[-len(cameras) :].max()))
    return replace(view, distance_m=distance_m)


def _level(poses_world_camera: Array, up_world: Array) -> Array:
    """Axes (3, 3) right, away and up in the world; away is where the cameras looked, on average."""
    forward = poses_world_camera[:, :3, 2].mean(axis=0)
    forward -= (forward @ up_world) * up_world
    length = np.linalg.norm(forward)
    away = forward / length if length > 0.1 else gravity_axes(up_world)[:, 0]
    return np.stack([np.cross(away, up_world), away, up_world], axis=1)


class MapPicture:
    """The map at one moment, drawn into an image (H, W, 3), red first."""

    def __init__(self, view: MapView, turn_deg: float, shots: int) -> None:
        """Draw the points that were seen in the first ``shots`` shots."""
        self._T_view_world, self._camera = inverse(view.pose(turn_deg)), view.camera
        self._eye = view.pose(turn_deg)[:3, 3]
        edge_px = math.ceil(view.cloud.spacing_m * view.camera.fx / view.distance_m)
        self._size_px = min(max(edge_px, SIZES_PX[0]), SIZES_PX[1])
        cloud = view.cloud
        shown = cloud.first < shots
        shown &= ((self._eye - cloud.points_world) * view.towards).sum(axis=1) > 0  # no backs
        self.image = self._splat(cloud.points_world[shown], cloud.colours[shown])

    def _splat(self, points_world: Array, colours: Bytes) -> Image:
        """Points as squares without gaps in the middle of the picture, the nearest in front."""
        camera, size_px = self._camera, self._size_px
        image = np.full((camera.height * camera.width, 3), BACKGROUND, np.uint8)
        points = transform(self._T_view_world, points_world)
        pixels = np.floor(camera.project(points)).astype(np.int64)
        size = np.array([camera.width, camera.height]) - size_px
        inside = (points[:, 2] > NEAR_M) & (pixels >= 0).all(axis=1) & (pixels < size).all(axis=1)
        rows = np.flatnonzero(inside)
        rows = rows[np.argsort(-points[rows, 2], kind="stable")]
        at = pixels[rows, 1] * camera.width + pixels[rows, 0]
        square = np.arange(size_px)
        corners = (square[:, None] * camera.width + square).ravel()
        image[(at[:, None] + corners).ravel()] = np.repeat(colours[rows], len(corners), axis=0)
        return image.reshape(camera.height, camera.width, 3)

    def place(self, points_world: Array) -> tuple[Array, Mask]:
        """Pixels (N, 2) of points (N, 3), and which are in front of the view."""
        points = transform(self._T_view_world, points_world)
        ahead = points[:, 2] > NEAR_M
        points[~ahead] = np.nan
        return self._camera.project(points), ahead

    def lines(self, parts_world: Sequence[Array], colour: Colour, width_px: int) -> None:
        """A line through the points (N, 3) of each part, with a light border."""
        placed = [self.place(points) for points in parts_world if len(points)]
        paths = [np.rint(pixels[ahead]).astype(np.int32) for pixels, ahead in placed]
        for stroke, width in (((255, 255, 255), width_px + 2), (colour, width_px)):
            cv2.polylines(self.image, paths, False, stroke, width, cv2.LINE_AA)

    def edges(self, ends_world: Array, colour: Colour) -> None:
        """Straight lines between ends (N, 2, 3)."""
        pixels, ahead = self.place(ends_world.reshape(-1, 3))
        if ahead.all():
            for a, b in np.rint(pixels).astype(int).reshape(-1, 2, 2).tolist():
                cv2.line(self.image, a, b, colour, 1, cv2.LINE_AA)

    def frustum(self, T_world_camera: Array, camera: Camera, colour: Colour) -> None:
        """The field of view of a camera."""
        size = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float) * [camera.width, camera.height]
        corners = transform(T_world_camera, camera.backproject(size, np.full(4, FRUSTUM_M)))
        eye = np.repeat(T_world_camera[None, :3, 3], 4, axis=0)
        rim = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
        self.edges(np.concatenate([np.stack([eye, corners], axis=1), rim]), colour)
