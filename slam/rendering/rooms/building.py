"""A building of three storeys: 36 rooms along corridors, many of which look alike, and stairs.

Everything is in metres, x along the corridors, z up. A storey looks the same when it is turned by
half a turn about its middle, and so does the walk through it: each storey is walked the other way
than the one below, and the stairs stand at either end. Rooms of one kind, corridors and stairs are
copies; only posters, notices and door plates differ, as in an office building.
"""

from __future__ import annotations

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.rendering.engine.builder import SceneBuilder
from bmask_slam.rendering.engine.lighting import Lighting, bake
from bmask_slam.rendering.engine.meshes import pose
from bmask_slam.rendering.engine.path import CameraPath
from bmask_slam.rendering.rooms import building_parts as parts
from bmask_slam.rendering.rooms.building_parts import (
    BAY_M,
    CORRIDOR_M,
    LENGTH_M,
    ROOM_M,
    ROOMS,
    STOREY_M,
    WALL_M,
)
from bmask_slam.rendering.things.people import Role

STOREYS = 3
_KINDS = ("office", "office", "meeting", "office", "office", "lounge")
_EYE_M, _AHEAD_M = 1.45, 1.7
_SAMPLES_PER_M = 130

LIGHTING = Lighting((), ambient=0.8)
"""Of people, who have no role here; each part of the building is lit by lamps of its own."""
ROLES: tuple[Role, ...] = ()

_ROOM = np.array([
    (1.2, -0.2, 0, 90, 0), (1.22, 0.7, 0, 88, -4), (1.5, 1.4, 0, 66, -8), (2.1, 1.75, 0, 34, -10),
    (2.9, 1.8, 0, 8, -10), (3.7, 2.0, 0, 0, -8), (4.2, 2.5, 0, 24, -10), (4.15, 3.0, 0, 62, -12),
    (3.7, 3.2, 0, 98, -12), (3.1, 3.15, 0, 132, -10), (2.5, 3.05, 0, 166, -8),
    (2.0, 2.7, 0, 200, -8), (1.6, 2.1, 0, 232, -6), (1.3, 1.4, 0, 256, -4), (1.2, 0.7, 0, 268, -2),
    (1.2, -0.2, 0, 270, 0),
])  # fmt: skip
"""Steps through a room, in its frame: x, y, z, heading and tilt of the view in degrees."""
_UP = np.array([
    (0.4, 0.9, 0, -8, -14), (0.95, 0.42, 0, -4, -8), (1.7, 0.3, 0.25, 0, 8), (2.6, 0.3, 0.8, 2, 10),
    (3.5, 0.3, 1.36, 8, 6), (4.3, 0.45, 1.6, 44, -4), (4.62, 1.1, 1.6, 90, -8),
    (4.3, 1.75, 1.6, 136, -4), (3.5, 1.9, 1.85, 172, 8), (2.6, 1.9, 2.4, 178, 10),
    (1.7, 1.9, 2.96, 180, 6), (0.9, 1.75, 3.2, 184, -6), (0.3, 1.35, 3.2, 184, -8),
])  # fmt: skip
"""Steps up one storey in the stairwell's frame, likewise."""


def furnish(b: SceneBuilder) -> None:
    """Build all storeys, with the stairwells at both ends."""
    corridor = _lit(b, parts.corridor, parts.CORRIDOR_LAMPS, 1)
    rooms = {kind: _lit(b, make, parts.ROOM_LAMPS, 2) for kind, make in parts.ROOM_KINDS.items()}
    flight = _lit(b, parts.stairs, parts.STAIR_LAMPS, 3)
    top = _lit(b, parts.top_of_stairs, parts.STAIR_LAMPS, 3)
    ground = _lit(b, parts.ground_of_stairs, parts.STAIR_LAMPS, 3)
    for storey in range(STOREYS):
        with b.at(pose(0, 0, storey * STOREY_M)):
            b.repeat(_decorated(b, corridor, parts.hang_in_corridor, parts.CORRIDOR_LAMPS, storey))
            for number in range(2 * ROOMS):
                kind = rooms[_KINDS[number % ROOMS]]
                with b.at(_T_storey_room(number)):
                    text = 100 * storey + number
                    b.repeat(_decorated(b, kind, parts.hang_in_room, parts.ROOM_LAMPS, text))
            for end in (np.eye(4), _HALF_TURN):
                with b.at(end @ pose(LENGTH_M, 0)):
                    b.repeat(flight if storey < STOREYS - 1 else top)
                    if storey == 0:
                        b.repeat(ground)


def _lit(b: SceneBuilder, make: parts.Maker, lighting: Lighting, seed: int) -> SceneBuilder:
    """A part of the building by itself, with its light."""
    part = SceneBuilder(int(b.rng.integers(2**31)), b.detail)
    make(part)
    part.parts = bake(part.parts, lighting, seed)
    return part


def _decorated(
    b: SceneBuilder, like: SceneBuilder, hang: parts.Decorator, lighting: Lighting, number: int
) -> SceneBuilder:
    """A copy of a lit part with what this one alone has."""

    def make(part: SceneBuilder) -> None:
        part.repeat(like)
        hang(part, number)

    return _lit(b, make, lighting, number)


def _T_storey_room(number: int) -> Array:
    """The pose of a room in its storey: first those on the left of the corridor."""
    side, k = divmod(number, ROOMS)
    left = pose(k * BAY_M + WALL_M / 2, CORRIDOR_M + WALL_M)
    return left if side == 0 else _HALF_TURN @ left


_HALF_TURN = pose(LENGTH_M, CORRIDOR_M, 0, 180)
"""Turns a storey by half a turn about its middle."""


def _by(x: float, y: float = 0.0, z: float = 0.0, heading: float = 0.0) -> Array:
    """What moves steps."""
    return np.array([x, y, z, heading, 0.0])


def _turned(steps: Array) -> Array:
    """Steps after half a turn of the storey about its middle."""
    return steps * [-1, -1, 1, 1, 1] + _by(LENGTH_M, CORRIDOR_M, heading=180)


def _through_storey() -> Array:
    """Steps (N, 5) along a corridor and through its rooms, to x = LENGTH_M."""
    before = np.array([(-0.6, 0, 0, -4, -6), (0.5, 0, 0, 10, -6), (1.0, 0.3, 0, 60, -3)])
    between = np.array([
        (1.4, 0.3, 0, -55, -3), (2.2, 0, 0, -6, -6), (3.3, 0, 0, 4, -6), (4.2, -0.1, 0, -12, -6),
        (4.65, -0.4, 0, -60, -3),
    ])  # fmt: skip
    after = np.array([(5.0, -0.4, 0, 50, -3)])
    wall = CORRIDOR_M / 2 + WALL_M
    left, right = _ROOM + _by(0, wall), _ROOM * [-1, -1, 1, 1, 1] + _by(ROOM_M[0], -wall, 0, 180)
    bay = np.concatenate([before, left, between, right, after])
    bay = bay + _by(WALL_M / 2, CORRIDOR_M / 2)
    bays = np.concatenate([bay + _by(k * BAY_M) for k in range(ROOMS)])
    return np.concatenate([bays[1:], [_by(LENGTH_M - 0.3, CORRIDOR_M / 2)]])


def _back() -> Array:
    """Steps (N, 5) down the stairs and along the lowest corridor, to where the walk began."""
    down = _UP[::-1] + _by(LENGTH_M, heading=180)
    landing = np.array([(0.62, 0.8, 0, 110, -6), (0.62, 1.4, 0, 40, -6)]) + _by(LENGTH_M)
    rows = []
    for storey in range(STOREYS - 2, -1, -1):
        first, last = storey < STOREYS - 2, storey > 0
        rows.append(down[first : len(down) - last] + _by(0, 0, storey * STOREY_M))
        if last:
            rows.append(landing + _by(0, 0, storey * STOREY_M))
    x = np.arange(LENGTH_M - 0.6, 0.6, -1.5)
    y, zero = CORRIDOR_M / 2 + 0.12 * np.sin(x), np.zeros(len(x))
    rows.append(np.stack([x, y, zero, 180 + 12 * np.sin(0.7 * x), zero - 6], axis=1))
    turn = [(0.45, 0, 0, 190, -6), (0.3, -0.1, 0, 240, -6), (0.25, 0, 0, 290, -6)]
    turn += [(0.4, 0.05, 0, 340, -6), (0.9, 0, 0, 2, -6), (1.6, 0, 0, 0, -6)]
    return np.concatenate([*rows, np.array(turn) + _by(0, CORRIDOR_M / 2)])


def _path() -> CameraPath:
    """Through all storeys from the lowest to the highest, and back to the begin."""
    rows = [_by(-0.4, CORRIDOR_M / 2)[None]]
    for storey in range(STOREYS):
        steps = _through_storey()
        if storey < STOREYS - 1:
            steps = np.concatenate([steps, _UP + _by(LENGTH_M)])
        steps = _turned(steps) if storey % 2 else steps
        rows.append(steps + _by(0, 0, storey * STOREY_M))
    x, y, z, heading, tilt = np.concatenate([*rows, _back()]).T
    heading, tilt = np.deg2rad(heading), np.deg2rad(tilt)
    eyes = np.stack([x, y, z + _EYE_M], axis=1)
    ahead = np.stack([np.cos(heading), np.sin(heading), np.tan(tilt)], axis=1)
    length_m = float(np.linalg.norm(np.diff(eyes, axis=0), axis=1).sum())
    samples = round(_SAMPLES_PER_M * length_m)
    return CameraPath(eyes, eyes + _AHEAD_M * ahead, 0.9, 45.0, samples)


PATH = _path()
