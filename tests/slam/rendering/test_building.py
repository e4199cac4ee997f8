"""The rendered building: a walk in free space, rooms that look alike, textures stored once."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from bmask_slam.graph.arrays import Array, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.mapping.open3d_loader import load_open3d
from bmask_slam.rendering.engine import lighting
from bmask_slam.rendering.engine.builder import Part, SceneBuilder
from bmask_slam.rendering.engine.lighting import Lamp, Lighting, bake
from bmask_slam.rendering.engine.meshes import pose
from bmask_slam.rendering.engine.path import camera_poses, look_at
from bmask_slam.rendering.engine.raycast import Renderer
from bmask_slam.rendering.engine.scene import build_scene
from bmask_slam.rendering.rooms import building
from bmask_slam.rendering.rooms.building_parts import LENGTH_M, ROOMS, STOREY_M
from bmask_slam.rendering.things.surfaces import plain

BODY_M = 0.2
"""From the camera to whatever is nearest at its height."""


@pytest.fixture(scope="module")
def bare() -> SceneBuilder:
    """The building without light and pictures."""

    def unlit(parts: list[Part], *_: object) -> list[Part]:
        return parts

    def blank(builder: SceneBuilder, *_: object) -> Image:
        return np.zeros((4, 4, 3), np.uint8)

    builder = SceneBuilder(0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(building, "bake", unlit)
        patch.setattr(SceneBuilder, "_paint", blank)
        building.furnish(builder)
    return builder


@pytest.fixture(scope="module")
def poses() -> Array:
    return camera_poses(building.PATH, 30.0, 0)


def test_the_walk_is_long_and_ends_where_it_began(poses: Array) -> None:
    eyes = poses[:, :3, 3]
    steps_m = np.linalg.norm(np.diff(eyes, axis=0), axis=1)
    assert steps_m.sum() > 600 and len(poses) > 20_000
    assert 30 * steps_m.max() < 1.2  # a walking pace
    storeys, counts = np.unique(np.round((eyes[:, 2] - 1.45) / STOREY_M, 1), return_counts=True)
    assert (counts[np.isin(storeys, [0.0, 1.0, 2.0])] > 5000).all()
    assert (eyes[:, 0].min(), eyes[:, 0].max()) == pytest.approx((0, LENGTH_M), abs=5)
    begin = poses[:200]  # it was near the end's place, and looked the same way
    near = np.linalg.norm(begin[:, :3, 3] - eyes[-1], axis=1) < 1.0
    assert (begin[near, :3, 2] @ poses[-1, :3, 2]).max() > 0.95


def test_the_walk_touches_nothing(bare: SceneBuilder, poses: Array) -> None:
    """Rays along the walk, and to eight sides of it, meet no surface."""
    eyes = poses[::5, :3, 3]
    scene = lighting._scene(bare.parts)
    o3d = load_open3d()

    def blocked(origins: Array, towards: Array) -> Array:
        rays = np.concatenate(np.broadcast_arrays(origins, towards), axis=1).astype(np.float32)
        found: Array = scene.test_occlusions(o3d.core.Tensor(rays), tnear=0.0, tfar=1.0).numpy()
        return found

    assert not blocked(eyes[:-1], np.diff(eyes, axis=0)).any()
    for angle in np.arange(8) * np.pi / 4:
        side = BODY_M * np.array([np.cos(angle), np.sin(angle), 0.0])
        hit = blocked(eyes, side)
        assert not hit.any(), eyes[hit][:3]


def test_rooms_look_alike_but_for_what_hangs_there(bare: SceneBuilder) -> None:
    uses = Counter(id(part.texture) for part in bare.parts)
    shared = sum(count for count in uses.values() if count > 1)
    assert shared > 0.9 * len(bare.parts)
    assert len(uses) < 0.15 * len(bare.parts)
    once = sum(count == 1 for count in uses.values())
    assert once > 3 * 2 * ROOMS * 4  # posters, a picture, a case and a plate in each room at least
    assert len(bare.frames) == len(bare.categories) == max(part.instance for part in bare.parts)


def test_what_is_repeated_is_lit_and_stored_once_and_seen_twice() -> None:
    one = SceneBuilder(3)
    with one.at(pose(0, 0), "box"):
        one.box((0.4, 0.4, 0.4), plain((200, 120, 40)))
    lamps = Lighting((Lamp((0.0, -1.0, 2.0)),))
    one.parts = bake(one.parts, lamps, 0)
    assert bake(one.parts, lamps, 1) is one.parts
    both = SceneBuilder(4)
    for x in (-0.5, 0.5):
        with both.at(pose(x, 0)):
            both.repeat(one)
    assert both.categories == ["box", "box"]
    np.testing.assert_allclose([frame[0, 3] for frame in both.frames], [-0.5, 0.5])
    both.quad((-4, 4, 0), (8, 0, 0), (0, -8, 0), plain((90, 90, 90)), 20)
    scene = build_scene(both, lamps, [], 0)
    assert len(scene.atlas.sizes) == 7 == scene.first_moving_texture
    camera = Camera(160, 120, fx=131.25, fy=131.25, cx=79.5, cy=59.5)
    eye, target = np.array([[0.0, -1.2, 1.6]]), np.array([[0.0, 0.0, 0.1]])
    view = Renderer(camera, scene.atlas, scene.static).render(look_at(eye, target)[0])
    assert set(np.unique(view.instances)) == {0, 1, 2}
    sides = [_mean_colour(view.rgb, view.instances == k) for k in (1, 2)]
    np.testing.assert_allclose(*sides, rtol=0.1)
    assert min(sides[0]) > 5


def _mean_colour(rgb: Image, mask: Array) -> Array:
    colour: Array = rgb[mask.astype(bool)].mean(axis=0)
    return colour
