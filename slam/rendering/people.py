"""People who stand, sit, walk and carry things."""

from __future__ import annotations

from dataclasses import dataclass, field

from slam.rendering.builder import Part, SceneBuilder
from slam.rendering.raycast import Geometry
from slam.rendering.scene import Scene


@dataclass(frozen=True)
class Role:
    """Stub."""


@dataclass(frozen=True)
class Cast:
    """Stub."""

    parts: list[Part] = field(default_factory=list)

    def geometry(self, time_s: float, scene: Scene) -> Geometry:
        raise NotImplementedError


def hire(b: SceneBuilder, roles: tuple[Role, ...], count: int, seed: int) -> Cast:
    return Cast()
