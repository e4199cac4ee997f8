"""Printed and drawn things: posters, paintings, books, screens, keys, notices, views."""

from __future__ import annotations

import string

import cv2
import numpy as np

from slam.rendering.builder import Image, Painter
from slam.rendering.surfaces import Colour, as_image, field, flat, octaves

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


def _canvas(rows: int, columns: int, colour: Colour, rng: np.random.Generator) -> Image:
    return as_image(
        flat(rows, columns, colour) + 4 * octaves(rows, columns, [2, 20], rng)[..., None]
    )


def _framed(picture: Image, px: int, colour: Colour) -> Image:
    cv2.rectangle(
        picture, (0, 0), (picture.shape[1] - 1, picture.shape[0] - 1), colour, max(1, 2 * px)
    )
    return picture


def poster() -> Painter:
    """Bold shapes, a headline and small print."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        picture = _canvas(rows, columns, random_colour(rng, 120, 245), rng)
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
        return _framed(picture, columns // 70, random_colour(rng, 10, 90))

    return paint


def painting() -> Painter:
    """A landscape: sky, hills, trees, brush strokes, in a wooden frame."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        picture = landscape(rows, columns, rng)
        return _framed(picture, max(3, int(0.018 * px_per_m)), (96, 62, 34))

    return paint


def landscape(rows: int, columns: int, rng: np.random.Generator) -> Image:
    """A view with clouds, ridges, trees and houses (rows, columns, 3)."""
    share = np.linspace(0, 1, rows, dtype=np.float32)[:, None, None]
    picture = (1 - share) * np.float32([110, 160, 220]) + share * np.float32([220, 228, 235])
    clouds = np.clip(octaves(rows, columns, [columns / 4, columns / 9, columns / 25], rng), 0, 1.5)
    picture = picture + 45 * clouds[..., None]
    u = np.arange(columns)
    for k in range(4):
        ridge = (
            rows * (0.45 + 0.12 * k)
            + rows * 0.06 * field(1, columns, (1, columns / (3 + 4 * k)), rng)[0]
        )
        colour = np.float32([70 - 8 * k, 105 + 12 * k, 90 - 18 * k]) + rng.normal(0, 12, 3).astype(
            np.float32
        )
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


def window() -> Painter:
    """A window with bars and the landscape outside."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        picture = np.clip(landscape(rows, columns, rng).astype(np.float32) * 1.08, 0, 250).astype(
            np.uint8
        )
        bar = max(2, int(0.05 * px_per_m))
        cv2.line(picture, (columns // 2, 0), (columns // 2, rows), (205, 205, 200), bar)
        cv2.line(picture, (0, rows // 3), (columns, rows // 3), (205, 205, 200), bar // 2)
        return _framed(picture, bar, (212, 212, 206))

    return paint


def book_spine(colour: Colour | None = None) -> Painter:
    """The back of a book: title along it, bands, a publisher's mark."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        base = colour or random_colour(rng, 25, 215)
        ink = (240.0, 235.0, 215.0) if sum(base) < 400 else (25.0, 22.0, 30.0)
        picture = _canvas(columns, rows, base, rng)
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
        picture = _canvas(rows, columns, colour or random_colour(rng, 40, 220), rng)
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
        picture = _canvas(rows, columns, (238, 238, 232), rng)
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
            turn[:, 2] += u, v
            cv2.warpAffine(
                page, turn, (columns, rows), picture, cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT
            )
            pin = (int(u + w / 2), int(v + 0.06 * h))
            cv2.circle(
                picture, pin, max(2, int(0.006 * px_per_m)), random_colour(rng), -1, cv2.LINE_AA
            )
        return _framed(picture, int(0.02 * px_per_m), (110, 74, 40))

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
        for a, b in zip(nodes, nodes[1:], strict=False):
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
        return _framed(picture, int(0.02 * px_per_m), (140, 142, 146))

    return paint


def desktop() -> Painter:
    """What a computer shows: windows with code, a picture, a bar of icons."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        picture = landscape(rows, columns, rng)
        for _ in range(3):
            h, w = int(rng.uniform(0.35, 0.65) * rows), int(rng.uniform(0.3, 0.55) * columns)
            v, u = (
                int(rng.uniform(0.04, 0.9) * (rows - h)),
                int(rng.uniform(0.02, 0.95) * (columns - w)),
            )
            dark = rng.random() < 0.6
            page = _canvas(h, w, (30, 32, 40) if dark else (240, 240, 240), rng)
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
        return _framed(picture, max(2, rows // 36), (18, 18, 20))

    return paint


def broadcast() -> Painter:
    """What a television shows: a news picture with a caption."""

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
        return _framed(picture, max(2, rows // 40), (14, 14, 16))

    return paint


def keys() -> Painter:
    """A keyboard from above."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        picture = _canvas(rows, columns, (34, 34, 38), rng)
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
                letter = str(rng.choice(_LETTERS)).upper()
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


def sign(text: str, colour: Colour = (240, 240, 236), ink: Colour = (30, 40, 60)) -> Painter:
    """A plate with a word."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        picture = _canvas(rows, columns, colour, rng)
        unit_width = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 1.0, 1)[0][0] / 22
        height = min(0.5 * rows, 0.84 * columns / unit_width)
        write(picture, text, (int(0.08 * columns), int(0.5 * rows + height / 2)), height, ink)
        return _framed(picture, max(1, rows // 30), ink)

    return paint


def label() -> Painter:
    """A wrap-around label of a bottle or tin."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        base = random_colour(rng, 60, 235)
        picture = _canvas(rows, columns, base, rng)
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
