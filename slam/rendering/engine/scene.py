"""A furnished, lit scene that is ready to be drawn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.rendering.engine.atlas import Atlas, build_atlas
from bmask_slam.rendering.engine.builder import Part, SceneBuilder
from bmask_slam.rendering.engine.lighting import Lighting, bake
from bmask_slam.rendering.engine.raycast import Geometry, build_geometry


@dataclass(frozen=True)
class Scene:
    """Everything that the renderer needs of a scene.

    Attributes:
        atlas: every texture, those of moving things last.
        static: the room.
        categories: class name of each instance id, counting from 1.
        moving: parts that move, in frames of their own; empty without people.
        first_moving_texture: index in the atlas of the first part in ``moving``.
    """

    atlas: Atlas
    static: Geometry
    categories: tuple[str, ...]
    moving: tuple[Part, ...]
    first_moving_texture: int


def build_scene(builder: SceneBuilder, lighting: Lighting, moving: list[Part], seed: int) -> Scene:
    """Bake the light and pack the textures, those of repeated parts once."""
    parts = bake(builder.parts, lighting, seed)
    places: dict[int, int] = {}  # in the atlas, by the identity of the array
    rows = [places.setdefault(id(part.texture), len(places)) for part in parts]
    textures = list({id(part.texture): part.texture for part in parts}.values())
    atlas = build_atlas(textures + [part.texture for part in moving])
    static = assemble(parts, np.array(rows))
    return Scene(atlas, static, tuple(builder.categories), tuple(moving), len(textures))


def assemble(parts: list[Part], textures: Ints) -> Geometry:
    """One geometry of lit parts with these textures (N,) of the atlas."""
    counts = [len(part.shape.corners) for part in parts]
    return build_geometry(
        np.concatenate([part.shape.corners for part in parts]),
        np.concatenate([part.shape.uvs for part in parts]),
        np.concatenate([_light(part) for part in parts]),
        np.repeat(textures, counts),
        np.repeat([part.instance for part in parts], counts),
    )


def _light(part: Part) -> Array:
    """The light (T, 3) of a part that is lit."""
    assert part.light is not None
    return part.light
