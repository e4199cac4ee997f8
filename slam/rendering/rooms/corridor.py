"""A corridor around an inner block: a loop of 30 m that ends where it began, heading the same way.

Every stretch of wall has its own material, doors and things, so that no two places look alike.
"""

from __future__ import annotations

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.rendering.engine.builder import Painter, SceneBuilder
from bmask_slam.rendering.engine.lighting import Lamp, Lighting
from bmask_slam.rendering.engine.meshes import pose, tilt
from bmask_slam.rendering.engine.path import CameraPath
from bmask_slam.rendering.rooms.room import ceiling_lamps
from bmask_slam.rendering.things import furniture as f
from bmask_slam.rendering.things import objects as o
from bmask_slam.rendering.things.paper import notice_board
from bmask_slam.rendering.things.people import Role
from bmask_slam.rendering.things.prints import painting, poster, whiteboard, window
from bmask_slam.rendering.things.surfaces import bricks, carpet, planks, plaster, tiles, wallpaper

_X, _Y, _HEIGHT, _WALK = 10.6, 8.8, 2.5, 2.0
_BEND = 0.75
_Point = tuple[float, float, float]

LIGHTING = Lighting(
    tuple(
        Lamp((x, y, 2.4), 1.5, (0.4, 0.4))
        for x, y in (
            (1.0, 1.0), (3.9, 1.0), (6.7, 1.0), (9.6, 1.0), (9.6, 4.4), (9.6, 7.8),
            (6.7, 7.8), (3.9, 7.8), (1.0, 7.8), (1.0, 4.4),
        )
    ),
    ambient=0.4,
)  # fmt: skip

_ROUND = (
    (9.15, 1.45), (8.1, 1.1), (7.0, 1.45), (3.5, 1.45), (1.45, 1.45), (1.45, 4.4), (1.45, 7.3),
    (3.5, 7.35), (5.2, 7.45), (7.0, 7.35), (9.15, 7.3), (9.15, 4.4),
)  # fmt: skip
ROLES = (
    Role("walk", _ROUND, carries="suitcase", speed_m_s=0.9),
    Role("stand", ((10.1, 5.0),), -80, "cell phone"),
    Role("sit", ((8.6, 8.45),), -12),
    Role("walk", _ROUND, carries="book", speed_m_s=1.0),
    Role("stand", ((0.45, 5.6),), 100, "cup"),
    Role("walk", _ROUND, speed_m_s=0.8),
)
"""People, in the order in which they are added; they walk clockwise, along the block."""


def _ring() -> Array:
    """The middle line (N, 3), closed, corners rounded, counter-clockwise from (5.3, 1)."""
    half_x, half_y = (_X - _WALK) / 2 - _BEND, (_Y - _WALK) / 2 - _BEND
    points = [np.array([0.0, -half_y - _BEND])]
    for quarter, (x, y) in enumerate(((1, -1), (1, 1), (-1, 1), (-1, -1))):
        angle = np.linspace(quarter - 1, quarter, 33) * np.pi / 2
        arc = _BEND * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        points.extend(arc + np.array([x * half_x, y * half_y]))
    flat = np.array([*points, points[0]]) + np.array([_X / 2, _Y / 2])
    return np.c_[flat, np.zeros(len(flat))]


def path(rounds: int = 1) -> CameraPath:
    """``rounds`` rounds and 0.6 m more, weaving a little, with views of the walls."""
    ring = _ring()
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(ring, axis=0), axis=1))]

    def at(distance_m: Array) -> Array:
        wrapped = np.mod(distance_m, along[-1])
        return np.stack([np.interp(wrapped, along, column) for column in ring.T], axis=-1)

    length_m = rounds * along[-1] + 0.6
    s = np.linspace(0, length_m, 1 + round(74 * length_m / (along[-1] + 0.6)))
    turns = 2 * np.pi * s / along[-1]
    eyes = at(s)
    left = np.cross([0, 0, 1.0], at(s + 0.3) - eyes) / 0.3
    eyes = eyes + 0.12 * np.sin(5 * turns)[:, None] * left
    eyes[:, 2] = 1.42 + 0.04 * np.sin(7 * turns)
    targets = at(s + 1.7) + 0.45 * np.sin(6 * turns)[:, None] * left
    targets[:, 2] = 1.22 + 0.1 * np.sin(4 * turns)
    return CameraPath(eyes, targets, speed_m_s=0.5, turn_deg_s=30)


PATH = path()


def furnish(b: SceneBuilder) -> None:
    """Build the ring: outer walls from (0, 0) to (10.6, 8.8), the inner block 2 m inside."""
    w, x1, y1 = _WALK, _X - _WALK, _Y - _WALK
    _floor(b, (0, w, 0), (_X, 0, 0), (0, -w, 0), tiles((168, 160, 146)))
    _floor(b, (x1, y1, 0), (w, 0, 0), (0, -(y1 - w), 0), carpet((126, 60, 58), (196, 170, 120)))
    _floor(b, (0, _Y, 0), (_X, 0, 0), (0, -w, 0), planks((150, 104, 66)))
    _floor(b, (0, y1, 0), (w, 0, 0), (0, -(y1 - w), 0), carpet((70, 92, 110), (180, 176, 140)))
    for origin, right, away in (
        ((0, 0, _HEIGHT), (_X, 0, 0), (0, w, 0)), ((x1, w, _HEIGHT), (w, 0, 0), (0, y1 - w, 0)),
        ((0, y1, _HEIGHT), (_X, 0, 0), (0, w, 0)), ((0, w, _HEIGHT), (w, 0, 0), (0, y1 - w, 0)),
    ):  # fmt: skip
        b.quad(origin, right, away, tiles((206, 206, 200), 0.6, 0.3), 250)
    ceiling_lamps(b, LIGHTING, _HEIGHT)
    _outer(b)
    _inner(b)


def _floor(b: SceneBuilder, origin: _Point, right: _Point, near: _Point, painter: Painter) -> None:
    b.quad(origin, right, near, painter, 400)


def _wall(b: SceneBuilder, length: float, painter: Painter) -> None:
    """A wall along +x from the origin, seen from -y."""
    b.quad((0, 0, _HEIGHT), (length, 0, 0), (0, 0, -_HEIGHT), painter, 400)


def _hang(
    b: SceneBuilder, x: float, size: tuple[float, float], painter: Painter, top: float = 2.05
) -> None:
    """A picture on the wall with its left edge at x."""
    b.quad((x, -0.012, top), (size[0], 0, 0), (0, 0, -size[1]), painter, 650)


def _outer(b: SceneBuilder) -> None:
    with b.at(pose(_X, 0, 0, 180)):
        _wall(b, _X, bricks((158, 96, 70)))
        _south(b)
    with b.at(pose(_X, _Y, 0, -90)):
        _wall(b, _Y, plaster((170, 186, 196)))
        _east(b)
    with b.at(pose(0, _Y)):
        _wall(b, _X, wallpaper((198, 190, 160), (120, 96, 130)))
        _north(b)
    with b.at(pose(0, 0, 0, 90)):
        _wall(b, _Y, plaster((204, 178, 150)))
        _west(b)


def _south(b: SceneBuilder) -> None:
    with b.at(pose(1.6, 0), "door"):
        f.door(b, "101")
    _hang(b, 2.6, (1.2, 0.9), notice_board())
    with b.at(pose(4.4, -0.17), "bookcase"):
        f.bookcase(b, 0.9, 4)
    _hang(b, 5.2, (0.6, 0.85), poster())
    with b.at(pose(6.5, 0), "door"):
        f.door(b, "102", (84, 110, 120))
    with b.at(pose(7.6, -0.3, 0, 8), "chair"):
        f.wooden_chair(b)
    _hang(b, 7.3, (0.7, 0.5), painting(), 1.9)
    with b.at(pose(8.3, -0.28)):
        f.potted_plant(b, 0.95)
    with b.at(pose(9.2, 0, 1.2), "switchbox"):
        o.switchbox(b)


def _east(b: SceneBuilder) -> None:
    b.quad((1.1, -0.012, 2.1), (1.4, 0, 0), (0, 0, -1.1), window(), 600, shines=True)
    with b.at(pose(1.8, -0.3, 0, 5)):
        f.potted_plant(b, 0.7)
    with b.at(pose(3.4, 0), "door"):
        f.door(b, "STAIRS", (150, 60, 50))
    with b.at(pose(4.7, 0, 2.05), "air conditioner"):
        f.air_conditioner(b)
    _hang(b, 4.3, (0.8, 1.1), poster(), 1.85)
    with b.at(pose(5.5, -0.32, 0, -10), "suitcase"):
        o.suitcase(b, (190, 120, 30))
    _hang(b, 6.1, (1.3, 0.85), whiteboard())
    with b.at(pose(7.9, -0.25, 0, 0), "robot"):
        o.robot(b)


def _north(b: SceneBuilder) -> None:
    with b.at(pose(1.5, -0.17), "bookcase"):
        f.bookcase(b, 1.2, 5, f.OAK)
    _hang(b, 2.4, (0.9, 0.65), painting())
    with b.at(pose(4.0, 0), "door"):
        f.door(b, "LIBRARY")
    with b.at(pose(5.3, -0.22)), b.at(pose(0, 0), "desk"):
        b.box((1.2, 0.4, 0.75), plaster((120, 90, 66), 0.6))
    with b.at(pose(5.3, -0.22, 0.75)):
        with b.at(pose(-0.2, 0), "tv"):
            o.tv(b, 0.7)
        with b.at(pose(0.35, -0.05), "bottle"):
            o.bottle(b)
        with b.at(pose(0.48, -0.08, 0, 60), "cup"):
            o.cup(b, (80, 150, 90))
    _hang(b, 6.3, (0.6, 0.9), poster())
    with b.at(pose(7.6, 0), "door"):
        f.door(b, "EXIT", (60, 96, 70))
    with b.at(pose(8.6, -0.3, 0, -12), "chair"):
        f.office_chair(b, (150, 70, 40))
    _hang(b, 8.6, (1.1, 0.8), notice_board())


def _west(b: SceneBuilder) -> None:
    _hang(b, 1.0, (0.7, 1.0), poster())
    with b.at(pose(2.4, 0), "door"):
        f.door(b, "KITCHEN", (190, 170, 130))
    with b.at(pose(3.15, -0.1, 0.01) @ tilt("x", -8), "umbrella"):
        o.umbrella(b, (180, 60, 60))
    b.quad((3.6, -0.012, 2.1), (1.3, 0, 0), (0, 0, -1.1), window(), 600, shines=True)
    with b.at(pose(4.3, -0.3)):
        f.potted_plant(b, 0.8)
    _hang(b, 5.2, (0.9, 0.6), painting())
    with b.at(pose(6.6, -0.17), "bookcase"):
        f.bookcase(b, 0.9, 5)
    with b.at(pose(6.6, -0.17, 1.98), "trophy"):
        o.trophy(b)
    with b.at(pose(7.6, 0, 0.35), "jackboard"):
        o.jackboard(b)


def _inner(b: SceneBuilder) -> None:
    """The block's walls, seen from the corridor."""
    x0, x1, y0, y1 = _WALK, _X - _WALK, _WALK, _Y - _WALK
    with b.at(pose(x0, y0)):
        _wall(b, x1 - x0, plaster((186, 192, 168)))
        _hang(b, 0.5, (1.3, 0.85), whiteboard())
        with b.at(pose(2.7, 0), "door"):
            f.door(b, "LAB 1", (110, 84, 70))
        _hang(b, 3.7, (0.6, 0.8), poster())
        _hang(b, 4.7, (1.1, 0.75), notice_board())
        with b.at(pose(6.1, -0.28, 0, 10), "chair"):
            f.office_chair(b)
    with b.at(pose(x1, y0, 0, 90)):
        _wall(b, y1 - y0, bricks((120, 110, 104)))
        _hang(b, 0.5, (0.8, 0.6), painting())
        with b.at(pose(2.2, 0), "door"):
            f.door(b, "LAB 2", (168, 140, 96))
        _hang(b, 3.3, (1.0, 0.8), notice_board())
    with b.at(pose(x1, y1, 0, 180)):
        _wall(b, x1 - x0, plaster((190, 166, 166)))
        _hang(b, 0.6, (0.65, 0.95), poster())
        with b.at(pose(2.3, 0), "door"):
            f.door(b, "STORE", (96, 110, 140))
        with b.at(pose(3.4, 0, 2.0), "air conditioner"):
            f.air_conditioner(b)
        _hang(b, 3.1, (0.9, 0.65), painting(), 1.8)
        with b.at(pose(5.2, -0.17), "bookcase"):
            f.bookcase(b, 1.0, 4, f.OAK)
    with b.at(pose(x0, y1, 0, -90)):
        _wall(b, y1 - y0, wallpaper((180, 196, 200), (70, 110, 90)))
        _hang(b, 0.5, (1.2, 0.85), notice_board())
        with b.at(pose(2.6, 0), "door"):
            f.door(b, "MEETING", (120, 60, 70))
        _hang(b, 3.6, (0.7, 0.95), poster())
