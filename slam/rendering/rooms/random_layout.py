"""Layout of a random room: footprints that do not overlap and keep off the camera's path."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.rendering.engine.meshes import pose
from bmask_slam.rendering.rooms.room import Room

Rect = tuple[float, float, float, float]
"""x and y of the lower corner, then of the upper one, in metres."""

_GAP_M = 0.04
_CAMERA_GAP_M = 0.58
_TRIES = 120


@dataclass(frozen=True)
class Kind:
    """A kind of furniture in a frame whose back is at y = 0 and whose front looks along -y.

    Attributes:
        name: what it is.
        rects: footprints in metres, those of chairs that belong to it included.
        height_m: height up to which it hides the wall behind it.
        focus_m: height at which the camera looks at it.
        width_m: its own width, for kinds of several widths.
    """

    name: str
    rects: tuple[Rect, ...]
    height_m: float
    focus_m: float
    width_m: float = 0.0


@dataclass(frozen=True)
class Piece:
    """A piece of furniture at its pose."""

    kind: Kind
    T_world_piece: Array
    rects_world: tuple[Rect, ...]


@dataclass(frozen=True)
class Hanging:
    """A thing on a wall, (width, height) in metres, its frame in the middle of its lower edge."""

    name: str
    T_world_hanging: Array
    size_m: tuple[float, float]


def moved_rect(rect: Rect, T_a_b: Array) -> Rect:
    """The upright rectangle in frame a around a rectangle in frame b."""
    x0, y0, x1, y1 = rect
    corners = np.array([[x0, y0], [x0, y1], [x1, y0], [x1, y1]]) @ T_a_b[:2, :2].T + T_a_b[:2, 3]
    (ax, ay), (bx, by) = corners.min(0).tolist(), corners.max(0).tolist()
    return ax, ay, bx, by


def overlap(a: Rect, b: Rect, gap_m: float = 0.0) -> bool:
    """Whether two rectangles come nearer than ``gap_m`` along both axes."""
    return bool(
        a[0] < b[2] + gap_m and b[0] < a[2] + gap_m and a[1] < b[3] + gap_m and b[1] < a[3] + gap_m
    )


def distance_m(rect: Rect, points: Array) -> Array:
    """Distances (N,) of points (N, 2) from a rectangle, 0 inside."""
    low, high = np.array(rect[:2]), np.array(rect[2:])
    return np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0), axis=1)


def wall_poses(room: Room) -> tuple[Array, ...]:
    """Frames T_world_wall of north, east, south and west: x to the right, -y into the room."""
    w, d = room.width, room.depth
    return pose(0, d, 0, 0), pose(w, d, 0, -90), pose(w, 0, 0, 180), pose(0, 0, 0, 90)


@dataclass
class Layout:
    """A room while it is furnished: each thing gets a free place by random trials, or none.

    Attributes:
        room: its size.
        path_world: (N, 2) floor points of the camera's path; everything keeps away from it.
        rng: random numbers of all choices.
    """

    room: Room
    path_world: Array
    rng: np.random.Generator
    pieces: list[Piece] = field(default_factory=list)
    hangings: list[Hanging] = field(default_factory=list)
    kept_free: list[Rect] = field(default_factory=list)
    _walls: list[list[Rect]] = field(default_factory=lambda: [[], [], [], []])

    def stand_at_wall(self, kind: Kind) -> bool:
        """Place a piece with its back to a wall; returns whether there was room."""
        low, high = min(r[0] for r in kind.rects), max(r[2] for r in kind.rects)
        for _ in range(_TRIES):
            wall = int(self.rng.integers(4))
            length = (self.room.width, self.room.depth)[wall % 2]
            u = self.rng.uniform(0.02 - low, length - high - 0.02)
            if length < high - low + 0.1:
                continue
            on_wall = (u + kind.rects[0][0], 0.0, u + kind.rects[0][2], kind.height_m)
            if any(overlap(on_wall, other, _GAP_M) for other in self._walls[wall]):
                continue
            if self._stand(kind, wall_poses(self.room)[wall] @ pose(u, 0)):
                self._walls[wall].append(on_wall)
                return True
        return False

    def stand_free(self, kind: Kind, turns_deg: tuple[float, ...] = ()) -> bool:
        """Place a piece anywhere, at a given yaw or any; returns whether there was room."""
        for _ in range(_TRIES):
            x, y = self.rng.uniform((0.2, 0.2), (self.room.width - 0.2, self.room.depth - 0.2))
            yaw = self.rng.choice(turns_deg) if turns_deg else self.rng.uniform(0, 360)
            if self._stand(kind, pose(x, y, 0, float(yaw))):
                return True
        return False

    def keep_free(self, width_m: float, depth_m: float) -> Rect | None:
        """Reserve a rectangle of floor off the camera's path for a person; None if none is free."""
        for _ in range(_TRIES):
            size = np.array([width_m, depth_m] if self.rng.random() < 0.5 else [depth_m, width_m])
            low = self.rng.uniform((0.1, 0.1), (self.room.width, self.room.depth) - size - 0.1)
            rect = (*low.tolist(), *(low + size).tolist())
            if self._is_free((rect,)):
                self.kept_free.append(rect)
                return rect
        return None

    def hang(self, name: str, size_m: tuple[float, float], foot_m: tuple[float, float]) -> bool:
        """Hang a thing with its lower edge between two heights; returns whether there was room."""
        w, h = size_m
        for _ in range(_TRIES):
            wall = int(self.rng.integers(4))
            length = (self.room.width, self.room.depth)[wall % 2]
            u = self.rng.uniform(w / 2 + 0.08, length - w / 2 - 0.08)
            z = min(self.rng.uniform(*foot_m), self.room.height - h - 0.06)
            rect = (u - w / 2, z, u + w / 2, z + h)
            if any(overlap(rect, other, 0.06) for other in self._walls[wall]):
                continue
            self._walls[wall].append(rect)
            T_world_hanging = wall_poses(self.room)[wall] @ pose(u, 0, z)
            self.hangings.append(Hanging(name, T_world_hanging, size_m))
            return True
        return False

    def _stand(self, kind: Kind, T_world_piece: Array) -> bool:
        rects = tuple(moved_rect(rect, T_world_piece) for rect in kind.rects)
        if not self._is_free(rects):
            return False
        self.pieces.append(Piece(kind, T_world_piece, rects))
        return True

    def _is_free(self, rects: tuple[Rect, ...]) -> bool:
        inside = (-1e-9, -1e-9, self.room.width + 1e-9, self.room.depth + 1e-9)
        for rect in rects:
            if rect[0] < inside[0] or rect[1] < inside[1]:
                return False
            if rect[2] > inside[2] or rect[3] > inside[3]:
                return False
            if distance_m(rect, self.path_world).min() < _CAMERA_GAP_M:
                return False
        occupied = [other for piece in self.pieces for other in piece.rects_world] + self.kept_free
        return not any(overlap(rect, other, _GAP_M) for rect in rects for other in occupied)
