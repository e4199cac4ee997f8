"""An office for three: desks with computers, bookcases, a door, an air conditioner."""

from __future__ import annotations

import numpy as np

from bmask_slam.rendering.engine.builder import SceneBuilder
from bmask_slam.rendering.engine.lighting import Lamp, Lighting
from bmask_slam.rendering.engine.meshes import pose, tilt
from bmask_slam.rendering.engine.path import CameraPath
from bmask_slam.rendering.rooms.room import Room, ceiling_lamps, shell
from bmask_slam.rendering.things import furniture as f
from bmask_slam.rendering.things import objects as o
from bmask_slam.rendering.things.paper import notice_board, sheet
from bmask_slam.rendering.things.people import Role
from bmask_slam.rendering.things.prints import painting, poster, whiteboard, window
from bmask_slam.rendering.things.surfaces import bricks, carpet, plaster

_WIDTH, _DEPTH, _HEIGHT = 6.0, 5.0, 2.7

LIGHTING = Lighting(tuple(Lamp((x, y, 2.6)) for x in (1.5, 4.5) for y in (1.4, 3.6)), ambient=0.42)

PATH = CameraPath(
    eyes_world=np.array([
        [3.0, 2.0, 1.45], [2.5, 2.2, 1.4], [2.1, 2.6, 1.35], [2.4, 3.1, 1.4], [3.0, 3.1, 1.45],
        [3.6, 2.9, 1.4],
        [4.0, 2.5, 1.4], [3.8, 2.0, 1.45], [3.3, 1.8, 1.5], [2.8, 1.9, 1.5], [3.0, 2.0, 1.45],
    ]),
    targets_world=np.array([
        [2.6, 4.7, 0.95], [1.4, 4.6, 0.9], [0.4, 3.6, 0.95], [0.4, 2.2, 1.0], [2.2, 0.4, 1.15],
        [4.0, 0.3, 1.15],
        [5.6, 1.4, 1.1], [5.7, 2.8, 1.1], [4.9, 4.5, 1.0], [3.6, 4.7, 0.95], [2.6, 4.7, 0.95],
    ]),
)  # fmt: skip

ROLES = (
    Role("walk", ((1.1, 1.1), (2.6, 1.15), (4.2, 1.25), (5.0, 1.3), (4.6, 1.75), (3.0, 1.45),
                  (1.4, 1.5)), carries="suitcase"),
    Role("sit", ((1.4, 3.92),), 180),
    Role("stand", ((4.3, 3.75),), -40, "cup"),
    Role("walk", ((1.25, 2.0), (1.2, 2.7), (1.45, 3.3), (1.7, 2.6)), carries="book", speed_m_s=0.6),
    Role("sit", ((4.92, 2.25),), 90),
    Role("stand", ((2.4, 0.7),), 190, "cell phone"),
)  # fmt: skip
"""People, in the order in which they are added."""


def furnish(b: SceneBuilder) -> None:
    """Build the room: x to the right, y away, door side at y = 0."""
    room = Room(_WIDTH, _DEPTH, _HEIGHT)
    cream = plaster((196, 190, 172))
    blue, brick = plaster((150, 172, 180)), bricks((150, 84, 62))
    walls = {"north": cream, "east": blue, "south": cream, "west": brick}
    shell(b, room, carpet((96, 104, 116), (170, 150, 120)), walls)
    ceiling_lamps(b, LIGHTING, _HEIGHT)
    _north(b)
    _west(b)
    _south(b)
    _east(b)


def workplace(b: SceneBuilder, screens: int = 1, chair_yaw_deg: float = 200.0) -> None:
    """A desk with its computer, its chair and clutter; whoever works there looks along +y."""
    rng = b.rng
    with b.at(pose(0, 0), "desk"):
        f.desk(b)
    with b.at(pose(0, 0, 0.74)):
        for k in range(screens):
            x = (k - (screens - 1) / 2) * 0.56
            with b.at(pose(x, 0.18, 0, -12 * np.sign(x)), "screen"):
                o.screen(b)
        with b.at(pose(0.02, -0.16, 0, rng.normal(0, 3)), "keyboard"):
            o.keyboard(b)
        with b.at(pose(0.34, -0.15, 0, rng.normal(0, 15)), "mouse"):
            o.mouse(b)
        with b.at(pose(-0.42, -0.1, 0, 140), "cup"):
            o.cup(b, (200, 60, 50))
        with b.at(pose(0.6, 0.15), "bottle"):
            o.bottle(b)
        with b.at(pose(0.52, -0.16, 0, 25), "cell phone"):
            o.cell_phone(b)
        with b.at(pose(-0.6, 0.12, 0, 20), "book"):
            f.lying_book(b)
        for x, yaw in ((-0.58, -12), (-0.36, 8)):
            with b.at(pose(x, -0.22, 0.001 * (2 + x), yaw)):
                b.quad((-0.1, 0.14, 0), (0.21, 0, 0), (0, -0.297, 0), sheet(), 1000)
    with b.at(pose(0.05, -0.62, 0, chair_yaw_deg), "chair"):
        f.office_chair(b, tuple(float(c) for c in rng.integers(30, 140, 3)))


def _north(b: SceneBuilder) -> None:
    for x, screens in ((1.35, 2), (3.2, 1)):
        with b.at(pose(x, _DEPTH - 0.42)):
            workplace(b, screens, 180 + b.rng.uniform(-30, 30))
    with b.at(pose(5.0, _DEPTH - 0.25)):
        with b.at(pose(0, 0), "bookcase"):
            f.bookcase(b, 1.2)
        with b.at(pose(-0.3, 0, 1.98), "trophy"):
            o.trophy(b)
        with b.at(pose(0.25, 0, 1.98), "drone"):
            o.drone(b)
    b.quad((0.6, _DEPTH - 0.01, 2.35), (1.5, 0, 0), (0, 0, -0.95), notice_board(), 700)
    b.quad((2.5, _DEPTH - 0.01, 2.3), (0.6, 0, 0), (0, 0, -0.85), poster(), 800)
    b.quad((3.35, _DEPTH - 0.01, 2.2), (0.7, 0, 0), (0, 0, -0.5), painting(), 800)


def _west(b: SceneBuilder) -> None:
    with b.at(pose(0.25, 3.1, 0, 90)):
        with b.at(pose(0, 0), "bookcase"):
            f.bookcase(b, 1.0, 4, f.OAK)
        with b.at(pose(0.1, 0, 1.6), "cup"):
            o.cup(b, (60, 90, 170))
    b.quad((0.01, 0.7, 2.2), (0, 1.5, 0), (0, 0, -1.2), window(), 600, shines=True)
    with b.at(pose(0.45, 0.5)):
        f.potted_plant(b, 1.0)
    with b.at(pose(0.4, 1.5, 0, 70), "suitcase"):
        o.suitcase(b, (170, 40, 52))
    with b.at(pose(0.0, 3.1, 2.1, 90), "air conditioner"):
        f.air_conditioner(b)


def _south(b: SceneBuilder) -> None:
    with b.at(pose(4.9, 0.0, 0, 180), "door"):
        f.door(b, "ROOM 214")
    b.quad((3.9, 0.01, 2.1), (-2.1, 0, 0), (0, 0, -1.15), whiteboard(), 650)
    with b.at(pose(4.15, 0.0, 1.35, 180), "switchbox"):
        o.switchbox(b)
    with b.at(pose(2.2, 0.0, 0.3, 180), "jackboard"):
        o.jackboard(b)
    with b.at(pose(1.3, 0.45, 0, 165), "chair"):
        f.wooden_chair(b)
    with b.at(pose(3.9, 0.1, 0.01, 30) @ tilt("x", -9), "umbrella"):
        o.umbrella(b, (40, 60, 130))
    with b.at(pose(3.1, 0.5, 0, 200), "robot"):
        o.robot(b)


def _east(b: SceneBuilder) -> None:
    with b.at(pose(_WIDTH - 0.42, 2.3, 0, -90)):
        workplace(b, 1, 150)
    with b.at(pose(_WIDTH - 0.4, 3.75)):
        f.potted_plant(b, 0.75)
    b.quad((_WIDTH - 0.01, 3.3, 2.3), (0, -0.9, 0), (0, 0, -0.65), poster(), 800)
    b.quad((_WIDTH - 0.01, 2.2, 2.3), (0, -0.6, 0), (0, 0, -0.85), poster(), 800)
    b.quad((_WIDTH - 0.01, 1.4, 2.1), (0, -0.8, 0), (0, 0, -0.55), painting(), 800)
