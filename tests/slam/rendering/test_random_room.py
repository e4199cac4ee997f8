"""Random rooms: determined by the seed, without intersections, with every class."""

from __future__ import annotations

import json
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pytest

from bmask_slam.graph.arrays import Image
from bmask_slam.rendering.annotations import CLASSES
from bmask_slam.rendering.config import RenderConfig
from bmask_slam.rendering.engine.builder import Painter, SceneBuilder
from bmask_slam.rendering.engine.meshes import pose
from bmask_slam.rendering.engine.path import camera_poses
from bmask_slam.rendering.rooms.random_furniture import add_piece
from bmask_slam.rendering.rooms.random_layout import distance_m, moved_rect, overlap, wall_poses
from bmask_slam.rendering.rooms.random_room import RandomRoom, draw_room
from bmask_slam.rendering.rooms.room import Room
from bmask_slam.rendering.sequence import render_sequence
from bmask_slam.rendering.things.people import Person, add_people


@pytest.fixture(scope="module")
def rooms() -> list[RandomRoom]:
    return [draw_room(seed) for seed in range(20)]


class _Bare(SceneBuilder):
    """A builder without textures, for speed; it draws the same random numbers."""

    def _paint(self, painter: Painter, width_m: float, height_m: float, px_per_m: float) -> Image:
        self.rng.integers(2**63)
        return np.zeros((4, 4, 3), np.uint8)


class _Listing(SceneBuilder):
    """A builder that only lists instances; it draws the same random numbers."""

    def _skip(self, *_: object, **__: object) -> None:
        self.rng.integers(2**63)

    quad = lathe = rod = ball = solid = _skip  # type: ignore[assignment]


def _built(seed: int) -> SceneBuilder:
    builder = _Bare(seed)
    draw_room(seed).furnish(builder)
    return builder


def test_rooms_depend_on_the_seed_only() -> None:
    first, again, other = (_built(seed) for seed in (5, 5, 6))
    assert first.categories == again.categories != other.categories
    assert len(first.parts) == len(again.parts)
    for a, b in zip(first.parts, again.parts, strict=True):
        np.testing.assert_array_equal(a.shape.corners, b.shape.corners)
    np.testing.assert_array_equal(draw_room(5).path.eyes_world, draw_room(5).path.eyes_world)
    assert draw_room(5).roles == draw_room(5).roles


def test_a_seed_gives_the_same_pictures() -> None:
    pictures = []
    for _ in range(2):
        builder = SceneBuilder(5, detail=0.1)
        draw_room(5).furnish(builder)
        pictures.append([part.texture for part in builder.parts])
    for a, b in zip(*pictures, strict=True):
        np.testing.assert_array_equal(a, b)


def test_footprints_lie_in_the_room_and_apart(rooms: list[RandomRoom]) -> None:
    for room in rooms:
        layout = room.layout
        groups = [piece.rects_world for piece in layout.pieces]
        groups += [(rect,) for rect in layout.kept_free]
        for one, two in combinations(groups, 2):
            assert not any(overlap(a, b) for a in one for b in two)
        all_rects = np.array([rect for group in groups for rect in group])
        assert all_rects[:, :2].min() > -1e-6
        assert (all_rects[:, 2:] < (layout.room.width + 1e-6, layout.room.depth + 1e-6)).all()


def test_furniture_stays_on_its_footprint() -> None:
    """Every corner of an object is above its footprint."""
    for seed in range(4):
        layout = draw_room(seed).layout
        for piece in layout.pieces:
            builder = _Bare(seed)
            with builder.at(piece.T_world_piece):
                add_piece(builder, piece.kind)
            corners = np.concatenate([part.shape.corners.reshape(-1, 3) for part in builder.parts])
            away = np.min([distance_m(r, corners[:, :2]) for r in piece.rects_world], axis=0)
            assert away.max() < 0.1, piece.kind.name
            low, high = corners.min(0), corners.max(0)
            assert low.min() > -0.06, piece.kind.name
            size = (layout.room.width, layout.room.depth, layout.room.height)
            assert (high < np.array(size) + 0.06).all(), piece.kind.name


def test_the_camera_keeps_half_a_metre_from_everything(rooms: list[RandomRoom]) -> None:
    for seed, room in enumerate(rooms):
        T = camera_poses(room.path, 10.0, seed)
        xy = T[:, :2, 3]
        rects = [rect for piece in room.layout.pieces for rect in piece.rects_world]
        assert min(distance_m(rect, xy).min() for rect in rects + room.layout.kept_free) > 0.5
        size = np.array([room.layout.room.width, room.layout.room.depth])
        assert xy.min() > 0.5 and (xy < size - 0.5).all()
        assert T[:, 2, 3].min() > 0.95 and T[:, 2, 3].max() < 1.8


def test_the_camera_views_every_wall(rooms: list[RandomRoom]) -> None:
    for seed, room in enumerate(rooms):
        T = camera_poses(room.path, 10.0, seed)
        # From rest within a second: half a second is missing at the end.
        assert np.linalg.norm(T[-1, :3, 3] - T[0, :3, 3]) < 0.5 * room.path.speed_m_s + 0.05
        bearing = np.rad2deg(np.arctan2(T[:, 1, 2], T[:, 0, 2]))
        assert (np.histogram(bearing, 12, (-180, 180))[0] > 0).all()


def test_every_class_occurs(rooms: list[RandomRoom]) -> None:
    found: list[str] = []
    for seed in range(30):
        listing = _Listing(seed)
        draw_room(seed).furnish(listing)
        found += listing.categories
        if seed == 0:
            assert found == _built(seed).categories
    counts = {name: found.count(name) for name in CLASSES}
    assert set(found) <= set(CLASSES)
    assert min(n for name, n in counts.items() if name != "person") >= 10, counts
    builder = _Bare(0)
    add_people(builder, rooms[0].roles, rooms[0].lighting, rooms[0].path)
    assert "person" in builder.categories


def test_people_do_not_intersect_furniture_and_face_the_desk(rooms: list[RandomRoom]) -> None:
    seats = 0
    for room in rooms:
        assert len(room.roles) >= 2
        desks = [p.rects_world[0] for p in room.layout.pieces if p.kind.name == "workplace"]
        for role in room.roles:
            bones = Person(role, 0.0, 1.0).bones(1.0)
            body = bones["torso"][:3, 3]
            others = [r for p in room.layout.pieces for r in p.rects_world]
            if role.action == "sit":
                ahead = (body[:2] - 0.6 * bones["torso"][:2, 1])[None]
                seats += 1
                assert min(distance_m(desk, ahead)[0] for desk in desks) == 0.0
            else:
                assert min(distance_m(r, body[None, :2])[0] for r in others) > 0.15
    assert seats >= 20


def test_wall_frames_look_into_the_room() -> None:
    room = Room(5.0, 4.0, 2.5)
    for T, length in zip(wall_poses(room), (5.0, 4.0, 5.0, 4.0), strict=True):
        x, y = (T @ pose(length / 2, -0.1))[:2, 3]
        assert min(x, 5 - x, y, 4 - y) == pytest.approx(0.1)
        assert (T @ pose(length, 0))[:2, 3] == pytest.approx(T[:2, 3] + length * T[:2, 0])
        assert 0 <= (T @ pose(length, 0))[0, 3] <= 5.0 + 1e-9


def test_corners_of_a_rotated_rectangle() -> None:
    assert moved_rect((0, 0, 2, 1), pose(10, 20, 0, 90)) == pytest.approx((9, 20, 10, 22))
    points = np.array([[0.5, 0.5], [2.0, 0.5], [4.0, 5.0]])
    np.testing.assert_allclose(distance_m((0, 0, 1, 1), points), [0, 1, 5])


def test_a_frame_shows_labelled_furniture(tmp_path: Path) -> None:
    config = RenderConfig("room", frames=2, width=96, height=72, people=1, seed=2, fps=0.5)
    folder = render_sequence(config, tmp_path / "room")
    marks = json.loads((folder / "annotations.json").read_text())["annotations"]
    assert {mark["image_id"] for mark in marks} == {1, 2}
    assert max(mark["area"] for mark in marks) > 100
    depth = cv2.imread(str(folder / "depth" / "0.000000.png"), cv2.IMREAD_UNCHANGED) / 5000
    assert 0.5 < np.median(depth[depth > 0]) < 5.0
