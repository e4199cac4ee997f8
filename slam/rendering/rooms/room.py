"""The shell of a room: floor, ceiling, walls, lamps."""

from __future__ import annotations

from dataclasses import dataclass

from bmask_slam.rendering.engine.builder import Painter, SceneBuilder
from bmask_slam.rendering.engine.lighting import Lighting
from bmask_slam.rendering.things.surfaces import plain, tiles


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


def ceiling_lamps(b: SceneBuilder, lighting: Lighting, height: float) -> None:
    """Luminous panels on the ceiling, where the light comes from."""
    white = plain((250, 250, 244), 2)
    for lamp in lighting.lamps:
        (x, y, _), (a, c) = lamp.centre, lamp.half_size
        b.quad((x - a, y - c, height - 0.02), (2 * a, 0, 0), (0, 2 * c, 0), white, 200, shines=True)
