"""Procedural materials that never repeat: plaster, wood, carpet, brick, fabric.

Each function returns a painter, see ``builder.Painter``. All are sums of smooth random fields of
several cell sizes, so that corners exist at every scale a detector looks at.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Floats, Image
from bmask_slam.rendering.engine.builder import Painter

Colour = tuple[float, ...]
"""Red, green, blue in [0, 255]."""


def field(rows: int, columns: int, cell: tuple[float, float], rng: np.random.Generator) -> Floats:
    """A smooth random field (rows, columns), about normal, ``cell`` (v, u) texels a wave."""
    coarse = [
        max(2, round(n / max(c, 1.0)) + 1) for n, c in zip((rows, columns), cell, strict=True)
    ]
    values = rng.standard_normal(coarse, dtype=np.float32)
    if (coarse[0], coarse[1]) == (rows + 1, columns + 1):
        return values[:rows, :columns]
    smooth = cv2.resize(values, (columns, rows), interpolation=cv2.INTER_CUBIC)
    return np.asarray(smooth, np.float32)


def octaves(rows: int, columns: int, cells_px: list[float], rng: np.random.Generator) -> Floats:
    """The sum of smooth fields of the given cell sizes in texels, of unit variance."""
    total = sum(field(rows, columns, (c, c), rng) for c in cells_px)
    return np.asarray(total, np.float32) / np.float32(np.sqrt(len(cells_px)))


def flat(rows: int, columns: int, colour: Colour) -> Floats:
    """A float32 picture of one colour."""
    return np.broadcast_to(np.asarray(colour, np.float32), (rows, columns, 3)).copy()


def as_image(picture: NDArray[np.floating]) -> Image:
    """Clip to the 8-bit range."""
    return np.clip(picture + 0.5, 0, 255).astype(np.uint8)


def plain(colour: Colour, grain: float = 7.0) -> Painter:
    """Painted or moulded material: nearly one colour, with wear marks."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        shade = grain * octaves(rows, columns, [2, 6, 0.03 * px_per_m, 0.15 * px_per_m], rng)
        marks = field(rows, columns, (0.012 * px_per_m, 0.012 * px_per_m), rng) > 2.3
        return as_image(flat(rows, columns, colour) + (shade - 3.5 * grain * marks)[..., None])

    return paint


def plaster(colour: Colour, stains: float = 1.0) -> Painter:
    """A wall: rough, with stains, chips and scuffs of every size."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        cells = [c * px_per_m for c in (0.006, 0.02, 0.08, 0.4)]
        shade = 6 * octaves(rows, columns, cells, rng)
        picture = flat(rows, columns, colour) + shade[..., None]
        for cell, threshold, depth in ((0.012, 2.1, 45), (0.035, 2.2, 35), (0.11, 2.1, 25)):
            spots = field(rows, columns, (cell * px_per_m, cell * px_per_m), rng)
            tint = rng.uniform(0.6, 1.0, 3).astype(np.float32)
            picture -= stains * depth * np.clip((spots - threshold) * 4, 0, 1)[..., None] * tint
        return as_image(picture)

    return paint


def wallpaper(colour: Colour, ink: Colour) -> Painter:
    """Paper with brushed dabs scattered at random, no two alike."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        picture = (
            flat(rows, columns, colour) + 5 * octaves(rows, columns, [3, 30, 200], rng)[..., None]
        )
        picture = np.ascontiguousarray(picture)
        for _ in range(int(rows * columns / px_per_m**2 * 90)):
            centre = (int(rng.integers(columns)), int(rng.integers(rows)))
            axes = tuple(int(a) for a in rng.uniform(0.006, 0.03, 2) * px_per_m)
            tone = np.array(ink) + rng.normal(0, 18, 3)
            cv2.ellipse(
                picture, centre, axes, rng.uniform(0, 180), 0, 360, tone.tolist(), -1, cv2.LINE_AA
            )
        return as_image(picture)

    return paint


def wood(colour: Colour, contrast: float = 1.0) -> Painter:
    """Sawn wood with its grain along the longer side, with knots and pores."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        upright = rows > columns
        h, w = (columns, rows) if upright else (rows, columns)
        across = np.linspace(0, h / px_per_m, h, dtype=np.float32)[:, None]
        warp = 0.02 * field(h, w, (0.1 * px_per_m, 0.35 * px_per_m), rng)
        warp += 0.004 * field(h, w, (0.02 * px_per_m, 0.1 * px_per_m), rng)
        rings = np.sin(2 * np.pi * (across + warp) / rng.uniform(0.018, 0.03))
        pores = field(h, w, (1.5, 0.02 * px_per_m), rng)
        knots = np.clip(field(h, w, (0.03 * px_per_m, 0.05 * px_per_m), rng) - 2.3, 0, 0.5)
        shade = 10 * rings + 7 * pores + 6 * octaves(h, w, [2, 40], rng) - 130 * knots
        shade = shade.T if upright else shade
        return as_image(flat(rows, columns, colour) * (1 + contrast * shade / 160)[..., None])

    return paint


def planks(colour: Colour, width_m: float = 0.12) -> Painter:
    """A parquet floor of planks of different tone and length."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        picture = np.zeros((rows, columns, 3), np.uint8)
        step, v = round(width_m * px_per_m), 0
        while v < rows:
            u = -int(rng.uniform(0, 0.8) * px_per_m)
            while u < columns:
                length = int(rng.uniform(0.5, 1.3) * px_per_m)
                tone = np.array(colour) * rng.uniform(0.72, 1.2) + rng.normal(0, 5, 3)
                plank = wood(tuple(tone), 1.2)(step, length, px_per_m, rng)
                plank[:2], plank[:, :2] = plank[:2] // 3, plank[:, :2] // 3
                area = picture[v : v + step, max(u, 0) : max(u + length, 0)]
                area[:] = plank[: area.shape[0], max(-u, 0) : max(-u, 0) + area.shape[1]]
                u += length
            v += step
        return picture

    return paint


def carpet(colour: Colour, fleck: Colour) -> Painter:
    """Short pile with coloured flecks and trodden patches."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        cells = [1, 3, 0.02 * px_per_m, 0.1 * px_per_m, 0.6 * px_per_m]
        picture = flat(rows, columns, colour) + 13 * octaves(rows, columns, cells, rng)[..., None]
        for cell, threshold in ((0.01, 1.6), (0.03, 1.7), (0.1, 1.9)):
            spots = field(rows, columns, (cell * px_per_m, cell * px_per_m), rng)
            share = np.clip((spots - threshold) * 3, 0, 0.8)[..., None]
            tone = np.float32(np.array(fleck) + rng.normal(0, 15, 3))
            picture += share * (tone - picture)
        return as_image(picture)

    return paint


def bricks(colour: Colour, mortar: Colour = (188, 182, 170)) -> Painter:
    """A brick wall, each brick with its own tone, chips and edges."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        noise = octaves(rows, columns, [2, 5, 15], rng)
        picture = flat(rows, columns, mortar) + 12 * noise[..., None]
        height, length, gap = (max(1, round(m * px_per_m)) for m in (0.075, 0.22, 0.01))
        for course, v in enumerate(range(0, rows, height)):
            for u in range(
                -(course % 2) * length // 2 - int(rng.integers(gap + 1)), columns, length
            ):
                tone = np.float32(np.array(colour) * rng.uniform(0.6, 1.25) + rng.normal(0, 8, 3))
                top, bottom, left, right = rng.integers(0, gap + 1, 4) // (1, 2, 1, 2)
                rows_of = slice(v + top, v + height - gap + bottom)
                columns_of = slice(max(u + left, 0), max(u + length - gap + right, 0))
                area = rows_of, columns_of
                picture[area] = tone + 14 * noise[area][..., None]
        chips = field(rows, columns, (0.012 * px_per_m, 0.012 * px_per_m), rng) > 2.2
        picture[chips] *= 0.65
        return as_image(picture)

    return paint


def tiles(colour: Colour, size_m: float = 0.3, veins: float = 1.0) -> Painter:
    """Stone tiles, each cut from its own slab, with dark joints."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        step = max(4, round(size_m * px_per_m))
        tones = rng.normal(0, 11, (rows // step + 1, columns // step + 1))
        tone = tones.repeat(step, 0).repeat(step, 1)[:rows, :columns]
        cells = [c * px_per_m for c in (0.25, 0.06, 0.02)]
        distance = np.abs(octaves(rows, columns, cells, rng))
        shade = tone + 7 * octaves(rows, columns, [1.5, 6, 25], rng)
        shade -= 45 * veins * np.clip(0.12 - distance, 0, 0.12) / 0.12
        specks = field(rows, columns, (0.008 * px_per_m, 0.008 * px_per_m), rng)
        shade += 40 * np.clip(specks - 2.0, 0, 1) - 50 * np.clip(-specks - 1.9, 0, 1)
        joint = (np.arange(rows)[:, None] % step < 3) | (np.arange(columns)[None] % step < 3)
        shade[joint] -= 55
        return as_image(flat(rows, columns, colour) + shade[..., None])

    return paint


def fabric(colour: Colour, second: Colour | None = None) -> Painter:
    """Woven cloth; with a second colour, irregular tartan stripes."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        picture = flat(rows, columns, colour)
        if second is not None:
            for axis, n in ((0, rows), (1, columns)):
                stripes = np.clip(field(1, n, (1, 0.02 * px_per_m), rng)[0] * 0.8, 0, 0.8)
                share = stripes[:, None, None] if axis == 0 else stripes[None, :, None]
                picture = picture + share * (np.asarray(second, np.float32) - picture)
        weave = field(rows, columns, (1, 5), rng) + field(rows, columns, (5, 1), rng)
        lint = field(rows, columns, (0.01 * px_per_m, 0.01 * px_per_m), rng)
        shade = 5 * weave + 6 * octaves(rows, columns, [0.03 * px_per_m, 0.12 * px_per_m], rng)
        return as_image(picture + (shade + 35 * np.clip(lint - 1.9, 0, 1))[..., None])

    return paint


def leaf(colour: Colour) -> Painter:
    """A leaf's blade with its ribs."""

    def paint(rows: int, columns: int, px_per_m: float, rng: np.random.Generator) -> Image:
        v, u = np.mgrid[:rows, :columns].astype(np.float32)
        middle = np.abs(u - columns / 2)
        ribs = np.sin((v - middle * 0.8) / rows * 2 * np.pi * 5) > 0.86
        shade = (
            12 * octaves(rows, columns, [2, 8, 25], rng)
            + 22 * ribs
            + 30 * (middle < 0.04 * columns)
        )
        return as_image(flat(rows, columns, colour) * rng.uniform(0.75, 1.2) + shade[..., None])

    return paint
