"""The direction of gravity, from surface normals and the attitude of keyframes."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterable

import numpy as np

from bmask_slam.graph.arrays import Array, Arrays, Floats, Ints
from bmask_slam.graph.camera import SIDES, direction_of

logger = logging.getLogger(__name__)

_SAMPLES = 64
_MAX_STEP = 0.05  # relative to the depth
_UPWARD = np.deg2rad(12)
_ENOUGH, _LOWEST, _CAMERA_ABOVE_M = 40, 0.03, (0.8, 2.3)


class GravityEstimator:
    """Estimates up and the floor from surface samples, stored in the frames of their keyframes.

    ``side`` is the side of new keyframes' images that is up, of `graph.camera.SIDES`, "" if that is
    not known; each keyframe keeps its own.
    """

    def __init__(self, side: str = "") -> None:
        self.side = side
        self._sides: dict[int, str] = {}
        self._normals: dict[int, Floats] = {}
        self._points: dict[int, Floats] = {}

    def use_side(self, side: str) -> None:
        """A segmenter has found the side of the images that is up; "" if it has not."""
        if side and side != self.side:
            if (self.side or SIDES[0]) != side:
                logger.info("the %s of the images is up; they are turned for the network", side)
            self.side = side
            self._sides = {k: known or side for k, known in self._sides.items()}

    def add(self, keyframe_id: int, depth_m: Floats, rays: Array) -> None:
        """Add samples of a depth image (h, w); ``rays`` (h, w, 3) have z = 1."""
        found = sample_surface(depth_m, rays)
        self._points[keyframe_id], self._normals[keyframe_id] = found
        self._sides[keyframe_id] = self.side

    def up_world(self, poses: dict[int, Array]) -> Array:
        """The up direction, a unit vector (3,), given T_world_keyframe by keyframe id."""
        known = [k for k in self._normals if k in poses]
        if not known:
            return direction_of(self.side)
        normals = [self._normals[k] @ poses[k][:3, :3].T for k in known]
        ups = np.array([poses[k][:3, :3] @ direction_of(self._sides[k]) for k in known])
        return up_direction(np.concatenate(normals).astype(float), ups)

    def floor_m(self, poses: dict[int, Array], up_world: Array) -> float:
        """The floor's height along the up direction (3,), NaN if none was seen.

        It is the lowest surface with an upward normal, if that is where a camera's floor can be:
        the lowest may as well be a table's top.
        """
        known = [k for k in self._points if k in poses]
        heights = [np.zeros(0)]
        for k in known:
            upward = self._normals[k] @ (up_world @ poses[k][:3, :3]) > np.cos(_UPWARD)
            points = self._points[k][upward] @ poses[k][:3, :3].T + poses[k][:3, 3]
            heights.append(points @ up_world)
        heights_m = np.concatenate(heights)
        if len(heights_m) < _ENOUGH:
            return float("nan")
        low_m = float(np.quantile(heights_m, _LOWEST))
        camera_m = float(np.median([poses[k][:3, 3] @ up_world for k in known]))
        near, far = _CAMERA_ABOVE_M
        return low_m if near < camera_m - low_m < far else float("nan")

    def keep(self, keyframe_ids: set[int]) -> None:
        """Drop all other keyframes."""
        self._normals = {k: n for k, n in self._normals.items() if k in keyframe_ids}
        self._points = {k: p for k, p in self._points.items() if k in keyframe_ids}
        self._sides = {k: s for k, s in self._sides.items() if k in keyframe_ids}

    def state(self) -> Arrays:
        """The normals as named arrays."""
        rows, points = list(self._normals.values()), list(self._points.values())
        return {
            "keyframes": np.array(list(self._normals), np.int64),
            "normals": np.array(rows, np.float32).reshape(-1, _SAMPLES, 3),
            "points": np.array(points, np.float32).reshape(-1, _SAMPLES, 3),
            "sides": np.array([("", *SIDES).index(s) for s in self._sides.values()], np.int64),
        }

    def restore(self, state: Arrays) -> None:
        """Replace the content by a state; files of older versions have no points and no sides.

        Raises:
            ValueError: a number of a side that there is not.
        """
        keyframes, normals = state["keyframes"].tolist(), state["normals"]
        points = state.get("points", np.full_like(normals, np.nan))
        self._normals = dict(zip(keyframes, normals, strict=True))
        self._points = dict(zip(keyframes, points, strict=True))
        sides = sides_of(state.get("sides", np.zeros(len(keyframes), np.int64)))
        self._sides = dict(zip(keyframes, sides, strict=True))
        self.side = most_common(sides) or self.side


def sides_of(codes: Ints) -> list[str]:
    """Sides of images by their numbers (N,) in a state: 0 is not known.

    Raises:
        ValueError: there is no such side.
    """
    names = ("", *SIDES)
    if len(codes) and not 0 <= codes.min() <= codes.max() < len(names):
        raise ValueError(f"sides of images are 0 to {len(names) - 1}, found {codes.max()}")
    return [names[code] for code in codes.tolist()]


def most_common(sides: Iterable[str]) -> str:
    """The side that most images have, of those of which it is known; "" for none."""
    counts = Counter(side for side in sides if side)
    return max(counts, key=lambda side: (counts[side], -SIDES.index(side)), default="")


def sample_surface(depth_m: Floats, rays: Array) -> tuple[Floats, Floats]:
    """Points (64, 3), spread over the smooth parts of a depth image, and their unit normals.

    In the camera's frame, normals toward the camera; all zeros if there are fewer than 64. Normals
    are cross products of differences over four pixels, since depth is noisy.
    """
    points = rays[::2, ::2] * depth_m[::2, ::2, None]
    step = 2
    across = points[:-step, step:] - points[:-step, :-step]
    down = points[step:, :-step] - points[:-step, :-step]
    with np.errstate(invalid="ignore"):
        steps = np.maximum(np.abs(across[..., 2]), np.abs(down[..., 2]))
        smooth = steps < _MAX_STEP * points[:-step, :-step, 2]
    normals = np.cross(down, across)[smooth]  # x right, y down: toward the camera
    places, found = np.zeros((2, _SAMPLES, 3), np.float32)
    if len(normals) >= _SAMPLES:
        rows = np.linspace(0, len(normals) - 1, _SAMPLES).astype(int)
        places[:] = points[:-step, :-step][smooth][rows]
        found[:] = normals[rows] / np.linalg.norm(normals[rows], axis=1, keepdims=True)
    return places, found


def up_direction(normals_world: Array, camera_ups_world: Array, cone_deg: float = 40.0) -> Array:
    """The up direction in the world, a unit vector (3,).

    It starts at the mean of the cameras' up axes (K, 3), which are roughly vertical, and is refined
    by floors and tables, whose normals are among ``normals_world`` (N, 3): the median of the
    normals in a cone around the last estimate, while the cone narrows to 5 degrees.
    """
    up = camera_ups_world.sum(axis=0)
    up = up / max(np.linalg.norm(up), 1e-12)
    angle_deg = cone_deg
    while angle_deg > 5.0:
        near = normals_world[normals_world @ up > np.cos(np.deg2rad(angle_deg))]
        if len(near) < 10:
            return up
        middle = np.median(near, axis=0)
        up = middle / np.linalg.norm(middle)
        angle_deg *= 0.7
    return up
