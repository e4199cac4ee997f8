"""Furniture: each function adds one piece, front toward -y, standing on z = 0 of the frame."""

from __future__ import annotations

import numpy as np

from bmask_slam.rendering.engine.builder import Painter, SceneBuilder
from bmask_slam.rendering.engine.meshes import pose, tilt
from bmask_slam.rendering.things.paper import book_cover, book_spine, pages
from bmask_slam.rendering.things.prints import sign
from bmask_slam.rendering.things.surfaces import Colour, fabric, leaf, plain, wood

OAK: Colour = (176, 130, 82)
WALNUT: Colour = (116, 78, 50)
STEEL: Colour = (150, 152, 158)
DARK: Colour = (46, 46, 52)


def desk(b: SceneBuilder, width: float = 1.5, depth: float = 0.75, colour: Colour = OAK) -> None:
    """A desk 0.74 m high with a drawer block on its right."""
    b.box((width, depth, 0.035), wood(colour), (0, 0, 0.705))
    for x in (-1, 1):
        for y in (-1, 1):
            leg = (x * (width / 2 - 0.05), y * (depth / 2 - 0.05), 0)
            b.box((0.05, 0.05, 0.705), plain(STEEL), leg)
    block = (width / 2 - 0.28, 0.02, 0.06)
    b.box((0.4, depth - 0.14, 0.62), wood(colour, 0.8), block)
    for k in range(3):
        z = 0.1 + 0.2 * k
        front = (block[0], -depth / 2 + 0.085, z)
        b.box((0.37, 0.02, 0.175), wood(tuple(0.88 * np.array(colour))), front)
        b.box((0.12, 0.02, 0.02), plain(DARK), (block[0], -depth / 2 + 0.068, z + 0.1))


def table(b: SceneBuilder, width: float, depth: float, height: float, colour: Colour) -> None:
    """A low table on four legs."""
    b.box((width, depth, 0.04), wood(colour), (0, 0, height - 0.04))
    for x in (-1, 1):
        for y in (-1, 1):
            leg = (x * (width / 2 - 0.06), y * (depth / 2 - 0.06), 0)
            b.box((0.06, 0.06, height - 0.04), wood(colour), leg)
    b.box((width - 0.16, depth - 0.16, 0.025), wood(colour), (0, 0, 0.14))


def office_chair(b: SceneBuilder, colour: Colour = (44, 62, 110)) -> None:
    """A swivel chair on five castors, with arm rests."""
    for k in range(5):
        a = 2 * np.pi * k / 5
        foot = np.array([0.29 * np.cos(a), 0.29 * np.sin(a), 0.06])
        b.rod((0, 0, 0.1), foot, 0.022, plain(DARK))
        b.ball(foot - [0, 0, 0.02], (0.035, 0.035, 0.035), plain((26, 26, 28)))
    b.rod((0, 0, 0.08), (0, 0, 0.42), 0.028, plain(STEEL))
    cloth = fabric(colour)
    b.box((0.48, 0.46, 0.08), cloth, (0, 0, 0.42))
    with b.at(pose(0, 0.22, 0.5) @ tilt("x", -8)):
        b.box((0.09, 0.03, 0.2), plain(DARK), (0, 0.03, -0.06))
        b.box((0.44, 0.06, 0.5), cloth, (0, 0, 0.06))
    for x in (-1, 1):
        b.rod((x * 0.27, 0.05, 0.44), (x * 0.27, 0.05, 0.65), 0.015, plain(DARK))
        b.box((0.06, 0.27, 0.03), plain(DARK), (x * 0.27, 0, 0.65))


def wooden_chair(b: SceneBuilder, colour: Colour = WALNUT, seat: Painter | None = None) -> None:
    """A chair with four legs and a back of slats."""
    for x in (-0.19, 0.19):
        b.box((0.04, 0.04, 0.45), wood(colour), (x, -0.18, 0))
        b.box((0.04, 0.04, 0.95), wood(colour), (x, 0.19, 0))
    b.box((0.44, 0.43, 0.05), seat or wood(colour), (0, 0, 0.43))
    for z in (0.6, 0.74, 0.87):
        b.box((0.36, 0.022, 0.08), wood(colour), (0, 0.19, z))


def sofa(b: SceneBuilder, colour: Colour, second: Colour) -> None:
    """A sofa for three with two loose cushions."""
    cloth = fabric(colour)
    b.box((2.0, 0.85, 0.4), cloth, (0, 0, 0.04))
    b.box((2.0, 0.22, 0.45), cloth, (0, 0.33, 0.42))
    for side in (-1, 1):
        b.box((0.2, 0.85, 0.6), cloth, (side * 1.0, 0, 0.04))
    for x in (-0.53, 0, 0.53):
        b.box((0.51, 0.6, 0.1), fabric(tuple(1.12 * np.array(colour))), (x, -0.1, 0.44))
    for x, yaw in ((-0.65, 20), (0.62, -15)):
        with b.at(pose(x, 0.1, 0.56, yaw) @ tilt("x", -20)):
            b.box((0.42, 0.12, 0.4), fabric(second, colour))


def books(b: SceneBuilder, width: float, depth: float, room: float) -> None:
    """A row of standing books from x = 0 to ``width``, backs toward -y at y = 0."""
    rng = b.rng
    x = 0.0
    while x < width - 0.06:
        if rng.random() < 0.12:
            x += rng.uniform(0.04, 0.12)
            continue
        thick, height = rng.uniform(0.018, 0.055), room * rng.uniform(0.66, 0.95)
        with b.at(pose(x + thick / 2, depth / 2 + rng.uniform(0, 0.03), 0), "book"):
            cover = plain(tuple(float(c) for c in rng.integers(40, 200, 3)))
            faces = {"front": book_spine(), "top": pages()}
            b.box((thick, depth, height), cover, faces=faces, px_per_m=800)
        x += thick + 0.001


def bookcase(
    b: SceneBuilder, width: float = 1.0, shelves: int = 5, colour: Colour = WALNUT
) -> None:
    """Shelves 0.38 m apart, full of books; the books are instances of their own."""
    depth, step = 0.3, 0.38
    height = shelves * step + 0.08
    for x in (-1, 1):
        b.box((0.03, depth, height), wood(colour), (x * (width / 2 - 0.015), 0, 0))
    b.box(
        (width - 0.06, 0.015, height), wood(tuple(0.8 * np.array(colour))), (0, depth / 2 - 0.01, 0)
    )
    for k in range(shelves + 1):
        b.box((width - 0.06, depth - 0.01, 0.025), wood(colour), (0, 0, 0.05 + k * step))
    for k in range(shelves):
        with b.at(pose(-width / 2 + 0.035, -depth / 2 + 0.03, 0.076 + k * step)):
            books(b, width - 0.07, 0.2, step - 0.04)


def door(b: SceneBuilder, text: str, colour: Colour = (140, 92, 56)) -> None:
    """A closed door in its frame, 0.9 by 2.05 m, with a name plate; back at y = 0."""
    for x in (-0.5, 0.5):
        b.box((0.1, 0.1, 2.1), wood((206, 200, 188), 0.3), (x, -0.03, 0))
    b.box((1.1, 0.1, 0.1), wood((206, 200, 188), 0.3), (0, -0.03, 2.08))
    b.box((0.9, 0.05, 2.07), wood(colour, 1.3), (0, -0.02, 0.005))
    for z, h in ((0.15, 0.7), (1.0, 0.9)):
        b.box((0.62, 0.012, h), wood(tuple(0.85 * np.array(colour)), 1.3), (0, -0.05, z))
    b.rod((0.36, -0.045, 1.02), (0.36, -0.1, 1.02), 0.012, plain(STEEL))
    b.rod((0.365, -0.1, 1.02), (0.25, -0.1, 1.02), 0.011, plain(STEEL))
    b.quad((-0.14, -0.058, 1.72), (0.28, 0, 0), (0, 0, -0.1), sign(text), 900)


def air_conditioner(b: SceneBuilder) -> None:
    """A wall unit with its louvre and display; back at y = 0."""
    body = plain((226, 227, 224), 4)
    b.box((0.9, 0.2, 0.28), body, (0, -0.1, 0))
    b.box((0.86, 0.02, 0.05), plain((120, 122, 126)), (0, -0.205, 0.03))
    for k in range(9):
        b.box((0.012, 0.012, 0.05), plain((210, 210, 206)), (-0.36 + 0.09 * k, -0.218, 0.03))
    for k in range(3):
        b.box((0.86, 0.006, 0.008), plain((170, 172, 172)), (0, -0.203, 0.12 + 0.04 * k))
    b.quad(
        (0.2, -0.202, 0.25),
        (0.18, 0, 0),
        (0, 0, -0.035),
        sign("23 C", (24, 40, 36), (120, 240, 170)),
        1500,
    )


def plant(b: SceneBuilder, height: float = 0.9, leaves: int = 46) -> None:
    """Leaves on bent stems above a pot; the pot is made by ``flower_pot``."""
    rng = b.rng
    for _ in range(leaves):
        angle, reach = rng.uniform(0, 360), rng.uniform(0.05, 0.32) * height
        z = rng.uniform(0.25, 1.0) * height
        stem_end = (reach * np.cos(np.deg2rad(angle)), reach * np.sin(np.deg2rad(angle)), z)
        if rng.random() < 0.3:
            b.rod((0, 0, 0.1 * height), stem_end, 0.005, plain((70, 100, 46)))
        size = rng.uniform(0.14, 0.26) * height
        with b.at(pose(*stem_end, angle + rng.normal(0, 25)) @ tilt("y", rng.uniform(-10, 70))):
            blade(b, size, 0.42 * size)


def blade(b: SceneBuilder, length: float, width: float) -> None:
    """A leaf along +x, folded a little: four slanted quads."""
    paint = leaf((52, 118, 44))
    for side in (-1, 1):
        b.quad((0, 0, 0), (0.5 * length, side * width / 2, 0.03 * length),
               (0.5 * length, -side * width / 2, -0.06 * length), paint, 500)  # fmt: skip


def flower_pot(b: SceneBuilder, radius: float = 0.16, height: float = 0.3) -> None:
    """A clay pot with earth in it."""
    r = radius
    profile = [(0, 0), (0.68 * r, 0), (0.9 * r, 0.8 * height), (r, 0.82 * height), (r, height),
               (0.88 * r, height), (0.86 * r, 0.9 * height)]  # fmt: skip
    b.lathe(profile, plain((176, 92, 58), 11))
    b.lathe([(0.87 * radius, 0.9 * height), (0, 0.93 * height)], plain((58, 42, 30), 14))


def potted_plant(b: SceneBuilder, height: float = 0.9) -> None:
    """A plant (its own instance) in a flower pot (another)."""
    with b.at(pose(0, 0), "flower pot"):
        flower_pot(b, 0.16 * height / 0.9 + 0.03, 0.3 * height)
    with b.at(pose(0, 0, 0.25 * height), "potted plant"):
        plant(b, height)


def lying_book(b: SceneBuilder, colour: Colour | None = None) -> None:
    """A closed book that lies on its back."""
    thick = b.rng.uniform(0.02, 0.045)
    faces = {"top": book_cover(colour), "front": book_spine(colour)}
    b.box((0.16, 0.23, thick), pages(), faces=faces, px_per_m=900)
