"""A simulated building: corridors round a block of rooms, with landmarks on its walls.

The plan is drawn in metres on (x, z); y points down, as in the camera. A landmark is visible if
it is in the image, in range, and not behind a wall.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from bmask_slam.graph.arrays import Array, Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, make_pose, so3_exp, transform

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
BLOCK_M = (21.6, 9.6)
CORRIDOR_M = 2.4
ROOMS = 4
DOOR_M = 1.2
HEIGHT_M = 2.6
EYE_M = 1.5
RANGE_M = (0.5, 6.0)


def walls() -> Array:
    """Wall segments (W, 2, 2): ends, (x, z) in metres; each room has a door to the corridor."""
    width, depth = BLOCK_M
    c, room = CORRIDOR_M, BLOCK_M[0] / ROOMS
    lines = [
        (-c, -c, width + c, -c),
        (width + c, -c, width + c, depth + c),
        (width + c, depth + c, -c, depth + c),
        (-c, depth + c, -c, -c),
        (0, depth, width, depth),
    ]
    lines += [(k * room, 0, k * room, depth) for k in range(ROOMS + 1)]
    for k in range(ROOMS):
        middle = (k + 0.5) * room
        lines += [(k * room, 0, middle - DOOR_M / 2, 0)]
        lines += [(middle + DOOR_M / 2, 0, (k + 1) * room, 0)]
    return np.array(lines, float).reshape(-1, 2, 2)


def landmarks(per_m2: float, rng: np.random.Generator) -> tuple[Array, Ints]:
    """Points (N, 3) spread over all walls, up to 0.25 m before them, and their walls (N,)."""
    ends = walls()
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    which = np.repeat(np.arange(len(ends)), rng.poisson(lengths * HEIGHT_M * per_m2))
    along = rng.random(len(which))[:, None]
    flat = ends[which, 0] * (1 - along) + ends[which, 1] * along
    across = (ends[:, 1] - ends[:, 0])[:, ::-1] / lengths[:, None] * [1, -1]
    flat = flat + across[which] * rng.uniform(-0.25, 0.25, (len(which), 1))
    y = EYE_M - rng.uniform(0, HEIGHT_M, len(which))
    return np.stack([flat[:, 0], y, flat[:, 1]], axis=1), which


def walk(rounds: int, per_round: int, rng: np.random.Generator) -> Array:
    """Poses (K, 4, 4): each round goes along the corridors and once round each room.

    The way differs by a few decimetres and degrees from round to round.
    """
    corners = _way()
    dense = np.concatenate([np.linspace(a, b, 60, endpoint=False) for a, b in pairwise(corners)])
    every_m = np.linalg.norm(np.diff(dense, axis=0, append=dense[:1]), axis=1)
    even = np.linspace(0, every_m.sum(), 4000, endpoint=False)
    at = np.concatenate([[0], np.cumsum(every_m)])
    closed = np.vstack([dense, dense[:1]])
    flat = np.stack([np.interp(even, at, closed[:, i]) for i in range(2)], axis=1)
    kernel = np.hanning(61) / np.hanning(61).sum()
    smooth = np.stack(
        [np.convolve(np.pad(flat[:, i], 30, mode="wrap"), kernel, "valid") for i in range(2)],
        axis=1,
    )
    poses = []
    for _ in range(rounds):
        flat_r = smooth + _wander(len(smooth), 0.15, rng, 2)
        ahead = np.roll(flat_r, -40, axis=0) - flat_r
        yaw = np.unwrap(np.arctan2(ahead[:, 0], ahead[:, 1]))
        step = np.linalg.norm(np.diff(flat_r, axis=0, prepend=flat_r[:1]), axis=1)
        step += 0.8 * np.abs(np.diff(yaw, prepend=yaw[:1]))
        way = np.cumsum(step)
        rows = np.searchsorted(way, np.linspace(0, way[-1], per_round, endpoint=False))
        tilt = _wander(len(smooth), 0.05, rng, 3)
        poses.append(_looking(flat_r[rows], yaw[rows], tilt[rows]))
    return np.concatenate(poses)


def visible(T_world_camera: Array, points: Array, on_wall: Ints) -> tuple[Ints, Array]:
    """Rows (M,) of visible points, and their exact measurements (M, 3)."""
    p = transform(inverse(T_world_camera), points)
    near = np.flatnonzero((p[:, 2] > RANGE_M[0]) & (p[:, 2] < RANGE_M[1]))
    z = CAMERA.project_stereo(p[near])
    inside = (z[:, 0] > 0) & (z[:, 0] < CAMERA.width) & (z[:, 1] > 0) & (z[:, 1] < CAMERA.height)
    rows, z = near[inside], z[inside]
    free = ~_hidden(T_world_camera[[0, 2], 3], points[rows][:, [0, 2]], on_wall[rows])
    return rows[free], z[free]


def _hidden(eye: Array, points: Array, on_wall: Ints) -> Mask:
    """Whether a wall other than the point's own stands between eye (2,) and points (N, 2)."""
    ends = walls()
    a, b = ends[:, 0], ends[:, 1]

    def side(p: Array, q: Array, r: Array) -> Array:
        return (q[..., 0] - p[..., 0]) * (r[..., 1] - p[..., 1]) - (q[..., 1] - p[..., 1]) * (
            r[..., 0] - p[..., 0]
        )

    point = points[:, None]
    crosses = (side(a, b, eye) * side(a, b, point) < 0) & (
        side(eye, point, a) * side(eye, point, b) < 0
    )
    crosses[np.arange(len(points)), on_wall] = False
    return np.asarray(crosses.any(axis=1))


def _way() -> Array:
    """Corners (N, 2) of the closed way."""
    c, room, depth = CORRIDOR_M / 2, BLOCK_M[0] / ROOMS, BLOCK_M[1]
    way = [(-c, -c)]
    for k in range(ROOMS):
        door, left, right = (k + 0.5) * room, k * room + 1.2, (k + 1) * room - 1.2
        way += [(door, -c), (door, 1.2), (left, 1.4), (left, depth - 1.4)]
        way += [(right, depth - 1.4), (right, 1.4), (door, 1.2), (door + 0.01, -c)]
    width = BLOCK_M[0] + c
    return np.array([*way, (width, -c), (width, depth + c), (-c, depth + c), (-c, -c)])


def _wander(count: int, size: float, rng: np.random.Generator, columns: int) -> Array:
    """A smooth random curve (count, columns) of this standard deviation, zero at both ends."""
    phase = 2 * np.pi * np.arange(count)[:, None, None] / count * np.arange(3, 13)[None, :, None]
    waves = np.sin(phase + rng.uniform(0, 2 * np.pi, (1, 10, columns)))
    ends = np.minimum(1.0, 20 * np.minimum(np.arange(count), np.arange(count)[::-1]) / count)
    return size * waves.mean(axis=1) * np.sqrt(20) * ends[:, None]


def _looking(flat: Array, yaw_rad: Array, tilt_rad: Array) -> Array:
    """Poses at (N, 2) at eye height with this heading, tilted by (N, 3) rotation vectors."""
    z = np.stack([np.sin(yaw_rad), 0 * yaw_rad, np.cos(yaw_rad)], axis=1)
    y = np.broadcast_to([0.0, 1.0, 0.0], z.shape)
    R = np.stack([np.cross(y, z), y, z], axis=2)
    position = np.stack([flat[:, 0], np.zeros(len(flat)), flat[:, 1]], axis=1)
    return make_pose(R @ so3_exp(tilt_rad), position)
