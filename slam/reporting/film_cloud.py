"""The cloud of a film: coloured points of a run, each with the frame that saw it first."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from bmask_slam.graph.arrays import Array, Bytes, Floats, Image, Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.files.ply import POINTS, read_ply
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.graph.trajectory import MAX_STAMP_ERROR_S, nearest_indices
from bmask_slam.run_folder.reader import Run

MAX_POINTS = 250_000
STEP_PX, DEPTH_STEP_PX = 6, 4
MAX_DEPTH_M = 5.0
VOXEL_M, DENSE_M = 0.02, 0.01
MIN_HITS = 2
NEAR_M, NEAR_SHARE = 0.03, 0.02
"""A point is seen where depth is within NEAR_M + NEAR_SHARE z of its z."""
THROUGH = 3.0
"""It is seen through where depth is so many times that behind it."""
MARGIN = 0.1
NEVER = np.iinfo(np.int64).max


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame of the film.

    Attributes:
        index: position in the sequence.
        timestamp_s: its stamp.
        image: (h, w, 3) uint8, red first, reduced.
        depth_m: (H / DEPTH_STEP_PX, W / DEPTH_STEP_PX), NaN where missing.
        T_world_camera: (4, 4).
        points_world, colours: (N, 3) of some pixels with depth; empty if there is a dense map.
    """

    index: int
    timestamp_s: float
    image: Image
    depth_m: Floats
    T_world_camera: Array
    points_world: Floats
    colours: Bytes


def keyframe_stamps(run: Run) -> Array:
    """Stamps (K,) of the keyframes that are left; of all that were made if the run was killed."""
    made_s = run.frames.timestamps_s[run.frames.keyframe_ids >= 0]
    is_ended = (run.path / "keyframes.txt").is_file()
    return run.keyframes.timestamps_s if len(made_s) and is_ended else made_s


def path_breaks(run: Run, shots: Sequence[Shot]) -> Ints:
    """Numbers of the shots before which a frame has no pose, so that the path is not known."""
    frames_s, poses_s = run.frames.timestamps_s, run.trajectory.timestamps_s
    near = nearest_indices(poses_s, frames_s)
    unknown_s = np.sort(frames_s[np.abs(poses_s[near] - frames_s) > MAX_STAMP_ERROR_S])
    before = np.searchsorted(unknown_s, [shot.timestamp_s for shot in shots])
    return np.flatnonzero(np.diff(before)) + 1


@dataclass(frozen=True, eq=False)
class FilmCloud:
    """Points of the world.

    Attributes:
        points_world: (N, 3).
        colours: (N, 3), red first.
        first: (N,), the number of the shot that saw it first.
        spacing_m: about the distance between neighbours.
    """

    points_world: Array
    colours: Bytes
    first: Ints
    spacing_m: float

    def select(self, kept: Mask) -> FilmCloud:
        """The points for which a mask (N,) is true."""
        parts = self.points_world[kept], self.colours[kept], self.first[kept]
        return FilmCloud(*parts, self.spacing_m)


def sampled_points(image: Image, depth_m: Floats, camera: Camera) -> tuple[Array, Bytes]:
    """Camera-frame points (N, 3) and colours (N, 3) of every STEP_PX-th pixel with depth."""
    v, u = np.mgrid[0 : camera.height : STEP_PX, 0 : camera.width : STEP_PX].reshape(2, -1)
    z = depth_m[v, u]
    known = np.flatnonzero(z < MAX_DEPTH_M)  # not NaN either
    pixels = camera.undistort(np.stack([u[known], v[known]], axis=1).astype(float))
    smooth = cv2.blur(image, (3, 3))
    return camera.backproject(pixels, z[known].astype(float)), smooth[v[known], u[known]]


def make_cloud(shots: Sequence[Shot], camera: Camera, dense: Path) -> FilmCloud:
    """The points of the dense map, if there is one, else of the shots; without what moves away.

    A point belongs to the film if more shots see it than see through it.
    """
    least = 1 if dense.is_file() else min(MIN_HITS, len(shots))
    points, colours, spacing_m = _dense_points(dense) if dense.is_file() else _own_points(shots)
    hits, through = np.zeros((2, len(points)), np.int64)
    first = np.full(len(points), NEVER)
    for number, shot in enumerate(shots):
        rows, seen, behind = _looked_at(points, shot, camera)
        hits[rows[seen]] += 1
        through[rows[behind]] += 1
        first[rows[seen]] = np.minimum(first[rows[seen]], number)
    return FilmCloud(points, colours, first, spacing_m).select((hits >= least) & (hits > through))


def _dense_points(dense: Path) -> tuple[Array, Bytes, float]:
    """Points (N, 3) and colours (N, 3) of a dense cloud, and how far apart they are."""
    ply = read_ply(dense, POINTS)
    step = max(len(ply["x"]) // MAX_POINTS, 1)
    points = np.stack([ply[name][::step] for name in "xyz"], axis=1).astype(float)
    colours = np.stack([ply[name][::step] for name in ("red", "green", "blue")], axis=1)
    return points, colours, DENSE_M * math.sqrt(step)


def _own_points(shots: Sequence[Shot]) -> tuple[Array, Bytes, float]:
    """One of the shots' points (N, 3) in each cube of VOXEL_M, its colour, and that edge."""
    points = np.concatenate([shot.points_world for shot in shots]).astype(float)
    colours = np.concatenate([shot.colours for shot in shots])
    _, one = np.unique(np.floor(points / VOXEL_M).astype(np.int64), axis=0, return_index=True)
    one = one[:: max(len(one) // MAX_POINTS, 1)]
    return points[one], colours[one], VOXEL_M


def _looked_at(points: Array, shot: Shot, camera: Camera) -> tuple[Ints, Mask, Mask]:
    """Rows (M,) of the points in a shot's image; which of them it sees, and sees through."""
    inside, pixels, z = in_image(points, shot.T_world_camera, camera)
    cells = (pixels / DEPTH_STEP_PX).astype(np.int64)
    depth_m = shot.depth_m[cells[:, 1], cells[:, 0]]
    limit_m = NEAR_M + NEAR_SHARE * z
    return inside, np.abs(depth_m - z) < limit_m, depth_m - z > THROUGH * limit_m


def in_image(
    points_world: Array, T_world_camera: Array, camera: Camera
) -> tuple[Ints, Array, Array]:
    """Rows (M,) of the points (N, 3) in the image as recorded, their pixels (M, 2) and z (M,)."""
    points = transform(inverse(T_world_camera), points_world)
    ahead = np.flatnonzero(points[:, 2] > MARGIN)
    size_px = np.array([camera.width, camera.height])
    pixels = camera.project(points[ahead])
    near = (np.abs(pixels - size_px / 2) < (0.5 + MARGIN) * size_px).all(axis=1)  # as lenses fold
    pixels, ahead = camera.distort(pixels[near]), ahead[near]
    inside = ((pixels >= 0) & (pixels <= size_px - 1)).all(axis=1)
    return ahead[inside], pixels[inside], points[ahead[inside], 2]
