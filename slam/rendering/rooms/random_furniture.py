"""Furniture and wall decoration of random rooms, in random colours and with clutter."""

from __future__ import annotations

import colorsys
from collections.abc import Callable

import numpy as np

from bmask_slam.rendering.engine.builder import SceneBuilder
from bmask_slam.rendering.engine.meshes import pose, tilt
from bmask_slam.rendering.rooms.random_layout import Hanging, Kind
from bmask_slam.rendering.things import furniture as f
from bmask_slam.rendering.things import objects as o
from bmask_slam.rendering.things.drawing import random_colour
from bmask_slam.rendering.things.paper import notice_board, sheet
from bmask_slam.rendering.things.prints import painting, poster, whiteboard, window
from bmask_slam.rendering.things.surfaces import Colour, wood

SEAT_M = (-0.15, -1.07)
"""Position (x, y) of a workplace's chair in the workplace's frame."""

DEVICES: dict[str, Callable[[SceneBuilder], None]] = {
    "air conditioner": f.air_conditioner,
    "switchbox": o.switchbox,
    "jackboard": o.jackboard,
}
"""Devices on walls, by the name of their class."""

_WOODS: tuple[Colour, ...] = (f.OAK, f.WALNUT, (206, 196, 180), (142, 104, 70), (88, 66, 52))
_ITEMS = ("cup", "bottle", "cell phone", "book", "books", "trophy", "plant", "drone", "sheet")
_ODDS = np.array([0.18, 0.15, 0.14, 0.15, 0.09, 0.08, 0.06, 0.06, 0.09])
_RADIUS_M = {
    "cup": 0.075, "bottle": 0.05, "cell phone": 0.09, "book": 0.15, "books": 0.17, "trophy": 0.13,
    "plant": 0.17, "drone": 0.31, "sheet": 0.19,
}  # fmt: skip

_Disc = tuple[float, float, float]
"""x, y and radius in metres of a place on a table."""


def dull_colour(rng: np.random.Generator, low: float, high: float, warm: bool = False) -> Colour:
    """A colour of little saturation with its brightest channel in [low, high)."""
    hue = rng.uniform(0.03, 0.1) if warm else rng.random()
    saturation = rng.uniform(0.3, 0.6) if warm else rng.uniform(0.05, 0.35)
    r, g, b = colorsys.hsv_to_rgb(hue, saturation, rng.uniform(low, high))
    return r, g, b


def add_piece(b: SceneBuilder, kind: Kind) -> None:
    """Build a piece of furniture in its frame: back at y = 0, front along -y."""
    _PIECES[kind.name](b, kind.width_m)


def add_hanging(b: SceneBuilder, hanging: Hanging) -> None:
    """Build a thing on a wall in its frame: in the middle of its lower edge, front along -y."""
    if hanging.name in DEVICES:
        with b.at(np.eye(4), hanging.name):
            DEVICES[hanging.name](b)
        return
    prints = {"poster": poster, "painting": painting, "window": window, "whiteboard": whiteboard,
              "notice board": notice_board}  # fmt: skip
    width, height = hanging.size_m
    shines = hanging.name == "window"
    painter = prints[hanging.name]()
    b.quad((-width / 2, -0.01, height), (width, 0, 0), (0, 0, -height), painter, 700, shines)


# --- small things --------------------------------------------------------------------------------


def scatter(b: SceneBuilder, width: float, depth: float, count: int, occupied: list[_Disc]) -> None:
    """Place up to ``count`` items on a table top of this size, outside the ``occupied`` discs."""
    discs = list(occupied)
    for name in b.rng.choice(_ITEMS, count, p=_ODDS):
        radius = _RADIUS_M[name]
        half = np.array([width, depth]) / 2 - radius
        if half.min() <= 0:
            continue
        for _ in range(30):
            x, y = (b.rng.uniform(-1, 1, 2) * half).tolist()
            if all(np.hypot(x - u, y - v) > radius + r for u, v, r in discs):
                discs.append((x, y, radius))
                with b.at(pose(x, y, 0, b.rng.uniform(0, 360))):
                    _item(b, str(name))
                break


def _item(b: SceneBuilder, name: str) -> None:
    """One small thing on z = 0; its front looks along -y."""
    if name == "books":
        for k in range(int(b.rng.integers(2, 4))):
            with b.at(pose(0, 0, 0.046 * k, b.rng.normal(0, 12)), "book"):
                f.lying_book(b)
    elif name == "plant":
        f.potted_plant(b, 0.34)
    elif name == "sheet":
        b.quad((-0.105, 0.148, 0.002), (0.21, 0, 0), (0, -0.297, 0), sheet(), 1000)
    else:
        make: dict[str, Callable[[SceneBuilder], None]] = {
            "cup": lambda b: o.cup(b, random_colour(b.rng, 50, 235)),
            "bottle": lambda b: o.bottle(b, random_colour(b.rng, 30, 150)),
            "cell phone": o.cell_phone,
            "book": f.lying_book,
            "trophy": o.trophy,
            "drone": o.drone,
        }
        with b.at(np.eye(4), name):
            make[name](b)


def _wood(b: SceneBuilder) -> Colour:
    return _WOODS[b.rng.integers(len(_WOODS))]


def _chair(b: SceneBuilder, office_share: float) -> None:
    if b.rng.random() < office_share:
        f.office_chair(b, random_colour(b.rng, 30, 150))
    else:
        f.wooden_chair(b, _wood(b))


# --- furniture -----------------------------------------------------------------------------------


def _workplace(b: SceneBuilder, width: float) -> None:
    rng = b.rng
    with b.at(pose(0, -0.42)):
        with b.at(pose(0, 0), "desk"):
            f.desk(b, width, 0.75, _wood(b))
        with b.at(pose(0, 0, 0.74)):
            occupied = _computer(b)
            scatter(b, width, 0.75, int(rng.integers(5, 11)), occupied)
    with b.at(pose(*SEAT_M, 0, 180 + rng.uniform(-35, 35)), "chair"):
        _chair(b, 0.75)


def _computer(b: SceneBuilder) -> list[_Disc]:
    """One or two screens, keyboard and mouse; returns the places that they take."""
    rng = b.rng
    count = int(rng.integers(1, 3))
    shift = rng.uniform(-0.1, 0.1)
    occupied = []
    for k in range(count):
        x = shift + (k - (count - 1) / 2) * 0.57
        with b.at(pose(x, 0.18, 0, -14 * np.sign(x) * (count - 1) + rng.normal(0, 4)), "screen"):
            o.screen(b, rng.uniform(0.44, 0.53), rng.uniform(0.28, 0.33))
        occupied += [(x + step, 0.18, 0.13) for step in (-0.19, 0.0, 0.19)]
    x, y = rng.uniform(-0.12, 0.12), rng.uniform(-0.22, -0.12)
    with b.at(pose(x, y, 0, rng.normal(0, 5)), "keyboard"):
        o.keyboard(b)
    with b.at(pose(x + 0.32, y, 0, rng.normal(0, 15)), "mouse"):
        o.mouse(b)
    occupied += [(x + step, y, 0.1) for step in (-0.15, 0.0, 0.15)]
    return [*occupied, (x + 0.32, y, 0.07)]


def _bookcase(b: SceneBuilder, width: float) -> None:
    shelves = int(b.rng.integers(2, 6))
    with b.at(pose(0, -0.18)):
        with b.at(pose(0, 0), "bookcase"):
            f.bookcase(b, width, shelves, _wood(b))
        with b.at(pose(0, 0, shelves * 0.38 + 0.08)):
            scatter(b, width, 0.3, int(b.rng.integers(1, 4)), [])


def _sideboard(b: SceneBuilder, width: float) -> None:
    """A low cupboard with two doors, its back at y = -0.02, and things on it."""
    colour, depth, height = _wood(b), 0.42, b.rng.uniform(0.6, 0.85)
    y = -0.02 - depth / 2
    b.box((width, depth, height), wood(colour), (0, y, 0))
    for side in (-1, 1):
        front = (side * width / 4, y - depth / 2 - 0.004, 0.05)
        b.box((width / 2 - 0.04, 0.015, height - 0.09), wood(tuple(0.85 * np.array(colour))), front)
    with b.at(pose(0, y, height)):
        scatter(b, width, depth, int(b.rng.integers(2, 6)), [])


def _television(b: SceneBuilder, _: float) -> None:
    size = b.rng.uniform(0.9, 1.25)
    height = b.rng.uniform(0.4, 0.55)
    with b.at(pose(0, -0.24)):
        b.box((1.75, 0.42, height), wood(_wood(b)))
        with b.at(pose(0, 0, height)):
            with b.at(pose(0, 0, 0), "tv"):
                o.tv(b, size)
            occupied = [(x, 0.0, 0.22) for x in np.linspace(-size / 2, size / 2, 5)]
            scatter(b, 1.75, 0.42, 4, occupied)


def _dining(b: SceneBuilder, width: float) -> None:
    """A table with a chair on either side, the frame in its middle."""
    _table(b, width)
    for side in (-1, 1):
        with b.at(pose(0, side * 0.64, 0, 90 - 90 * side + b.rng.normal(0, 8)), "chair"):
            _chair(b, 0.2)


def _table_at_wall(b: SceneBuilder, width: float) -> None:
    with b.at(pose(0, -0.42)):
        _table(b, width)
        with b.at(pose(0, -0.64, 0, 180 + b.rng.normal(0, 8)), "chair"):
            _chair(b, 0.2)


def _table(b: SceneBuilder, width: float) -> None:
    colour = _wood(b)
    with b.at(pose(0, 0), "desk"):
        b.box((width, 0.8, 0.04), wood(colour), (0, 0, 0.72))
        for x in (-1, 1):
            for y in (-1, 1):
                leg = (x * (width / 2 - 0.06), y * 0.34, 0)
                b.box((0.07, 0.07, 0.72), wood(colour), leg)
    with b.at(pose(0, 0, 0.76)):
        scatter(b, width, 0.8, int(b.rng.integers(4, 9)), [])


def _low_table(b: SceneBuilder, _: float) -> None:
    f.table(b, 1.0, 0.6, 0.44, _wood(b))
    with b.at(pose(0, 0, 0.44)):
        scatter(b, 1.0, 0.6, int(b.rng.integers(2, 6)), [])


def _plant(b: SceneBuilder, height: float) -> None:
    with b.at(pose(0, -0.42 * height - 0.04)):
        f.potted_plant(b, height)


def _door(b: SceneBuilder, _: float) -> None:
    with b.at(np.eye(4), "door"):
        f.door(b, f"ROOM {b.rng.integers(100, 400)}", dull_colour(b.rng, 90, 190, warm=True))


def _sofa(b: SceneBuilder, _: float) -> None:
    with b.at(pose(0, -0.47)):
        f.sofa(b, random_colour(b.rng, 50, 150), random_colour(b.rng, 100, 220))


def _lone_chair(b: SceneBuilder, _: float) -> None:
    with b.at(pose(0, -0.34, 0, b.rng.normal(0, 12)), "chair"):
        _chair(b, 0.4)


def _suitcase(b: SceneBuilder, _: float) -> None:
    with b.at(pose(0, -0.24, 0, b.rng.uniform(-20, 20)), "suitcase"):
        o.suitcase(b, random_colour(b.rng, 30, 190), bool(b.rng.random() < 0.6))


def _umbrella(b: SceneBuilder, _: float) -> None:
    with b.at(pose(0, -0.22, 0.01) @ tilt("x", -9), "umbrella"):
        o.umbrella(b, random_colour(b.rng, 40, 200))


def _open_umbrella(b: SceneBuilder, _: float) -> None:
    """Left to dry: on its tip and the rim, whose radius is 0.48 m, 0.34 m above the tip."""
    with b.at(tilt("x", float(np.rad2deg(np.arctan2(0.34, 0.48)))), "umbrella"):
        o.umbrella(b, random_colour(b.rng, 40, 220), opened=True)


def _robot(b: SceneBuilder, _: float) -> None:
    with b.at(pose(0, -0.28, 0, b.rng.uniform(-35, 35)), "robot"):
        o.robot(b)


def _drone(b: SceneBuilder, _: float) -> None:
    with b.at(pose(0, -0.33), "drone"):
        o.drone(b)


def _floor_lamp(b: SceneBuilder, _: float) -> None:
    with b.at(pose(0, -0.23)):
        o.lamp_stand(b)


_PIECES: dict[str, Callable[[SceneBuilder, float], None]] = {
    "workplace": _workplace,
    "bookcase": _bookcase,
    "sideboard": _sideboard,
    "tv bench": _television,
    "dining": _dining,
    "table": _table_at_wall,
    "low table": _low_table,
    "plant": _plant,
    "door": _door,
    "sofa": _sofa,
    "chair": _lone_chair,
    "suitcase": _suitcase,
    "umbrella": _umbrella,
    "open umbrella": _open_umbrella,
    "robot": _robot,
    "drone": _drone,
    "floor lamp": _floor_lamp,
}
