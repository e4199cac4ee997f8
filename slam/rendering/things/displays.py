"""Painters of screens and keyboards."""

from __future__ import annotations

import string

import cv2
import numpy as np

from bmask_slam.graph.arrays import Image
from bmask_slam.rendering.engine.builder import Painter
from bmask_slam.rendering.things.drawing import (
    canvas,
    framed,
    landscape,
    random_colour,
    words,
    write,
)

_KEYS = tuple(string.ascii_uppercase + string.digits)


def desktop() -> Painter:
    """A computer's screen: windows with code, a picture, a bar of icons."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        picture = landscape(rows, columns, rng)
        for _ in range(3):
            h, w = int(rng.uniform(0.35, 0.65) * rows), int(rng.uniform(0.3, 0.55) * columns)
            v, u = (
                int(rng.uniform(0.04, 0.9) * (rows - h)),
                int(rng.uniform(0.02, 0.95) * (columns - w)),
            )
            dark = rng.random() < 0.6
            page = canvas(h, w, (30, 32, 40) if dark else (240, 240, 240), rng)
            line = max(5, rows // 42)
            for row in range(2 * line, h - line // 2, round(1.4 * line)):
                ink = random_colour(rng, 130, 255) if dark else random_colour(rng, 0, 120)
                indent = int(rng.integers(1, 5) * line)
                write(
                    page,
                    words(rng, int(rng.integers(1, 4)))[: max(1, (w - indent) // line)],
                    (indent, row),
                    0.7 * line,
                    ink,
                )
            cv2.rectangle(page, (0, 0), (w, line), (70, 110, 180), -1)
            cv2.circle(page, (w - line, line // 2), line // 3, (220, 80, 70), -1, cv2.LINE_AA)
            picture[v : v + h, u : u + w] = page
        bar = max(6, rows // 16)
        picture[-bar:] = (40, 44, 52)
        for u in range(bar // 4, columns - bar, round(1.2 * bar)):
            cv2.rectangle(
                picture,
                (u, rows - bar + 3),
                (u + bar - 7, rows - 4),
                random_colour(rng, 60, 255),
                -1,
            )
        return framed(picture, max(2, rows // 36), (18, 18, 20))

    return paint


def broadcast() -> Painter:
    """A television's screen: a news picture with a caption."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        picture = landscape(rows, columns, rng)
        cv2.rectangle(picture, (0, int(0.8 * rows)), (columns, int(0.93 * rows)), (170, 28, 34), -1)
        write(
            picture,
            "NEWS " + words(rng, 4),
            (columns // 30, int(0.89 * rows)),
            rows / 16,
            (245, 245, 245),
        )
        middle = (int(0.68 * columns), int(0.45 * rows))
        cv2.ellipse(
            picture,
            (middle[0], int(0.8 * rows)),
            (columns // 7, rows // 4),
            0,
            180,
            360,
            (40, 46, 90),
            -1,
        )
        cv2.ellipse(
            picture, middle, (columns // 22, rows // 9), 0, 0, 360, (224, 178, 150), -1, cv2.LINE_AA
        )
        return framed(picture, max(2, rows // 40), (14, 14, 16))

    return paint


def keys() -> Painter:
    """A keyboard from above."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        picture = canvas(rows, columns, (34, 34, 38), rng)
        lines, per_line = 5, 17
        for i in range(lines):
            v0, v1 = int((i + 0.25) * rows / (lines + 0.3)), int((i + 1.08) * rows / (lines + 0.3))
            u = columns * 0.02
            while u < columns * 0.95:
                wide = (
                    columns
                    / per_line
                    * (rng.choice([1, 1, 1, 1, 1.6, 2.2]) if i < 4 else rng.choice([1, 1.5, 5]))
                )
                wide = min(wide, columns * 0.98 - u)
                cv2.rectangle(picture, (int(u + 1), v0), (int(u + wide - 2), v1), (72, 72, 78), -1)
                letter = str(rng.choice(_KEYS))
                write(
                    picture,
                    letter,
                    (int(u + 0.3 * wide), int(v0 + 0.75 * (v1 - v0))),
                    0.5 * (v1 - v0),
                    (230, 230, 230),
                )
                u += wide
        return picture

    return paint
