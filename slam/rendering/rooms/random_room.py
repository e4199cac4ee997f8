"""Rooms drawn at random: size, surfaces, light, furniture, clutter and camera path from a seed."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import cycle

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.rendering.engine.builder import Painter, SceneBuilder
from bmask_slam.rendering.engine.lighting import Lamp, Lighting
from bmask_slam.rendering.engine.path import CameraPath
from bmask_slam.rendering.rooms.random_furniture import (
    DEVICES,
    SEAT_M,
    add_hanging,
    add_piece,
    dull_colour,
)
from bmask_slam.rendering.rooms.random_layout import Kind, Layout, Piece, Rect, distance_m
from bmask_slam.rendering.rooms.room import Room, ceiling_lamps, shell
from bmask_slam.rendering.things.people import Role
from bmask_slam.rendering.things.surfaces import bricks, carpet, planks, plaster, tiles, wallpaper

_STOPS = 24
_FEWEST_PIECES = 12
_LOADS = ("", "suitcase", "cup", "book", "cell phone", "umbrella")


@dataclass(frozen=True)
class RandomRoom:
    """A random room: its layout, the camera's path, the people and the lamps."""

    layout: Layout
    path: CameraPath
    roles: tuple[Role, ...]
    lighting: Lighting

    def furnish(self, b: SceneBuilder) -> None:
        """Build the room; colours and clutter come from the builder's random numbers."""
        room = self.layout.room
        walls = {side: _wall(b.rng) for side in ("north", "east", "south", "west")}
        shell(b, room, _floor(b.rng), walls)
        ceiling_lamps(b, self.lighting, room.height)
        for piece in self.layout.pieces:
            with b.at(piece.T_world_piece):
                add_piece(b, piece.kind)
        for hanging in self.layout.hangings:
            with b.at(hanging.T_world_hanging):
                add_hanging(b, hanging)


def draw_room(seed: int) -> RandomRoom:
    """The room of a seed, at least 0.5 m of free floor on both sides of the camera's path."""
    rng = np.random.default_rng([seed, 11])
    room = Room(rng.uniform(5.2, 7.2), rng.uniform(5.0, 6.6), rng.uniform(2.45, 2.9))
    eyes = _ring(room, rng)
    layout = Layout(room, _walked(eyes), rng)
    _place_large_furniture(layout)
    rounds = [layout.keep_free(1.4, 0.9)]
    stands = [layout.keep_free(0.7, 0.7) for _ in range(2)]
    _place_small_furniture(layout)
    _place_wall_objects(layout)
    path = CameraPath(eyes, _targets(layout, eyes, rng), speed_m_s=0.42, turn_deg_s=24.0)
    return RandomRoom(layout, path, _roles(layout, rounds, stands), _lighting(room, rng))


# --- camera --------------------------------------------------------------------------------------


def _ring(room: Room, rng: np.random.Generator) -> Array:
    """Eyes (_STOPS + 1, 3) once round the middle of the room, at heights that vary."""
    half = np.clip(np.array([room.width, room.depth]) / 2 - rng.uniform(1.7, 2.4, 2), 0.45, 1.6)
    phase = rng.uniform(0, 2 * np.pi, 3)
    turn = np.linspace(0, 2 * np.pi, _STOPS + 1)
    angle = phase[0] + rng.choice((-1, 1)) * turn
    radius = 1 + 0.1 * np.sin(3 * turn + phase[1])
    centre = np.array([room.width, room.depth]) / 2 + rng.uniform(-0.1, 0.1, 2)
    xy = centre + radius[:, None] * half * np.stack([np.cos(angle), np.sin(angle)], -1)
    height = rng.uniform(1.25, 1.5) + rng.uniform(0.08, 0.2) * np.sin(2 * turn + phase[2])
    return np.c_[xy, height]


def _walked(eyes: Array) -> Array:
    """Points (N, 2) close together on the floor below the camera's path."""
    share = np.linspace(0, len(eyes) - 1, 400)
    return np.stack([np.interp(share, np.arange(len(eyes)), e) for e in eyes[:, :2].T], -1)


def _targets(layout: Layout, eyes: Array, rng: np.random.Generator) -> Array:
    """Points looked at (_STOPS + 1, 3): twice along the walls while the eyes go round once.

    So each wall is seen from near and from across the room.
    """
    room, inset = layout.room, 0.4
    low, high = np.full(2, inset), np.array([room.width, room.depth]) - inset
    corners = np.array([low, (high[0], low[1]), high, (low[0], high[1]), low])
    sides = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    knots = np.r_[0.0, np.cumsum(sides)] / sides.sum()
    share = np.mod(rng.random() + rng.choice((-1, 1)) * np.linspace(0, 2, _STOPS + 1), 1.0)
    xy = np.stack([np.interp(share, knots, column) for column in corners.T], -1)
    height = np.array([_interest(layout, point) for point in xy])
    height[-1] = height[0]
    return np.c_[xy, np.minimum(height, eyes[:, 2] + 0.3)]


def _interest(layout: Layout, point: Array) -> float:
    """The height to look at near a point (2,): that of furniture, or of a device on the wall."""
    rng = layout.rng
    away = [min(distance_m(r, point[None])[0] for r in p.rects_world) for p in layout.pieces]
    nearest = int(np.argmin(away))
    height = layout.pieces[nearest].kind.focus_m if away[nearest] < 0.6 else 1.15
    for hanging in layout.hangings:
        foot = hanging.T_world_hanging[:3, 3]
        near = float(np.hypot(*(foot[:2] - point))) < 0.8
        if near and hanging.name in DEVICES and rng.random() < 0.6:
            height = (height + 2 * float(foot[2])) / 3
    return height + rng.uniform(-0.12, 0.12)


# --- furniture -----------------------------------------------------------------------------------


def _box(width: float, depth: float, gap: float = 0.02) -> Rect:
    return -width / 2, -depth - gap, width / 2, 0.0


def _workplace(rng: np.random.Generator) -> Kind:
    width = rng.uniform(1.3, 1.7)
    chair = (-0.55, -1.5, 0.25, -0.8)
    return Kind("workplace", (_box(width + 0.04, 0.8), chair), 1.3, 0.8, width)


def _bookcase(rng: np.random.Generator) -> Kind:
    width = rng.uniform(0.7, 1.4)
    return Kind("bookcase", (_box(width, 0.34),), 2.45, 1.05, width)


def _sideboard(rng: np.random.Generator) -> Kind:
    width = rng.uniform(0.9, 1.5)
    return Kind("sideboard", (_box(width, 0.45),), 1.2, 0.85, width)


def _dining(rng: np.random.Generator) -> Kind:
    width = rng.uniform(1.1, 1.5)
    top = (-width / 2, -0.4, width / 2, 0.4)
    chairs = ((-0.32, -0.95, 0.32, -0.35), (-0.32, 0.35, 0.32, 0.95))
    return Kind("dining", (top, *chairs), 0.8, 0.75, width)


def _dining_at_wall(rng: np.random.Generator) -> Kind:
    width = rng.uniform(1.1, 1.5)
    return Kind("table", (_box(width, 0.82), (-0.35, -1.4, 0.35, -0.8)), 1.1, 0.75, width)


def _plant(rng: np.random.Generator) -> Kind:
    height = rng.uniform(0.6, 1.3)
    half = 0.42 * height + 0.04
    return Kind("plant", (_box(2 * half, 2 * half),), height + 0.3, 0.6, height)


_DOOR = Kind("door", (_box(1.2, 0.75),), 2.2, 1.05)
_SOFA = Kind("sofa", (_box(2.24, 0.9),), 0.95, 0.6)
_TV = Kind("tv bench", (_box(1.8, 0.48),), 1.25, 0.8)
_WALL_CHAIR = Kind("chair", (_box(0.62, 0.66),), 1.0, 0.5)
_SUITCASE = Kind("suitcase", (_box(0.56, 0.48),), 1.05, 0.5)
_UMBRELLA = Kind("umbrella", (_box(0.3, 0.34),), 1.0, 0.5)
_ROBOT = Kind("robot", (_box(0.56, 0.56),), 0.9, 0.5)
_LAMP = Kind("floor lamp", (_box(0.46, 0.46),), 1.7, 0.9)
_DRONE = Kind("drone", (_box(0.66, 0.66),), 0.3, 0.2)
_FREE_CHAIR = Kind("chair", ((-0.36, -0.7, 0.36, 0.02),), 1.0, 0.5)
_COFFEE = Kind("low table", ((-0.52, -0.32, 0.52, 0.32),), 0.5, 0.45)
_OPEN = Kind("open umbrella", ((-0.52, -0.64, 0.52, 0.24),), 0.9, 0.3)


def _place_large_furniture(layout: Layout) -> None:
    rng = layout.rng
    layout.stand_at_wall(_workplace(rng))
    layout.stand_at_wall(_DOOR)
    layout.stand_at_wall(_workplace(rng))
    if rng.random() < 0.5 and not layout.stand_free(_dining(rng), (0.0, 90.0)):
        layout.stand_at_wall(_dining_at_wall(rng))
    large = [(0.9, _bookcase(rng)), (0.6, _TV), (0.35, _workplace(rng)), (0.35, _SOFA),
             (0.6, _sideboard(rng)), (0.4, _bookcase(rng))]  # fmt: skip
    for chance, kind in large:
        if rng.random() < chance:
            layout.stand_at_wall(kind)


def _place_small_furniture(layout: Layout) -> None:
    rng = layout.rng
    at_wall = [(0.7, _plant(rng)), (0.4, _plant(rng)), (0.6, _SUITCASE), (0.25, _SUITCASE),
               (0.6, _UMBRELLA), (0.3, _UMBRELLA), (0.6, _ROBOT), (0.25, _ROBOT), (0.3, _LAMP),
               (0.4, _DRONE), (0.5, _WALL_CHAIR)]  # fmt: skip
    free = [(0.4, _FREE_CHAIR), (0.3, _COFFEE), (0.3, _OPEN), (0.3, _ROBOT), (0.3, _SUITCASE)]
    for chance, kind in free:
        if rng.random() < chance:
            layout.stand_free(kind)
    for place in rng.permutation(len(at_wall)):
        chance, kind = at_wall[place]
        if len(layout.pieces) < _FEWEST_PIECES or rng.random() < chance:
            layout.stand_at_wall(kind)


def _place_wall_objects(layout: Layout) -> None:
    rng = layout.rng
    devices = [(0.6, "air conditioner", (0.92, 0.3), (2.05, 2.3)),
               (0.6, "switchbox", (0.42, 0.57), (1.15, 1.45)),
               (0.3, "switchbox", (0.42, 0.57), (1.15, 1.45)),
               (0.7, "jackboard", (0.36, 0.1), (0.25, 0.45)),
               (0.5, "jackboard", (0.36, 0.1), (1.0, 1.2))]  # fmt: skip
    for chance, name, size, foot in devices:
        if rng.random() < chance:
            layout.hang(name, size, foot)
    for _ in range(rng.integers(0, 3)):
        layout.hang("window", (rng.uniform(0.9, 1.5), rng.uniform(0.9, 1.2)), (0.95, 1.05))
    for name in ("whiteboard", "notice board"):
        if rng.random() < 0.4:
            layout.hang(name, (rng.uniform(1.1, 1.8), rng.uniform(0.8, 1.0)), (1.1, 1.3))
    for _ in range(rng.integers(5, 10)):
        if rng.random() < 0.5:
            width = rng.uniform(0.5, 0.8)
            layout.hang("poster", (width, width * rng.uniform(1.2, 1.45)), (1.1, 1.5))
        else:
            width = rng.uniform(0.6, 1.0)
            layout.hang("painting", (width, width * rng.uniform(0.6, 0.8)), (1.25, 1.6))


# --- people and light ----------------------------------------------------------------------------


def _roles(
    layout: Layout, rounds: list[Rect | None], stands: list[Rect | None]
) -> tuple[Role, ...]:
    """People: in turn one who walks in a free place, one who stands and one who sits at a desk."""
    rng, loads = layout.rng, cycle(layout.rng.permutation(_LOADS).tolist())
    walk = [Role("walk", _round(r, rng), 0.0, next(loads), 0.6) for r in rounds if r]
    stand = [
        Role("stand", (((r[0] + r[2]) / 2, (r[1] + r[3]) / 2),), rng.uniform(0, 360), next(loads))
        for r in stands if r
    ]  # fmt: skip
    sit = [_seat(piece) for piece in layout.pieces if piece.kind.name == "workplace"]
    longest = max(len(walk), len(stand), len(sit))
    return tuple(group[k] for k in range(longest) for group in (walk, sit, stand) if k < len(group))


def _round(rect: Rect, rng: np.random.Generator) -> tuple[tuple[float, float], ...]:
    """An oval inside a rectangle, a shoulder's width from its sides."""
    centre = np.array([rect[0] + rect[2], rect[1] + rect[3]]) / 2
    half = np.array([rect[2] - rect[0], rect[3] - rect[1]]) / 2 - 0.25
    angle = rng.choice((-1, 1)) * np.linspace(0, 2 * np.pi, 8, endpoint=False)
    points = centre + half * np.stack([np.cos(angle), np.sin(angle)], -1)
    return tuple((float(x), float(y)) for x, y in points)


def _seat(piece: Piece) -> Role:
    T = piece.T_world_piece
    x, y = T[:2, :2] @ SEAT_M + T[:2, 3]
    facing = float(np.rad2deg(np.arctan2(T[1, 0], T[0, 0]))) + 180
    return Role("sit", ((float(x), float(y)),), facing)


def _lighting(room: Room, rng: np.random.Generator) -> Lighting:
    """One to three rows of lamps below the ceiling, brighter the larger the room."""
    columns, rows = int(rng.integers(1, 4)), int(rng.integers(1, 3))
    if columns * rows == 1:
        columns = 2
    power = 0.21 * room.width * room.depth * rng.uniform(0.75, 1.2) / (columns * rows)
    size = (rng.uniform(0.2, 0.6), rng.uniform(0.12, 0.3))
    places = [
        (room.width * (i + 0.5) / columns, room.depth * (j + 0.5) / rows, room.height - 0.1)
        for i in range(columns) for j in range(rows)
    ]  # fmt: skip
    return Lighting(tuple(Lamp(p, power, size) for p in places), rng.uniform(0.36, 0.55))


def _wall(rng: np.random.Generator) -> Painter:
    kind = rng.random()
    if kind < 0.6:
        return plaster(dull_colour(rng, 130, 215))
    if kind < 0.85:
        return wallpaper(dull_colour(rng, 150, 215), dull_colour(rng, 60, 150))
    return bricks(dull_colour(rng, 90, 160))


def _floor(rng: np.random.Generator) -> Painter:
    kind = rng.random()
    if kind < 0.45:
        return planks(dull_colour(rng, 80, 170, warm=True))
    if kind < 0.75:
        return carpet(dull_colour(rng, 70, 150), dull_colour(rng, 120, 190))
    return tiles(dull_colour(rng, 110, 180), float(rng.uniform(0.25, 0.5)))
