"""Small things and devices: each function adds one, front toward -y, standing on z = 0."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from bmask_slam.rendering.engine.builder import Painter, SceneBuilder
from bmask_slam.rendering.engine.meshes import pose, tilt
from bmask_slam.rendering.things.displays import broadcast, desktop, keys
from bmask_slam.rendering.things.drawing import random_colour
from bmask_slam.rendering.things.prints import label, sign
from bmask_slam.rendering.things.surfaces import Colour, fabric, plain

_BLACK: Colour = (30, 30, 34)
_GOLD: Colour = (206, 164, 62)


def screen(b: SceneBuilder, width: float = 0.52, height: float = 0.31) -> None:
    """A computer monitor on its stand."""
    b.box((0.24, 0.18, 0.015), plain(_BLACK))
    b.box((0.05, 0.03, 0.2), plain(_BLACK), (0, 0.03, 0.01))
    b.box((width, 0.03, height), plain(_BLACK), (0, 0, 0.13))
    _panel(b, width, height, (0, -0.0155, 0.13), desktop())


def tv(b: SceneBuilder, width: float = 1.15) -> None:
    """A television on two feet."""
    height = 0.58 * width
    for x in (-0.35, 0.35):
        b.box((0.05, 0.22, 0.05), plain(_BLACK), (x * width, 0, 0))
    b.box((width, 0.05, height), plain(_BLACK), (0, 0, 0.05))
    _panel(b, width, height, (0, -0.0255, 0.05), broadcast())


def _panel(
    b: SceneBuilder, width: float, height: float, foot: tuple[float, float, float], picture: Painter
) -> None:
    origin = (foot[0] - width / 2 + 0.008, foot[1], foot[2] + height - 0.008)
    b.quad(origin, (width - 0.016, 0, 0), (0, 0, -height + 0.016), picture, 1000, shines=True)


def keyboard(b: SceneBuilder) -> None:
    """A computer keyboard."""
    b.box((0.44, 0.14, 0.02), plain(_BLACK), faces={"top": keys()}, px_per_m=1400)


def mouse(b: SceneBuilder) -> None:
    """A computer mouse with its wheel."""
    b.ball((0, 0, 0.008), (0.032, 0.055, 0.028), plain((52, 52, 58)))
    b.ball((0, -0.025, 0.031), (0.005, 0.012, 0.006), plain((150, 150, 156)))


def cup(b: SceneBuilder, colour: Colour) -> None:
    """A mug with a handle, and coffee in it."""
    b.lathe([(0, 0), (0.036, 0), (0.04, 0.01), (0.041, 0.095), (0.037, 0.096), (0.036, 0.08)],
            label(colour), px_per_m=1100)  # fmt: skip
    b.lathe([(0.037, 0.078), (0, 0.078)], plain((58, 34, 20)))
    turn = np.linspace(-1.25, 1.25, 7)
    loop = [(0.034 + 0.033 * np.cos(a), 0, 0.05 + 0.03 * np.sin(a)) for a in turn]
    for p, q in pairwise(loop):
        b.rod(p, q, 0.006, plain(colour))


def bottle(b: SceneBuilder, colour: Colour = (40, 110, 70)) -> None:
    """A bottle with label and cap."""
    b.lathe([(0, 0), (0.034, 0), (0.036, 0.01), (0.036, 0.05)], plain(colour))
    b.lathe([(0.0365, 0.05), (0.0365, 0.14)], label(), px_per_m=1100)
    b.lathe([(0.036, 0.14), (0.036, 0.17), (0.016, 0.21), (0.013, 0.25)], plain(colour))
    b.lathe([(0.0155, 0.235), (0.0155, 0.258), (0, 0.26)], plain((200, 40, 44)))


def cell_phone(b: SceneBuilder) -> None:
    """A phone that lies on its back, with its display on."""
    b.box((0.075, 0.15, 0.01), plain(_BLACK))
    b.quad((-0.034, 0.07, 0.0105), (0.068, 0, 0), (0, -0.14, 0), desktop(), 1600, shines=True)


def trophy(b: SceneBuilder) -> None:
    """A golden cup on a wooden foot with a plate."""
    b.box((0.13, 0.13, 0.07), plain((60, 36, 24)))
    b.quad(
        (-0.045, -0.0655, 0.055), (0.09, 0, 0), (0, 0, -0.04), sign("CHAMPION 2020", _GOLD), 1600
    )
    b.lathe([(0.045, 0.07), (0.012, 0.1), (0.012, 0.15), (0.05, 0.19), (0.075, 0.27), (0.085, 0.33),
             (0.078, 0.33), (0.05, 0.21), (0, 0.2)], plain(_GOLD, 14))  # fmt: skip
    for side in (-1, 1):
        turn = np.linspace(-1.3, 1.3, 6)
        loop = [(side * (0.07 + 0.045 * np.cos(a)), 0, 0.26 + 0.05 * np.sin(a)) for a in turn]
        for p, q in pairwise(loop):
            b.rod(p, q, 0.007, plain(_GOLD))


def suitcase(b: SceneBuilder, colour: Colour, pulled_out: bool = True) -> None:
    """A hard-shell trolley, standing, with ribs, wheels and perhaps a pulled-out handle."""
    b.box((0.42, 0.25, 0.62), plain(colour, 10), (0, 0, 0.05))
    for k in range(5):
        b.box(
            (0.02, 0.012, 0.56),
            plain(tuple(0.7 * np.array(colour))),
            (-0.16 + 0.08 * k, -0.13, 0.08),
        )
    for x in (-0.17, 0.17):
        for y in (-0.09, 0.09):
            b.ball((x, y, 0.028), (0.02, 0.028, 0.028), plain(_BLACK))
        if pulled_out:
            b.rod((x * 0.5, 0.09, 0.66), (x * 0.5, 0.09, 1.0), 0.009, plain((150, 150, 154)))
    if pulled_out:
        b.rod((-0.09, 0.09, 1.0), (0.09, 0.09, 1.0), 0.016, plain(_BLACK))
    b.box((0.16, 0.03, 0.03), plain(_BLACK), (0, 0, 0.69))
    b.quad((0.06, -0.138, 0.6), (0.1, 0, 0), (0, 0, -0.06), sign("FLY"), 1200)


def umbrella(b: SceneBuilder, colour: Colour, opened: bool = False) -> None:
    """An umbrella, tip down on z = 0; opened it shows eight panels."""
    length = 0.92
    b.rod((0, 0, 0), (0, 0, length - 0.05), 0.008, plain((60, 60, 64)))
    turn = np.linspace(0, np.pi, 7)
    hook = [(0.035 - 0.035 * np.cos(a), 0, length - 0.05 + 0.04 * np.sin(a)) for a in turn]
    for p, q in pairwise(hook):
        b.rod(p, q, 0.012, plain((120, 76, 40)))
    second = random_colour(b.rng, 120, 240)
    if opened:
        profile = [(0.01, 0.1), (0.2, 0.14), (0.36, 0.22), (0.48, 0.34)]
        b.lathe(profile, fabric(colour, second), segments=8, px_per_m=500)
    else:
        b.lathe(
            [(0.008, 0.08), (0.03, 0.16), (0.045, 0.45), (0.03, 0.66), (0.01, 0.68)],
            fabric(colour, second),
        )


def parcel(b: SceneBuilder) -> None:
    """A cardboard box with labels on its sides; centre of its floor at the origin."""
    b.box((0.42, 0.32, 0.3), plain((176, 134, 88), 9))
    with b.at(pose(0, 0, 0.15)):
        for yaw_deg, out in ((0, 0.161), (90, 0.211), (180, 0.161), (270, 0.211)):
            with b.at(pose(0, 0, 0, yaw_deg)):
                b.quad((-0.12, -out, 0.11), (0.14, 0, 0), (0, 0, -0.2), label(), 900)
                b.quad((0.05, -out, 0.08), (0.09, 0, 0), (0, 0, -0.06), sign("UP"), 1200)


def switchbox(b: SceneBuilder) -> None:
    """A grey electrical cabinet with a warning sign; back at y = 0."""
    b.box((0.4, 0.16, 0.55), plain((146, 150, 152)), (0, -0.08, 0))
    b.box((0.36, 0.012, 0.51), plain((160, 164, 166)), (0, -0.165, 0.02))
    b.quad((-0.11, -0.172, 0.42), (0.22, 0, 0), (0, 0, -0.16), sign("230 V", (240, 200, 30)), 900)
    b.box((0.02, 0.02, 0.08), plain(_BLACK), (0.14, -0.175, 0.12))


def jackboard(b: SceneBuilder) -> None:
    """A strip of wall sockets; back at y = 0."""
    b.box((0.34, 0.012, 0.09), plain((236, 236, 232), 3), (0, -0.006, 0))
    for k in range(4):
        with b.at(pose(-0.12 + 0.08 * k, -0.013, 0.045) @ tilt("x", 90)):
            b.lathe([(0.03, 0.0), (0.03, 0.004), (0.022, 0.0), (0, 0.0)], plain((205, 205, 200)))
            for x in (-0.009, 0.009):
                b.ball((x, 0, 0.001), (0.003, 0.003, 0.002), plain(_BLACK))


def robot(b: SceneBuilder) -> None:
    """A small round floor robot with a head, eyes and a chest panel."""
    body = plain((228, 230, 232), 5)
    b.lathe(
        [
            (0, 0.02),
            (0.2, 0.02),
            (0.22, 0.06),
            (0.2, 0.14),
            (0.13, 0.2),
            (0.15, 0.45),
            (0.1, 0.6),
            (0, 0.62),
        ],
        body,
    )
    b.ball((0, 0, 0.72), (0.14, 0.13, 0.12), body)
    for x in (-0.05, 0.05):
        b.ball((x, -0.11, 0.74), (0.028, 0.025, 0.028), plain((20, 60, 140)))
    b.quad((-0.08, -0.152, 0.45), (0.16, 0, 0), (0, 0.01, -0.12), desktop(), 1000, shines=True)
    for side in (-1, 1):
        b.rod((side * 0.13, 0, 0.52), (side * 0.22, -0.08, 0.3), 0.025, plain((90, 94, 100)))


def drone(b: SceneBuilder) -> None:
    """A quadrotor."""
    b.box((0.14, 0.18, 0.06), plain((60, 62, 68)), (0, 0, 0.04))
    b.ball((0, -0.09, 0.05), (0.025, 0.02, 0.025), plain((20, 20, 24)))
    for x in (-1, 1):
        for y in (-1, 1):
            end = np.array([0.19 * x, 0.19 * y, 0.07])
            b.rod((0.05 * x, 0.06 * y, 0.07), end, 0.012, plain((190, 60, 40)))
            b.rod(end, end + np.array([0, 0, 0.035]), 0.018, plain((40, 40, 44)))
            b.rod(end - [0, 0, 0.07], end, 0.006, plain((40, 40, 44)))
            b.lathe(
                [(0, 0), (0.11, 0), (0.11, 0.003), (0, 0.003)],
                plain((120, 124, 130)),
                end + np.array([0, 0, 0.036]),
            )


def lamp_stand(b: SceneBuilder) -> None:
    """A floor lamp."""
    b.lathe([(0, 0), (0.15, 0), (0.15, 0.02), (0, 0.03)], plain(_BLACK))
    b.rod((0, 0, 0.02), (0, 0, 1.45), 0.013, plain((150, 150, 152)))
    b.lathe([(0.21, 1.35), (0.12, 1.65)], fabric((232, 214, 170), (240, 190, 120)))
