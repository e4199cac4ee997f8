"""A living room: sofa and television, a dining table, bookcases, plants."""

from __future__ import annotations

import numpy as np

from bmask_slam.rendering.engine.builder import SceneBuilder
from bmask_slam.rendering.engine.lighting import Lamp, Lighting
from bmask_slam.rendering.engine.meshes import pose, tilt
from bmask_slam.rendering.engine.path import CameraPath
from bmask_slam.rendering.rooms.room import Room, ceiling_lamps, shell
from bmask_slam.rendering.things import furniture as f
from bmask_slam.rendering.things import objects as o
from bmask_slam.rendering.things.people import Role
from bmask_slam.rendering.things.prints import painting, poster, rug, window
from bmask_slam.rendering.things.surfaces import planks, plaster, wallpaper, wood

_WIDTH, _DEPTH, _HEIGHT = 6.4, 5.4, 2.6

LIGHTING = Lighting(
    (Lamp((1.6, 3.4, 2.5), 1.9), Lamp((4.6, 3.6, 2.5), 1.9), Lamp((3.2, 1.3, 2.5), 1.9)),
    ambient=0.45,
)

PATH = CameraPath(
    eyes_world=np.array([
        [3.0, 3.5, 1.45], [3.3, 3.1, 1.4], [3.6, 2.6, 1.4], [3.9, 2.1, 1.35], [3.7, 1.6, 1.4],
        [3.2, 1.3, 1.45], [2.6, 1.5, 1.4], [2.3, 2.1, 1.35], [2.4, 2.8, 1.4], [2.7, 3.3, 1.45],
        [3.0, 3.5, 1.45],
    ]),
    targets_world=np.array([
        [1.7, 0.8, 0.8], [0.7, 1.4, 0.8], [0.5, 2.9, 0.9], [1.5, 4.9, 0.9], [3.6, 5.1, 0.9],
        [5.2, 4.5, 0.8], [5.9, 3.2, 0.8], [5.9, 1.6, 0.9], [4.7, 0.4, 1.0], [2.9, 0.5, 0.9],
        [1.7, 0.8, 0.8],
    ]),
)  # fmt: skip

ROLES = (
    Role(
        "walk",
        ((3.9, 0.9), (4.4, 1.3), (4.3, 4.3), (3.2, 4.6), (3.3, 4.1), (4.0, 3.9)),
        carries="book",
    ),
    Role("sit", ((1.9, 0.62),), 180),
    Role("stand", ((0.9, 3.6),), 50, "cup"),
    Role("sit", ((5.93, 2.6),), -95),
    Role(
        "walk", ((1.7, 3.4), (1.7, 4.3), (2.8, 4.4), (2.5, 3.6)), carries="umbrella", speed_m_s=0.6
    ),
)
"""People, in the order in which they are added."""


def furnish(b: SceneBuilder) -> None:
    """Build the room: the sofa stands at y = 0, the television at the far wall."""
    walls = {
        "north": plaster((176, 196, 178)),
        "east": wallpaper((206, 194, 164), (150, 96, 84)),
        "south": wallpaper((196, 204, 212), (86, 110, 150)),
        "west": plaster((208, 188, 158)),
    }
    shell(b, Room(_WIDTH, _DEPTH, _HEIGHT), planks((158, 106, 62)), walls)
    ceiling_lamps(b, LIGHTING, _HEIGHT)
    _seats(b)
    _television(b)
    _dining(b)
    _west(b)


def _seats(b: SceneBuilder) -> None:
    b.quad((0.5, 3.0, 0.012), (2.9, 0, 0), (0, -1.7, 0), rug((150, 52, 48), (222, 196, 140)), 500)
    with b.at(pose(1.9, 0.5, 0, 180)):
        f.sofa(b, (70, 96, 118), (206, 150, 60))
    with b.at(pose(1.9, 1.75)):
        f.table(b, 1.1, 0.6, 0.42, f.WALNUT)
        with b.at(pose(0, 0, 0.42)):
            _coffee_table_objects(b)
    b.quad((3.0, 0.01, 2.1), (-1.0, 0, 0), (0, 0, -0.7), painting(), 800)
    b.quad((1.6, 0.01, 2.2), (-0.6, 0, 0), (0, 0, -0.8), poster(), 800)
    with b.at(pose(3.3, 0.35)):
        o.lamp_stand(b)
    with b.at(pose(4.3, 0.0, 0, 180), "door"):
        f.door(b, "HALL", (168, 128, 88))
    with b.at(pose(5.1, 0.12, 0.01, 20) @ tilt("x", -10), "umbrella"):
        o.umbrella(b, (150, 40, 60))


def _coffee_table_objects(b: SceneBuilder) -> None:
    for x, y, yaw in ((-0.35, 0.1, 15), (-0.33, 0.09, 40)):
        with b.at(pose(x, y, 0.05 if yaw > 30 else 0, yaw), "book"):
            f.lying_book(b)
    with b.at(pose(0.05, -0.12, 0, 200), "cup"):
        o.cup(b, (220, 180, 60))
    with b.at(pose(0.3, 0.12, 0, 120), "cup"):
        o.cup(b, (70, 110, 190))
    with b.at(pose(0.4, -0.12, 0, -30), "cell phone"):
        o.cell_phone(b)
    with b.at(pose(0.12, 0.16), "bottle"):
        o.bottle(b, (110, 60, 30))


def _television(b: SceneBuilder) -> None:
    with b.at(pose(1.9, _DEPTH - 0.3)):
        b.box((1.8, 0.42, 0.45), wood(f.OAK))
        for x in (-0.6, 0, 0.6):
            b.box((0.55, 0.015, 0.37), wood(f.WALNUT), (x, -0.215, 0.04))
            b.box((0.12, 0.02, 0.015), wood(f.DARK), (x, -0.23, 0.36))
        with b.at(pose(0, 0, 0.45), "tv"):
            o.tv(b)
        with b.at(pose(0.8, 0, 0.45), "trophy"):
            o.trophy(b)
        with b.at(pose(-0.78, -0.02, 0.45, 30), "book"):
            f.lying_book(b)
    with b.at(pose(0.45, _DEPTH - 0.45)):
        f.potted_plant(b, 1.15)
    with b.at(pose(2.6, _DEPTH, 2.15), "air conditioner"):
        f.air_conditioner(b)
    b.quad((1.2, _DEPTH - 0.01, 2.2), (0.9, 0, 0), (0, 0, -0.6), painting(), 800)
    with b.at(pose(3.9, _DEPTH - 0.2), "bookcase"):
        f.bookcase(b, 1.3, 5)
    with b.at(pose(4.9, _DEPTH - 0.4, 0, -15), "suitcase"):
        o.suitcase(b, (40, 80, 130))
    with b.at(pose(5.7, _DEPTH - 0.5, 0, -30), "robot"):
        o.robot(b)


def _dining(b: SceneBuilder) -> None:
    with b.at(pose(5.2, 2.9)), b.at(pose(0, 0), "desk"):
        b.box((1.0, 1.5, 0.04), wood(f.OAK), (0, 0, 0.72))
        for x in (-0.42, 0.42):
            for y in (-0.66, 0.66):
                b.box((0.07, 0.07, 0.72), wood(f.OAK), (x, y, 0))
    with b.at(pose(5.2, 2.9, 0.76)):
        for x, y, kind in ((-0.2, 0.4, "cup"), (0.25, -0.35, "cup"), (0.0, 0.05, "bottle")):
            with b.at(pose(x, y, 0, 360 * b.rng.random()), kind):
                o.cup(b, (200, 200, 190)) if kind == "cup" else o.bottle(b)
        with b.at(pose(0.15, 0.35, 0, 70), "book"):
            f.lying_book(b)
        with b.at(pose(-0.1, -0.4)):
            f.potted_plant(b, 0.38)
    for x, y, yaw in ((4.5, 2.55, -95), (4.5, 3.3, -80), (5.95, 2.6, 85), (5.25, 1.9, 170)):
        with b.at(pose(x, y, 0, yaw + 180 * (abs(yaw) < 100)), "chair"):
            f.wooden_chair(b)
    b.quad((_WIDTH - 0.01, 4.6, 2.2), (0, -0.9, 0), (0, 0, -0.6), painting(), 800)
    b.quad((_WIDTH - 0.01, 3.5, 2.3), (0, -0.7, 0), (0, 0, -0.95), poster(), 800)
    b.quad((_WIDTH - 0.01, 2.5, 2.1), (0, -1.3, 0), (0, 0, -1.1), window(), 600, shines=True)
    with b.at(pose(5.9, 0.6, 0, -90)):
        f.potted_plant(b, 0.9)
    with b.at(pose(_WIDTH, 1.2, 0.35, -90), "jackboard"):
        o.jackboard(b)


def _west(b: SceneBuilder) -> None:
    with b.at(pose(0.2, 3.9, 0, 90), "bookcase"):
        f.bookcase(b, 1.1, 5, f.OAK)
    b.quad((0.01, 1.1, 2.1), (0, 1.4, 0), (0, 0, -1.15), window(), 600, shines=True)
    b.quad((0.01, 2.75, 2.1), (0, 0.5, 0), (0, 0, -0.65), poster(), 800)
    with b.at(pose(0.45, 2.4, 0, 110), "chair"):
        f.wooden_chair(b, f.OAK)
    with b.at(pose(0.0, 0.55, 1.3, 90), "switchbox"):
        o.switchbox(b)
