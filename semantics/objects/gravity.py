"""The direction of gravity, from surface normals and the attitude of keyframes."""

from __future__ import annotations

import numpy as np

from bmask_slam.graph.arrays import Array, Arrays, Floats

_SAMPLES = 64
_MAX_STEP = 0.05  # relative to the depth
_UP_CAMERA = np.array([0.0, -1.0, 0.0])


class GravityEstimator:
    """Estimates the up direction from normals, stored in the frames of their keyframes."""

    def __init__(self) -> None:
        self._normals: dict[int, Floats] = {}

    def add(self, keyframe_id: int, depth_m: Floats, rays: Array) -> None:
        """Add normals sampled from a depth image (h, w); ``rays`` (h, w, 3) have z = 1."""
        self._normals[keyframe_id] = sample_normals(depth_m, rays)

    def up_world(self, poses: dict[int, Array]) -> Array:
        """The up direction, a unit vector (3,), given T_world_keyframe by keyframe id."""
        known = [k for k in self._normals if k in poses]
        if not known:
            return _UP_CAMERA
        normals = [self._normals[k] @ poses[k][:3, :3].T for k in known]
        ups = np.array([poses[k][:3, :3] @ _UP_CAMERA for k in known])
        return up_direction(np.concatenate(normals).astype(float), ups)

    def keep(self, keyframe_ids: set[int]) -> None:
        """Drop all other keyframes."""
        self._normals = {k: n for k, n in self._normals.items() if k in keyframe_ids}

    def state(self) -> Arrays:
        """The normals as named arrays."""
        rows = list(self._normals.values())
        return {
            "keyframes": np.array(list(self._normals), np.int64),
            "normals": np.array(rows, np.float32).reshape(-1, _SAMPLES, 3),
        }

    def restore(self, state: Arrays) -> None:
        """Replace the content by a state."""
        self._normals = dict(zip(state["keyframes"].tolist(), state["normals"], strict=True))


def sample_normals(depth_m: Floats, rays: Array) -> Floats:
    """Unit normals (64, 3) toward the camera, spread over the smooth parts of a depth image.

    All zeros if there are fewer than 64. They are cross products of differences over four pixels,
    since depth is noisy.
    """
    points = rays[::2, ::2] * depth_m[::2, ::2, None]
    step = 2
    across = points[:-step, step:] - points[:-step, :-step]
    down = points[step:, :-step] - points[:-step, :-step]
    with np.errstate(invalid="ignore"):
        steps = np.maximum(np.abs(across[..., 2]), np.abs(down[..., 2]))
        smooth = steps < _MAX_STEP * points[:-step, :-step, 2]
    normals = np.cross(down, across)[smooth]  # x right, y down: toward the camera
    found = np.zeros((_SAMPLES, 3), np.float32)
    if len(normals) >= _SAMPLES:
        chosen = normals[np.linspace(0, len(normals) - 1, _SAMPLES).astype(int)]
        found[:] = chosen / np.linalg.norm(chosen, axis=1, keepdims=True)
    return found


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
