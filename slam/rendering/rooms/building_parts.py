"""The parts that a building is made of: corridor, rooms and stairs, each in a frame of its own."""

from __future__ import annotations

from collections.abc import Callable

from bmask_slam.rendering.engine.builder import Painter, SceneBuilder
from bmask_slam.rendering.engine.lighting import Lamp, Lighting
from bmask_slam.rendering.engine.meshes import pose
from bmask_slam.rendering.rooms.office import workplace
from bmask_slam.rendering.rooms.room import ceiling_lamps
from bmask_slam.rendering.things import furniture as f
from bmask_slam.rendering.things import objects as o
from bmask_slam.rendering.things.paper import notice_board
from bmask_slam.rendering.things.prints import painting, poster, rug, sign, whiteboard, window
from bmask_slam.rendering.things.surfaces import (
    bricks,
    carpet,
    planks,
    plaster,
    tiles,
    wallpaper,
    wood,
)

ROOMS = 6
"""Rooms on either side of a corridor."""
ROOM_M, HEIGHT_M = (6.0, 5.0), 2.7
WALL_M, CORRIDOR_M, STOREY_M = 0.15, 2.2, 3.2
BAY_M = ROOM_M[0] + WALL_M
LENGTH_M = ROOMS * BAY_M
DOOR_M = (0.7, 1.7)
"""Begin and end of a room's doorway along its south wall, from the west."""
_LINTEL_M = 2.1
_PX = 300
_CEILING = tiles((206, 206, 200), 0.6, 0.3)

Maker = Callable[[SceneBuilder], None]
Decorator = Callable[[SceneBuilder, int], None]
"""Adds what only the part with this number has."""

CORRIDOR_LAMPS = Lighting(
    tuple(Lamp((x, CORRIDOR_M / 2, 2.6), 1.3, (0.6, 0.15)) for x in (1.5, *range(5, 37, 4))),
    ambient=0.42,
)  # fmt: skip
ROOM_LAMPS = Lighting(tuple(Lamp((x, y, 2.6)) for x in (1.5, 4.5) for y in (1.4, 3.6)), 0.42)
STAIR_LAMPS = Lighting((Lamp((2.6, 1.1, 3.1), 2.0), Lamp((0.5, 1.1, 2.9), 1.2)), 0.5)


def wall(
    b: SceneBuilder, length: float, painter: Painter, doorways: tuple[tuple[float, float], ...] = ()
) -> None:
    """A wall along +x from the origin, seen from -y, with doorways to the height of a door."""
    begin = 0.0
    for left, right in (*doorways, (length, length)):
        b.quad((begin, 0, HEIGHT_M), (left - begin, 0, 0), (0, 0, -HEIGHT_M), painter, _PX)
        if right > left:
            above = HEIGHT_M - _LINTEL_M
            b.quad((left, 0, HEIGHT_M), (right - left, 0, 0), (0, 0, -above), painter, _PX)
        begin = right


def corridor(b: SceneBuilder) -> None:
    """Floor, ceiling and walls of a corridor along +x, and the reveals of its doorways."""
    length, width, h = LENGTH_M, CORRIDOR_M, HEIGHT_M
    b.quad((0, width, 0), (length, 0, 0), (0, -width, 0), tiles((164, 158, 146)), _PX)
    b.quad((0, 0, h), (length, 0, 0), (0, width, 0), _CEILING, 150)
    ceiling_lamps(b, CORRIDOR_LAMPS, h)
    doorways = tuple(
        (k * BAY_M + WALL_M / 2 + DOOR_M[0], k * BAY_M + WALL_M / 2 + DOOR_M[1])
        for k in range(ROOMS)
    )
    for side, colour in (
        (pose(0, width), (186, 192, 168)),
        (pose(length, 0, 0, 180), (196, 178, 158)),
    ):
        with b.at(side):
            wall(b, length, plaster(colour), doorways)
            for left, right in doorways:
                _reveal(b, left, right)


def _reveal(b: SceneBuilder, left: float, right: float) -> None:
    """The inside of a doorway through a wall that begins at y = 0 and is WALL_M thick."""
    w, high, frame = WALL_M, _LINTEL_M, wood((206, 200, 188), 0.4)
    b.quad((left, 0, high), (0, w, 0), (0, 0, -high), frame, 500)
    b.quad((right, w, high), (0, -w, 0), (0, 0, -high), frame, 500)
    b.quad((left, 0, high), (right - left, 0, 0), (0, w, 0), frame, 500)
    b.quad((left, w, 0), (right - left, 0, 0), (0, -w, 0), wood(f.OAK), 500)


def _room_shell(b: SceneBuilder, floor: Painter, walls: tuple[Painter, Painter]) -> None:
    """A room whose doorway is in the south, with its open door before the south wall."""
    (w, d), h = ROOM_M, HEIGHT_M
    b.quad((0, d, 0), (w, 0, 0), (0, -d, 0), floor, _PX)
    b.quad((0, 0, h), (w, 0, 0), (0, d, 0), _CEILING, 150)
    ceiling_lamps(b, ROOM_LAMPS, h)
    with b.at(pose(0, d)):
        wall(b, w, walls[0])
    with b.at(pose(w, d, 0, -90)):
        wall(b, d, walls[1])
    with b.at(pose(0, 0, 0, 90)):
        wall(b, d, walls[1])
    with b.at(pose(w, 0, 0, 180)):
        wall(b, w, walls[0], ((w - DOOR_M[1], w - DOOR_M[0]),))
    with b.at(pose(DOOR_M[1] + 0.5, 0, 0, 180), "door"):
        f.door(b, "", (150, 104, 66))


def office(b: SceneBuilder) -> None:
    """Two desks at the window, a third in the east, shelves in the west."""
    _room_shell(
        b,
        carpet((96, 104, 116), (170, 150, 120)),
        (plaster((196, 190, 172)), plaster((164, 178, 186))),
    )
    for x, screens in ((1.5, 2), (3.5, 1)):
        with b.at(pose(x, ROOM_M[1] - 0.42)):
            workplace(b, screens, 190)
    with b.at(pose(ROOM_M[0] - 0.42, 2.2, 0, -90)):
        workplace(b, 1, 150)
    with b.at(pose(0.2, 3.0, 0, 90), "bookcase"):
        f.bookcase(b, 1.2)
    with b.at(pose(5.4, ROOM_M[1] - 0.45)):
        f.potted_plant(b, 0.95)
    b.quad((1.0, ROOM_M[1] - 0.01, 2.3), (1.6, 0, 0), (0, 0, -0.95), window(), 600, shines=True)
    b.quad((5.2, 0.01, 2.0), (-1.9, 0, 0), (0, 0, -1.1), whiteboard(), 650)


def meeting(b: SceneBuilder) -> None:
    """A long table on the window side with chairs, a screen and a whiteboard."""
    _room_shell(
        b, carpet((120, 60, 58), (190, 164, 120)), (plaster((190, 190, 196)), bricks((158, 96, 70)))
    )
    with b.at(pose(3.0, ROOM_M[1] - 0.75)), b.at(pose(0, 0), "desk"):
        f.table(b, 3.2, 0.9, 0.74, f.WALNUT)
    for x, yaw in ((1.8, 190), (3.0, 176), (4.2, 184)):
        with b.at(pose(x, ROOM_M[1] - 1.35, 0, yaw), "chair"):
            f.office_chair(b, (60, 66, 74))
    with b.at(pose(ROOM_M[0] - 0.1, 2.4, 1.0, -90), "tv"):
        o.tv(b, 1.3)
    with b.at(pose(0.35, 3.4)):
        f.potted_plant(b, 1.1)
    b.quad((0.01, 1.2, 2.1), (0, 1.9, 0), (0, 0, -1.2), whiteboard(), 650)
    b.quad((1.8, ROOM_M[1] - 0.01, 2.3), (1.6, 0, 0), (0, 0, -0.95), window(), 600, shines=True)


def lounge(b: SceneBuilder) -> None:
    """A sofa, a low table on a rug, a bookcase."""
    _room_shell(
        b,
        planks((158, 106, 62)),
        (wallpaper((198, 190, 160), (120, 96, 130)), plaster((204, 178, 150))),
    )
    with b.at(pose(3.2, ROOM_M[1] - 0.5)):
        f.sofa(b, (70, 96, 118), (206, 150, 60))
    b.quad((2.0, 4.3, 0.012), (2.4, 0, 0), (0, -1.0, 0), rug((150, 52, 48), (222, 196, 140)), 500)
    with b.at(pose(0.2, 2.8, 0, 90), "bookcase"):
        f.bookcase(b, 1.1, 5, f.OAK)
    with b.at(pose(ROOM_M[0] - 0.2, 3.0, 0, -90), "bookcase"):
        f.bookcase(b, 1.2, 4)
    with b.at(pose(5.3, 0.5, 0, 20), "suitcase"):
        o.suitcase(b, (40, 80, 130))
    b.quad((2.4, ROOM_M[1] - 0.01, 2.3), (1.5, 0, 0), (0, 0, -0.95), window(), 600, shines=True)


ROOM_KINDS: dict[str, Maker] = {"office": office, "meeting": meeting, "lounge": lounge}


def stairs(b: SceneBuilder) -> None:
    """One storey of a stairwell: two flights with a landing between, entered from x = 0.

    It spans x in [0, 5.2] and y in [-0.4, 2.6] m; the flight up begins on the right.
    """
    _stair_walls(b)
    for k in range(8):
        rise = (k + 1) * STOREY_M / 16
        b.box(
            (0.325, 1.4, rise),
            tiles((150, 146, 140), 0.3),
            (1.4625 + 0.325 * k, 0.3, 0),
            px_per_m=_PX,
        )
        low = STOREY_M / 2 + k * STOREY_M / 16
        step = STOREY_M / 16
        b.box(
            (0.325, 1.4, step),
            tiles((150, 146, 140), 0.3),
            (3.7375 - 0.325 * k, 1.9, low),
            px_per_m=_PX,
        )
    b.box((1.3, 3.0, 0.2), tiles((164, 158, 146)), (4.55, 1.1, STOREY_M / 2 - 0.2), px_per_m=_PX)
    b.box((1.3, 3.0, 0.2), tiles((164, 158, 146)), (0.65, 1.1, -0.2), px_per_m=_PX)


def top_of_stairs(b: SceneBuilder) -> None:
    """The highest storey of a stairwell: its landing, walls and ceiling."""
    _stair_walls(b)
    b.box((1.3, 3.0, 0.2), tiles((164, 158, 146)), (0.65, 1.1, -0.2), px_per_m=_PX)
    b.quad((0, -0.4, STOREY_M), (5.2, 0, 0), (0, 3.0, 0), _CEILING, 150)


def ground_of_stairs(b: SceneBuilder) -> None:
    """The floor beside and below the lowest flight."""
    b.quad((1.3, 2.6, 0), (3.9, 0, 0), (0, -3.0, 0), tiles((164, 158, 146)), _PX)


def _stair_walls(b: SceneBuilder) -> None:
    h, brick = STOREY_M, bricks((150, 120, 104))
    b.quad((0, 2.6, h), (5.2, 0, 0), (0, 0, -h), brick, _PX)
    b.quad((5.2, -0.4, h), (-5.2, 0, 0), (0, 0, -h), brick, _PX)
    b.quad((5.2, 2.6, h), (0, -3.0, 0), (0, 0, -h), plaster((170, 186, 196)), _PX)
    for y, length in ((-0.4, 0.4), (CORRIDOR_M, 0.4)):
        b.quad((0, y, h), (0, length, 0), (0, 0, -h), brick, _PX)
    above = h - HEIGHT_M
    b.quad((0, 0, h), (0, CORRIDOR_M, 0), (0, 0, -above), brick, _PX)
    b.quad((0.9, 2.59, 2.2), (0.9, 0, 0), (0, 0, -0.65), painting(), 600)
    b.quad((5.19, 1.9, 3.05), (0, -1.2, 0), (0, 0, -0.8), notice_board(), 600)


def hang_in_corridor(b: SceneBuilder, storey: int) -> None:
    """Notice boards and posters between the doors and opposite them, and the door plates."""
    for side in (pose(0, CORRIDOR_M), pose(LENGTH_M, 0, 0, 180)):
        with b.at(side):
            for place in (k * BAY_M + along for k in range(ROOMS) for along in (2.3, 4.2)):
                left = place + float(b.rng.uniform(-0.2, 0.4))
                paint, width = ((poster(), 0.6), (notice_board(), 1.2))[int(b.rng.integers(2))]
                b.quad((left, -0.012, 2.0), (width, 0, 0), (0, 0, -0.85), paint, 600)
            for k in range(ROOMS):
                left = k * BAY_M + WALL_M / 2 + DOOR_M[1] + 0.1
                plate = sign(f"{storey}.{k:02d}")
                b.quad((left, -0.012, 1.7), (0.3, 0, 0), (0, 0, -0.12), plate, 700)
    with b.at(pose(float(b.rng.uniform(5, 30)), CORRIDOR_M - 0.25)):
        f.potted_plant(b, 0.9)


def hang_in_room(b: SceneBuilder, number: int) -> None:
    """Pictures on the walls of this room alone, and a thing on its floor."""
    d = ROOM_M[1]
    b.quad(
        (0.01, 0.5 + float(b.rng.uniform(0, 0.4)), 2.2), (0, 0.6, 0), (0, 0, -0.85), poster(), 700
    )
    b.quad((3.6, d - 0.01, 2.2), (0.8, 0, 0), (0, 0, -0.55), painting(), 700)
    b.quad((ROOM_M[0] - 0.01, 4.4, 2.2), (0, -0.7, 0), (0, 0, -0.9), poster(), 700)
    colour = tuple(float(c) for c in b.rng.integers(40, 200, 3))
    with b.at(pose(0.4, 1.9 + float(b.rng.uniform(0, 0.3)), 0, 70), "suitcase"):
        o.suitcase(b, colour)
