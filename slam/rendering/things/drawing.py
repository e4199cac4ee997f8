"""Drawing helpers for printed things: words, colours, landscapes."""

from __future__ import annotations

import string

import cv2
import numpy as np

from bmask_slam.graph.arrays import Image
from bmask_slam.rendering.things.surfaces import Colour, as_image, field, flat, octaves

_LETTERS = np.array(list(string.ascii_letters + string.digits))


def random_colour(rng: np.random.Generator, low: int = 30, high: int = 230) -> Colour:
    """Any colour."""
    r, g, b = rng.integers(low, high, 3)
    return float(r), float(g), float(b)


def words(rng: np.random.Generator, count: int) -> str:
    """Invented words."""
    return " ".join("".join(rng.choice(_LETTERS, rng.integers(2, 8))) for _ in range(count))


def write(picture: Image, text: str, at: tuple[int, int], height_px: float, ink: Colour) -> None:
    """Letters ``height_px`` high, with their lower left at ``at`` (column, row)."""
    scale = height_px / 22
    thickness = max(1, round(height_px / 9))
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, scale, ink, thickness, cv2.LINE_AA)


def lines_of_text(picture: Image, rng: np.random.Generator, line_px: int, ink: Colour) -> None:
    """Fill a picture with lines of words, with indents and gaps."""
    rows, columns = picture.shape[:2]
    for v in range(2 * line_px, rows - line_px // 2, round(1.5 * line_px)):
        if rng.random() > 0.12:
            u = int(0.05 * columns + rng.integers(0, max(1, columns // 12)))
            room = max(1, int((columns * rng.uniform(0.4, 0.9) - u) / (line_px * 4)))
            write(picture, words(rng, room), (u, v), line_px * 0.75, ink)


def canvas(rows: int, columns: int, colour: Colour, rng: np.random.Generator) -> Image:
    return as_image(
        flat(rows, columns, colour) + 4 * octaves(rows, columns, [2, 20], rng)[..., None]
    )


def framed(picture: Image, px: int, colour: Colour) -> Image:
    cv2.rectangle(
        picture, (0, 0), (picture.shape[1] - 1, picture.shape[0] - 1), colour, max(1, 2 * px)
    )
    return picture


def landscape(rows: int, columns: int, rng: np.random.Generator) -> Image:
    """A view with clouds, ridges, trees and houses (rows, columns, 3)."""
    share = np.linspace(0, 1, rows, dtype=np.float32)[:, None, None]
    zenith, horizon = np.array((110.0, 160.0, 220.0)), np.array((220.0, 228.0, 235.0))
    picture = (1 - share) * zenith + share * horizon
    clouds = np.clip(octaves(rows, columns, [columns / 4, columns / 9, columns / 25], rng), 0, 1.5)
    picture = picture + 45 * clouds[..., None]
    u = np.arange(columns)
    for k in range(4):
        ridge = (
            rows * (0.45 + 0.12 * k)
            + rows * 0.06 * field(1, columns, (1, columns / (3 + 4 * k)), rng)[0]
        )
        colour = np.array([70 - 8 * k, 105 + 12 * k, 90 - 18 * k]) + rng.normal(0, 12, 3)
        below = np.arange(rows)[:, None] > ridge[None]
        ground = colour + 16 * octaves(rows, columns, [2, 5, 15], rng)[..., None]
        picture = np.where(below[..., None], ground, picture)
        for _ in range(14):
            x = int(rng.integers(columns))
            foot, size = int(ridge[u[x]]), int(rows * rng.uniform(0.03, 0.07) * (1 + 0.5 * k))
            tone = (colour * rng.uniform(0.45, 0.8)).tolist()
            if rng.random() < 0.3:
                wall = tuple(float(c) for c in rng.integers(120, 230, 3))
                cv2.rectangle(picture, (x, foot - size), (x + size, foot), wall, -1)
                roof = np.array(
                    [
                        [x - 3, foot - size],
                        [x + size + 3, foot - size],
                        [x + size // 2, foot - 2 * size],
                    ]
                )
                cv2.fillPoly(picture, [roof], (120, 50, 40), cv2.LINE_AA)
            else:
                tree = np.array(
                    [[x, foot - 2 * size], [x - size // 2, foot], [x + size // 2, foot]]
                )
                cv2.fillPoly(picture, [tree], tone, cv2.LINE_AA)
    return as_image(picture)
