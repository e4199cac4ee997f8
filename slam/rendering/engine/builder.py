"""Collects the textured, labelled surfaces of a scene while it is furnished."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from bmask_slam.graph.arrays import Array, Image
from bmask_slam.rendering.engine.meshes import Shape, between, box_faces, ellipsoid, lathe, quad

Painter = Callable[[int, int, float, np.random.Generator], Image]
"""A texture maker: (rows, columns, texels per metre, random numbers) -> (rows, columns, 3) RGB."""

UNLABELLED = ""
"""The class of an instance that is in no annotation."""


@dataclass(frozen=True)
class Part:
    """One textured surface.

    Attributes:
        shape: its triangles in the world frame.
        texture: (H, W, 3) uint8 RGB albedo, or radiance if it shines.
        instance: id of the object it belongs to, 0 for background.
        flat: whether the triangles are one parallelogram over the whole texture.
        shines: emits light itself (screens, windows, lamps).
        light: (T, 3) light at the corners of the triangles once it is baked, None before.
    """

    shape: Shape
    texture: Image
    instance: int
    flat: bool
    shines: bool
    light: Array | None = None


class SceneBuilder:
    """A room being furnished: everything added takes the current object's pose and instance.

    Instance ids count from 1 in order of creation; ``categories[id - 1]`` is the class name and
    ``frames[id - 1]`` the pose T_world_object.
    """

    def __init__(self, seed: int, detail: float = 1.0) -> None:
        """``detail`` scales the number of texels per metre of everything."""
        self.detail = detail
        self.rng = np.random.default_rng(seed)
        self.parts: list[Part] = []
        self.categories: list[str] = []
        self.frames: list[Array] = []
        self._T_world_object: Array = np.eye(4)
        self._instance = 0

    @contextmanager
    def at(self, T_object: Array, category: str | None = None) -> Iterator[None]:
        """Add things in a frame relative to the current one; with a class, as a new instance."""
        before = self._T_world_object, self._instance
        self._T_world_object = self._T_world_object @ T_object
        if category is not None:
            self.categories.append(category)
            self.frames.append(self._T_world_object)
            self._instance = len(self.categories)
        try:
            yield
        finally:
            self._T_world_object, self._instance = before

    def quad(
        self, origin: ArrayLike, edge_u: ArrayLike, edge_v: ArrayLike, painter: Painter,
        px_per_m: float = 700.0, shines: bool = False,
    ) -> None:  # fmt: skip
        """Add a parallelogram (see ``meshes.quad``) painted at the given texel density."""
        u, v = np.asarray(edge_u, float), np.asarray(edge_v, float)
        texture = self._paint(painter, float(np.linalg.norm(u)), float(np.linalg.norm(v)), px_per_m)
        shape = quad(np.asarray(origin, float), u, v).moved(self._T_world_object)
        self.parts.append(Part(shape, texture, self._instance, flat=True, shines=shines))

    def box(
        self, size: ArrayLike, painter: Painter, centre: ArrayLike = (0, 0, 0),
        faces: dict[str, Painter] | None = None, px_per_m: float = 700.0,
    ) -> None:  # fmt: skip
        """Add a box standing on ``centre``; single faces may have painters of their own."""
        for name, (origin, u, v) in box_faces(np.asarray(size, float)).items():
            paint = (faces or {}).get(name, painter)
            self.quad(origin + np.asarray(centre, float), u, v, paint, px_per_m)

    def lathe(
        self, profile: ArrayLike, painter: Painter, centre: ArrayLike = (0, 0, 0),
        segments: int = 20, px_per_m: float = 700.0,
    ) -> None:  # fmt: skip
        """Add a surface of revolution, (radius, height) pairs from below, about a vertical axis."""
        points = np.asarray(profile, float)
        T = np.eye(4)
        T[:3, 3] = centre
        height = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
        width = float(2 * np.pi * points[:, 0].max())
        self.solid(lathe(points, segments).moved(T), painter, (width, height), px_per_m)

    def rod(self, p: ArrayLike, q: ArrayLike, radius: float, painter: Painter) -> None:
        """Add a closed cylinder between two points."""
        p, q = np.asarray(p, float), np.asarray(q, float)
        length = float(np.linalg.norm(q - p))
        eps = min(0.15 * radius, 0.01)
        profile = [
            (0, 0),
            (radius - eps, 0),
            (radius, eps),
            (radius, length - eps),
            (radius - eps, length),
            (0, length),
        ]
        shape = lathe(np.array(profile), 12).moved(between(p, q))
        self.solid(shape, painter, (2 * np.pi * radius, length), 700.0)

    def ball(self, centre: ArrayLike, radii: tuple[float, float, float], painter: Painter) -> None:
        """Add an ellipsoid with the given half axes."""
        T = np.eye(4)
        T[:3, 3] = centre
        size = (2 * np.pi * max(radii[:2]), np.pi * max(radii))
        self.solid(ellipsoid(radii).moved(T), painter, size, 600.0)

    def solid(
        self, shape: Shape, painter: Painter, size_m: tuple[float, float], px_per_m: float
    ) -> None:
        """Add any other shape, given the width and height in metres that its texture covers."""
        texture = self._paint(painter, size_m[0], size_m[1], px_per_m)
        shape = shape.moved(self._T_world_object)
        self.parts.append(Part(shape, texture, self._instance, flat=False, shines=False))

    def repeat(self, other: SceneBuilder) -> None:
        """Add all of another builder, whose light is baked: as new instances of the same look.

        However often it is repeated, its textures are stored once (see ``scene.build_scene``).
        """
        first, T = len(self.categories), self._T_world_object
        self.categories += other.categories
        self.frames += [T @ frame for frame in other.frames]
        for part in other.parts:
            instance = part.instance + first if part.instance else self._instance
            moved = replace(part, shape=part.shape.moved(T), instance=instance)
            self.parts.append(moved)

    def _paint(self, painter: Painter, width_m: float, height_m: float, px_per_m: float) -> Image:
        px_per_m *= self.detail
        rows, columns = (max(4, round(m * px_per_m)) for m in (height_m, width_m))
        return painter(rows, columns, px_per_m, np.random.default_rng(self.rng.integers(2**63)))
