"""Fiducial markers: squares of ArUco or AprilTag, whose corners give their pose in the camera.

A marker's frame has its origin in the middle, x to the right, y up and z out of the print. The
corners follow each other from the top left, clockwise as one looks at it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.graph_update import MARKERS_OF_A_SEGMENT
from bmask_slam.graph.geometry import inverse, se3_exp, skew
from bmask_slam.graph.sensors.odometry import Kernel

Dictionary = Literal[
    "4X4_50", "4X4_100", "4X4_250", "4X4_1000", "5X5_50", "5X5_100", "5X5_250", "5X5_1000",
    "6X6_50", "6X6_100", "6X6_250", "6X6_1000", "7X7_50", "7X7_100", "7X7_250", "7X7_1000",
    "ARUCO_ORIGINAL", "ARUCO_MIP_36h12",
    "APRILTAG_16h5", "APRILTAG_25h9", "APRILTAG_36h10", "APRILTAG_36h11",
]  # fmt: skip
"""OpenCV's dictionaries, without DICT_."""
CORNERS = np.array([[-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0], [-0.5, -0.5, 0]])
"""The corners (4, 3) of a marker of size 1 in its frame."""
MAX_SIZE_M = 10.0
_ITERATIONS = 30


@dataclass(frozen=True)
class MarkersConfig:
    """Which markers there are, and how well their corners are found.

    Attributes:
        enabled: whether they are looked for.
        dictionary: OpenCV's, without DICT_.
        size_m: edge of the black square; null: not known, depth gives it.
        sizes_m: rows ``[id, size]`` of markers with another size.
        poses: rows ``[id, x, y, z, qx, qy, qz, qw]`` of markers whose pose in the site's frame is
            known: T_site_marker.
        only_known: ids that have no row in ``sizes_m`` or ``poses`` are ignored.
        corner_px: sigma of each coordinate of a corner.
        size_sigma: of a known size, relative: how exactly it was printed and measured.
        sigma_m, sigma_rad: of the known poses.
        min_side_px: a marker with a shorter side is ignored.
        robust: kernel of its factors.
    """

    enabled: bool = False
    dictionary: Dictionary = "APRILTAG_36h11"
    size_m: float | None = None
    sizes_m: tuple[tuple[int, float], ...] = ()
    poses: tuple[tuple[int, float, float, float, float, float, float, float], ...] = ()
    only_known: bool = False
    corner_px: float = 0.15
    size_sigma: float = 0.002
    sigma_m: float = 0.002
    sigma_rad: float = 0.005
    min_side_px: float = 16.0
    robust: Kernel = "cauchy"

    def __post_init__(self) -> None:
        sizes = [self.size_m, *(size for _, size in self.sizes_m)]
        wrong = [size for size in sizes if size is not None and not 0 < size <= MAX_SIZE_M]
        if wrong:
            raise InputError(f"sensors.markers: size {wrong[0]:g} m; give metres, such as 0.16")
        known = [row[0] for row in self.poses]
        for ids in (known, [number for number, _ in self.sizes_m]):
            if len(set(ids)) < len(ids) or not all(0 <= i < MARKERS_OF_A_SEGMENT for i in ids):
                raise InputError(f"sensors.markers: ids {ids}: give each once, and none negative")
        if any(not any(row[4:]) for row in self.poses):
            raise InputError("sensors.markers.poses: a rotation of zeros; the last is qw = 1")

    @property
    def has_site(self) -> bool:
        """Whether poses of markers are known."""
        return self.enabled and bool(self.poses)

    def size_of(self, number: int) -> float | None:
        """The size of a marker in metres, None where it is not known."""
        return dict(self.sizes_m).get(number, self.size_m)

    def uses(self, number: int) -> bool:
        """Whether a marker with this id is used."""
        listed = (ids[0] for rows in (self.sizes_m, self.poses) for ids in rows)
        return not self.only_known or number in set(listed)


@dataclass(frozen=True)
class SeenCorners:
    """The corners of a marker in an image.

    Attributes:
        places: (4, 2) undistorted, in units of the focal length from the principal point.
        sigma: of each coordinate.
        inverse_depths: (4,) in 1/m, NaN where there is no depth.
        depth_sigmas: (4,) of these, in 1/m.
    """

    places: Array
    sigma: float
    inverse_depths: Array
    depth_sigmas: Array

    @classmethod
    def of(cls, columns: Array) -> SeenCorners:
        """Those of 17 numbers: four places, the sigma, four inverse depths, their sigmas."""
        return cls(columns[:8].reshape(4, 2), float(columns[8]), columns[9:13], columns[13:17])


@dataclass(frozen=True)
class MarkerPose:
    """The pose of a marker by its corners.

    Attributes:
        T_marker_camera: (4, 4); covariance: (6, 6) of its tangent at the camera (right side).
        log_size, log_size_sigma: of its size in metres.
        chi2: of the corners; degrees: of freedom that it has.
    """

    T_marker_camera: Array
    covariance: Array
    log_size: float
    log_size_sigma: float
    chi2: float
    degrees: int


@dataclass(frozen=True, eq=False)
class FoundMarker:
    """A marker in the map.

    Attributes:
        id: its number in the dictionary.
        size_m: edge of the black square, known or by depth; NaN where neither says it.
        T_world_marker: (4, 4).
        seen, used: number of keyframes that saw it, and of those whose sighting is a factor.
    """

    id: int
    size_m: float
    T_world_marker: Array
    seen: int
    used: int


@dataclass(frozen=True, eq=False)
class MarkerMap:
    """The markers of a map segment, by rising ids.

    ``T_world_site`` (4, 4) is the frame in which poses of markers were known; None without any.
    """

    dictionary: str
    T_world_site: Array | None
    markers: tuple[FoundMarker, ...]


def fit_marker(
    seen: SeenCorners, T_marker_camera: Array, log_size: float, log_size_sigma: float
) -> MarkerPose | None:
    """The pose and size near a first guess that fit the corners best; None if there is none.

    Levenberg and Marquardt's method on the eight coordinates, the inverse depths, and the size as
    it is known (``log_size_sigma`` infinite: not at all).
    """
    prior, before = log_size, np.inf
    T, size, damping = T_marker_camera, log_size, 1e-3
    weight = 1 / log_size_sigma**2
    r, J = _linearised(seen, T, size)
    for _ in range(_ITERATIONS):
        cost = float(r @ r) + weight * (size - prior) ** 2
        if before - cost < 1e-9 * max(cost, 1e-6):
            break
        before = cost
        H, g = J.T @ J, J.T @ r
        H[6, 6] += weight
        g[6] += weight * (size - prior)
        for _ in range(8):
            step = np.linalg.solve(H + damping * np.diag(np.diag(H) + 1e-9), -g).astype(float)
            T_new, size_new = T @ se3_exp(step[:6]), size + float(np.clip(step[6], -1, 1))
            r_new, J_new = _linearised(seen, T_new, size_new)
            if float(r_new @ r_new) + weight * (size_new - prior) ** 2 <= cost:
                T, size, r, J, damping = T_new, size_new, r_new, J_new, damping / 10
                break
            damping *= 10
    H = J.T @ J
    H[6, 6] += weight
    if not np.isfinite(H).all() or np.linalg.cond(H) > 1e14 or inverse(T)[2, 3] <= 0:
        return None
    covariance, chi2 = np.linalg.inv(H), float(r @ r) + weight * (size - prior) ** 2
    degrees = len(r) + (weight > 0) - 7
    pose = (covariance[:6, :6] + covariance[:6, :6].T) / 2
    return MarkerPose(T, pose, size, float(np.sqrt(covariance[6, 6])), chi2, degrees)


def _linearised(seen: SeenCorners, T_marker_camera: Array, log_size: float) -> tuple[Array, Array]:
    """Whitened residuals (N,) and Jacobian (N, 7) by ``T @ se3_exp(xi)`` and the size's logarithm.

    ``p_c = exp(-xi) T_camera_marker p_m``, so that ``dp_c = [p_c]_x w - v``.
    """
    T_camera_marker = inverse(T_marker_camera)
    turned = np.exp(log_size) * CORNERS @ T_camera_marker[:3, :3].T
    p = turned + T_camera_marker[:3, 3]
    z = np.where(np.abs(p[:, 2]) < 1e-6, 1e-6, p[:, 2])
    dp = np.concatenate([skew(p), np.broadcast_to(-np.eye(3), (4, 3, 3)), turned[..., None]], 2)
    at = p[:, :2] / z[:, None]
    d_at = (dp[:, :2] - at[..., None] * dp[:, 2:]) / z[:, None, None]
    known = np.isfinite(seen.inverse_depths)
    depth = (1 / z - seen.inverse_depths)[known] / seen.depth_sigmas[known]
    d_depth = -dp[known, 2] / (z[known] ** 2 * seen.depth_sigmas[known])[:, None]
    r = np.concatenate([((at - seen.places) / seen.sigma).ravel(), depth])
    return r, np.concatenate([d_at.reshape(8, 7) / seen.sigma, d_depth])
