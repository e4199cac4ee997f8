"""Painters of flat things: posters, paintings, windows, boards, rugs, signs, labels."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np

from bmask_slam.graph.arrays import Image
from bmask_slam.rendering.engine.builder import Painter
from bmask_slam.rendering.things.drawing import (
    canvas,
    framed,
    landscape,
    lines_of_text,
    random_colour,
    words,
    write,
)
from bmask_slam.rendering.things.surfaces import Colour, as_image, field, flat, octaves


def poster() -> Painter:
    """Bold shapes, a headline and small print."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        picture = canvas(rows, columns, random_colour(rng, 120, 245), rng)
        for _ in range(rng.integers(9, 16)):
            centre = (int(rng.uniform(0, columns)), int(rng.uniform(0.15, 0.75) * rows))
            size = int(rng.uniform(0.04, 0.2) * columns)
            colour = random_colour(rng)
            kind = rng.integers(3)
            if kind == 0:
                cv2.circle(picture, centre, size, colour, -1, cv2.LINE_AA)
            elif kind == 1:
                corners = np.array(centre) + rng.normal(0, size, (rng.integers(3, 6), 2))
                cv2.fillPoly(picture, [corners.astype(np.int32)], colour, cv2.LINE_AA)
            else:
                end = (
                    centre[0] + int(rng.normal(0, 2 * size)),
                    centre[1] + int(rng.normal(0, 2 * size)),
                )
                cv2.line(picture, centre, end, colour, max(2, size // 6), cv2.LINE_AA)
        write(
            picture,
            words(rng, 1)[:7].upper(),
            (columns // 14, rows // 8),
            columns / 7,
            random_colour(rng, 0, 90),
        )
        lines_of_text(
            picture[int(0.78 * rows) :], rng, max(5, rows // 45), random_colour(rng, 0, 70)
        )
        return framed(picture, columns // 70, random_colour(rng, 10, 90))

    return paint


def painting() -> Painter:
    """A landscape: sky, hills, trees, brush strokes, in a wooden frame."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        picture = landscape(rows, columns, rng)
        return framed(picture, max(3, int(0.018 * px_per_m)), (96, 62, 34))

    return paint


def window() -> Painter:
    """A window with bars and the landscape outside."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        picture = np.clip(landscape(rows, columns, rng).astype(np.float32) * 1.08, 0, 250).astype(
            np.uint8
        )
        bar = max(2, int(0.05 * px_per_m))
        cv2.line(picture, (columns // 2, 0), (columns // 2, rows), (205, 205, 200), bar)
        cv2.line(picture, (0, rows // 3), (columns, rows // 3), (205, 205, 200), bar // 2)
        return framed(picture, bar, (212, 212, 206))

    return paint


def whiteboard() -> Painter:
    """A white board with a diagram, formulas and smears."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        smear = octaves(rows, columns, [0.05 * px_per_m, 0.3 * px_per_m], rng)
        picture = as_image(flat(rows, columns, (228, 230, 232)) + 5 * smear[..., None])
        pens: list[Colour] = [(30, 40, 150), (160, 30, 40), (20, 110, 50), (30, 30, 34)]
        nodes = np.stack(
            [rng.uniform(0.08, 0.92, 12) * columns, rng.uniform(0.12, 0.88, 12) * rows], -1
        ).astype(int)
        stroke = max(2, int(0.006 * px_per_m))
        for a, b in pairwise(nodes):
            cv2.arrowedLine(
                picture, tuple(a), tuple(b), pens[rng.integers(4)], stroke, cv2.LINE_AA, 0, 0.06
            )
        for node in nodes:
            size = int(rng.uniform(0.04, 0.09) * px_per_m)
            cv2.circle(picture, tuple(node), size, (228, 230, 232), -1, cv2.LINE_AA)
            cv2.circle(picture, tuple(node), size, pens[rng.integers(4)], stroke, cv2.LINE_AA)
            write(
                picture,
                words(rng, 1)[:2],
                (node[0] - size // 2, node[1] + size // 3),
                0.7 * size,
                pens[3],
            )
        for _ in range(9):
            u, v = int(rng.uniform(0, 0.75) * columns), int(rng.uniform(0.1, 0.97) * rows)
            text = f"{words(rng, 1)} = {words(rng, 1)}^{rng.integers(2, 9)}/{words(rng, 1)[:3]}"
            write(picture, text, (u, v), 0.035 * px_per_m, pens[rng.integers(4)])
        return framed(picture, int(0.02 * px_per_m), (140, 142, 146))

    return paint


def rug(colour: Colour, second: Colour) -> Painter:
    """A patterned rug with a border and irregular figures."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        picture = np.ascontiguousarray(flat(rows, columns, colour))
        for _ in range(int(rows * columns / px_per_m**2 * 45)):
            centre = np.array([rng.uniform(0, columns), rng.uniform(0, rows)])
            angle = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 8)))
            reach = rng.uniform(0.02, 0.1) * px_per_m
            corners = centre + reach * np.stack([np.cos(angle), np.sin(angle)], -1)
            tone = np.array(second if rng.random() < 0.6 else random_colour(rng)) + rng.normal(
                0, 15, 3
            )
            cv2.fillPoly(picture, [corners.astype(np.int32)], tone.tolist(), cv2.LINE_AA)
        picture += 9 * octaves(rows, columns, [1, 2, 5], rng)[..., None]
        edge = int(0.08 * px_per_m)
        cv2.rectangle(picture, (edge, edge), (columns - edge, rows - edge), second, edge // 3)
        return as_image(picture)

    return paint


def patchwork(size_m: float = 0.03) -> Painter:
    """Square patches of cloth, each of a colour of its own."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        side = max(round(size_m * px_per_m), 1)
        patches = rng.uniform(30, 230, (rows // side + 1, columns // side + 1, 3))
        picture = patches.repeat(side, axis=0).repeat(side, axis=1)[:rows, :columns]
        return as_image(picture + 5 * field(rows, columns, (3, 3), rng)[..., None])

    return paint


def sign(text: str, colour: Colour = (240, 240, 236), ink: Colour = (30, 40, 60)) -> Painter:
    """A plate with a word."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        picture = canvas(rows, columns, colour, rng)
        unit_width = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 1.0, 1)[0][0] / 22
        height = min(0.5 * rows, 0.84 * columns / unit_width)
        write(picture, text, (int(0.08 * columns), int(0.5 * rows + height / 2)), height, ink)
        return framed(picture, max(1, rows // 30), ink)

    return paint


def label(colour: Colour | None = None) -> Painter:
    """A print around a bottle or a mug."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        picture = canvas(rows, columns, colour or random_colour(rng, 60, 235), rng)
        for share in (0.08, 0.55):
            write(
                picture,
                words(rng, 1)[:5],
                (int(share * columns), int(0.6 * rows)),
                0.32 * rows,
                random_colour(rng, 0, 120),
            )
        lines_of_text(picture[int(0.6 * rows) :], rng, max(3, rows // 14), (30, 30, 30))
        picture[: rows // 12] = random_colour(rng)
        return picture

    return paint
