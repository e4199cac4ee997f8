"""Painters of books, sheets and notice boards."""

from __future__ import annotations

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
from bmask_slam.rendering.things.prints import poster
from bmask_slam.rendering.things.surfaces import Colour, as_image, field, flat, octaves


def book_spine(colour: Colour | None = None) -> Painter:
    """The back of a book: title along it, bands, a publisher's mark."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        base = colour or random_colour(rng, 25, 215)
        ink = (240.0, 235.0, 215.0) if sum(base) < 400 else (25.0, 22.0, 30.0)
        picture = canvas(columns, rows, base, rng)
        write(picture, words(rng, 3), (rows // 9, int(columns * 0.68)), columns * 0.42, ink)
        band = random_colour(rng)
        for share in (0.03, 0.92):
            cv2.rectangle(
                picture, (int(share * rows), 0), (int((share + 0.03) * rows), columns), band, -1
            )
        picture[[0, -1]] = picture[[0, -1]] // 2
        return np.ascontiguousarray(picture.transpose(1, 0, 2)[:, ::-1])

    return paint


def book_cover(colour: Colour | None = None) -> Painter:
    """The front of a book."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        picture = canvas(rows, columns, colour or random_colour(rng, 40, 220), rng)
        height = columns / 8
        for k in range(3):
            write(
                picture,
                words(rng, 1),
                (columns // 10, int((1.6 + 1.3 * k) * height)),
                height,
                random_colour(rng),
            )
        cv2.circle(
            picture,
            (columns // 2, int(0.68 * rows)),
            columns // 4,
            random_colour(rng),
            -1,
            cv2.LINE_AA,
        )
        cv2.circle(
            picture,
            (int(columns * 0.58), int(0.62 * rows)),
            columns // 9,
            random_colour(rng),
            -1,
            cv2.LINE_AA,
        )
        return picture

    return paint


def pages() -> Painter:
    """The cut edge of a book's paper."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        along = (
            field(rows, columns, (40, 1.5), rng)
            if rows > columns
            else field(rows, columns, (1.5, 40), rng)
        )
        return as_image(flat(rows, columns, (226, 219, 198)) + 11 * along[..., None])

    return paint


def sheet() -> Painter:
    """A page of print with a figure."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        picture = canvas(rows, columns, (238, 238, 232), rng)
        lines_of_text(picture, rng, max(4, int(0.008 * px_per_m)), (40, 40, 48))
        u, v = int(rng.uniform(0.1, 0.4) * columns), int(rng.uniform(0.3, 0.6) * rows)
        w, h = int(0.45 * columns), int(0.25 * rows)
        picture[v : v + h, u : u + w] = landscape(h, w, rng)[: rows - v, : columns - u]
        return picture

    return paint


def notice_board() -> Painter:
    """Cork with pinned sheets."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        picture = as_image(
            flat(rows, columns, (172, 128, 82))
            + 20 * octaves(rows, columns, [2, 4, 9], rng)[..., None]
        )
        for _ in range(int(rows * columns / px_per_m**2 * 14)):
            h = int(rng.uniform(0.12, 0.3) * px_per_m)
            w = int(h * rng.uniform(0.65, 1.2))
            page = (sheet() if rng.random() < 0.6 else poster())(h, w, px_per_m, rng)
            turn = cv2.getRotationMatrix2D((w / 2, h / 2), rng.normal(0, 5), 1)
            u, v = rng.uniform(0, columns - 0.7 * w), rng.uniform(0, rows - 0.7 * h)
            turn[:, 2] += np.array((u, v))
            cv2.warpAffine(
                page, turn, (columns, rows), picture, cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT
            )
            pin = (int(u + w / 2), int(v + 0.06 * h))
            cv2.circle(
                picture, pin, max(2, int(0.006 * px_per_m)), random_colour(rng), -1, cv2.LINE_AA
            )
        return framed(picture, int(0.02 * px_per_m), (110, 74, 40))

    return paint
