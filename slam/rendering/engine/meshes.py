"""Triangle soups with texture coordinates: the shapes that rooms and people are made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array


@dataclass(frozen=True)
class Shape:
    """T triangles in metres, with smooth normals and texture coordinates.

    Attributes:
        corners: (T, 3, 3) corner positions.
        normals: (T, 3, 3) unit normals at the corners.
        uvs: (T, 3, 2) texture coordinates in [0, 1], u to the right and v down in the image.
    """

    corners: Array
    normals: Array
    uvs: Array

    def moved(self, T_a_b: Array) -> Shape:
        """The shape in frame a, if it is given in frame b; rigid motions only."""
        R, t = T_a_b[:3, :3], T_a_b[:3, 3]
        return Shape(self.corners @ R.T + t, self.normals @ R.T, self.uvs)


def join(shapes: list[Shape]) -> Shape:
    """All triangles in one soup."""
    return Shape(
        np.concatenate([s.corners for s in shapes]),
        np.concatenate([s.normals for s in shapes]),
        np.concatenate([s.uvs for s in shapes]),
    )


def quad(origin: Array, edge_u: Array, edge_v: Array) -> Shape:
    """A parallelogram whose picture has its top left corner at ``origin``.

    ``edge_u`` runs to the right of the picture and ``edge_v`` down; the normal ``edge_v x edge_u``
    points to the side from which the picture is upright.
    """
    origin, edge_u, edge_v = (np.asarray(a, float) for a in (origin, edge_u, edge_v))
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    points = origin + uv[:, :1] * edge_u + uv[:, 1:] * edge_v
    (a, b, c), (d, e, f) = edge_v, edge_u
    normal = np.array([b * f - c * e, c * d - a * f, a * e - b * d])  # np.cross takes much longer
    normal = normal / np.linalg.norm(normal)
    index = np.array([[0, 1, 2], [0, 2, 3]])
    return Shape(points[index], np.broadcast_to(normal, (2, 3, 3)).copy(), uv[index])


def box_faces(size: Array) -> dict[str, tuple[Array, Array, Array]]:
    """Faces of a box that stands on z = 0, centred on the z axis: ``quad`` arguments by name.

    The front looks along -y.
    """
    w, d, h = size
    x, y, z = np.eye(3)
    return {
        "front": (np.array([-w / 2, -d / 2, h]), w * x, -h * z),
        "back": (np.array([w / 2, d / 2, h]), -w * x, -h * z),
        "left": (np.array([-w / 2, d / 2, h]), -d * y, -h * z),
        "right": (np.array([w / 2, -d / 2, h]), d * y, -h * z),
        "top": (np.array([-w / 2, d / 2, h]), w * x, -d * y),
        "bottom": (np.array([-w / 2, -d / 2, 0]), w * x, d * y),
    }


def lathe(profile: Array, segments: int = 20, squash: tuple[float, float] = (1.0, 1.0)) -> Shape:
    """A surface of revolution about z from (N, 2) radius and height pairs, lowest first.

    ``squash`` scales x and y. The seam (u = 0) lies at +y, so that the middle of the texture
    looks along -y, the front.
    """
    profile = np.asarray(profile, float)
    angle = np.linspace(0, 2 * np.pi, segments + 1) + np.pi / 2
    circle = np.stack([np.cos(angle) * squash[0], np.sin(angle) * squash[1]], -1)
    points = np.empty((len(profile), segments + 1, 3))
    points[..., :2] = profile[:, None, :1] * circle
    points[..., 2] = profile[:, None, 1]
    step = np.gradient(profile, axis=0)
    normals = np.empty_like(points)
    normals[..., 0] = step[:, None, 1] * np.cos(angle) / squash[0]
    normals[..., 1] = step[:, None, 1] * np.sin(angle) / squash[1]
    normals[..., 2] = -step[:, None, 0]
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True) + 1e-12
    steps = np.diff(profile, axis=0) * [np.mean(squash), 1.0]
    length = np.r_[0, np.cumsum(np.linalg.norm(steps, axis=1))]
    uvs = np.empty((*points.shape[:2], 2))
    uvs[..., 0] = np.linspace(0, 1, segments + 1)
    uvs[..., 1] = 1 - (length / length[-1])[:, None]
    return _grid(points, normals, uvs)


def _grid(points: Array, normals: Array, uvs: Array) -> Shape:
    """Two triangles for each cell of a (rows, columns) grid, without those of no area."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (
        s.ravel() for s in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1])
    )
    triangles = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    corners = points.reshape(-1, 3)[triangles]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    triangles = triangles[area > 1e-10]
    return Shape(
        points.reshape(-1, 3)[triangles],
        normals.reshape(-1, 3)[triangles],
        uvs.reshape(-1, 2)[triangles],
    )


def ellipsoid(radii: tuple[float, float, float], segments: int = 20) -> Shape:
    """An ellipsoid about the origin with the given half axes in metres."""
    polar = np.linspace(0, np.pi, segments // 2 + 1)
    profile = np.stack([np.sin(polar), -np.cos(polar) * radii[2]], -1)
    profile[[0, -1], 0] = 0
    return lathe(profile, segments, (radii[0], radii[1]))


def tapered_capsule(length: float, bottom: float, top: float, segments: int = 14) -> Shape:
    """A rod along z from 0 to ``length`` with round ends of radii ``bottom`` and ``top``."""
    polar = np.linspace(0, np.pi / 2, 5)
    low = np.stack([bottom * np.sin(polar), -bottom * np.cos(polar)], -1)
    high = np.stack([top * np.cos(polar), length + top * np.sin(polar)], -1)
    return lathe(np.concatenate([low, high]), segments)


def between(p: Array, q: Array) -> Array:
    """A pose (4, 4) with origin p and the z axis toward q."""
    z = np.asarray(q, float) - p
    z = z / np.linalg.norm(z)
    helper = np.eye(3)[np.argmin(np.abs(z))]
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], -1)
    T[:3, 3] = p
    return T


def pose(x: float, y: float, z: float = 0.0, yaw_deg: float = 0.0) -> Array:
    """A pose (4, 4) at a point in metres, turned about the vertical in degrees."""
    c, s = np.cos(np.deg2rad(yaw_deg)), np.sin(np.deg2rad(yaw_deg))
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, z], [0, 0, 0, 1.0]])


def tilt(axis: str, angle_deg: float) -> Array:
    """A turn (4, 4) about the x, y or z axis in degrees."""
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    T = np.eye(4)
    T[j, j], T[j, k], T[k, j], T[k, k] = c, -s, s, c
    return T
