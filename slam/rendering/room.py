"""The shell of a room: floor, ceiling, walls, lamps."""

from __future__ import annotations

from dataclasses import dataclass

from slam.rendering.builder import Painter, SceneBuilder
from slam.rendering.surfaces import plain, tiles


@dataclass(frozen=True)
class Room:
    """A box from the origin to (width, depth, height) in metres."""

    width: float
    depth: float
    height: float


def shell(
    b: SceneBuilder, room: Room, floor: Painter, walls: dict[str, Painter], px_per_m: float = 420
) -> None:
    """Add floor, ceiling and the walls south (y = 0), north, west (x = 0) and east."""
    w, d, h = room.width, room.depth, room.height
    b.quad((0, d, 0), (w, 0, 0), (0, -d, 0), floor, px_per_m)
    b.quad((0, 0, h), (w, 0, 0), (0, d, 0), tiles((205, 205, 200), 0.6, 0.3), 250)
    b.quad((0, d, h), (w, 0, 0), (0, 0, -h), walls["north"], px_per_m)
    b.quad((w, 0, h), (-w, 0, 0), (0, 0, -h), walls["south"], px_per_m)
    b.quad((0, 0, h), (0, d, 0), (0, 0, -h), walls["west"], px_per_m)
    b.quad((w, d, h), (0, -d, 0), (0, 0, -h), walls["east"], px_per_m)


def ceiling_lamp(b: SceneBuilder, x: float, y: float, height: float) -> None:
    """A flat luminous panel below the ceiling."""
    white = plain((250, 250, 244), 2)
    b.quad((x - 0.5, y - 0.15, height - 0.02), (1.0, 0, 0), (0, 0.3, 0), white, 200, shines=True)
