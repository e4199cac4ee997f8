"""Whether two keyframes show the same place, and the pose between them.

Descriptors are matched without a prior and give a pose by RANSAC on 3-D to 3-D triples. At that
pose the points of each keyframe are searched in the other, and the matches refine it.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from bmask_slam.features.matching import (
    MatchConfig,
    Matches,
    WindowIndex,
    consistent_rotation,
    match_brute_force,
    match_pairs,
)
from bmask_slam.graph.arrays import Array, Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, make_pose, transform
from bmask_slam.loops.relative_pose import LoopView, Views, refine_relative_pose
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.world_map import WorldMap

NEAREST_M = 0.1


@dataclass(frozen=True)
class LoopConfig:
    """Parameters and limits of the verification.

    ``samples`` triples are drawn with ``seed``; of those whose sides are as long in both keyframes
    the first ``hypotheses`` are tried. A match agrees if it is within ``ransac_px`` in BOTH images.
    Guided matching looks within each of ``radii_px`` in turn. A loop needs ``min_inliers`` matches,
    ``min_share`` of the points that the other keyframe should see, and sigmas below the limits.
    ``max_turn_rad`` limits the difference of a match's rotation from the most common one.
    """

    seed: int = 0
    samples: int = 6000
    hypotheses: int = 400
    side_tolerance: float = 0.1
    ransac_px: float = 6.0
    min_matches: int = 15
    min_consensus: int = 12
    radii_px: tuple[float, ...] = (12.0, 6.0)
    min_inliers: int = 30
    min_share: float = 0.1
    max_sigma_rad: float = 0.02
    max_sigma_m: float = 0.05
    max_turn_rad: float = 0.5
    first_distance: int = 110
    first_ratio: float = 0.85

    def __post_init__(self) -> None:
        if not self.radii_px:
            raise ValueError("radii_px must not be empty")


class NoLoopReason(Enum):
    """Why a candidate was rejected."""

    FEW_MATCHES = "too few descriptors match"
    NO_CONSENSUS = "too few matches agree on a pose"
    FEW_INLIERS = "too few points are found where the pose says"
    LITTLE_SHARED = "too little is found of what should be seen"
    UNCERTAIN = "a sigma of the pose is too large, given in units of its limit"


@dataclass(frozen=True)
class NoLoop:
    """A rejected candidate: ``value`` was found, ``limit`` would have been accepted."""

    reason: NoLoopReason
    value: float
    limit: float

    def __str__(self) -> str:
        """The reason with its figures."""
        return f"{self.reason.value} ({self.value:.3g}, limit {self.limit:.3g})"


@dataclass(frozen=True)
class LoopConstraint:
    """A verified loop: a measured pose between two keyframes.

    Attributes:
        T_a_b: (4, 4), ``p_a = T_a_b @ p_b``.
        covariance: (6, 6) of the tangent [rotation rad, translation m] at b (right side).
        inliers: number of matches that it is based on.
        noise_scale: ratio of residuals to their sigmas, at least 1; the covariance is scaled by it.
        landmark_pairs: (P, 2) ids of landmarks, of a and of b, that are the same point.
    """

    keyframe_a: int
    keyframe_b: int
    T_a_b: Array
    covariance: Array
    inliers: int
    noise_scale: float
    landmark_pairs: Ints

    @property
    def ends(self) -> tuple[int, int]:
        """Ids of the older and the newer keyframe."""
        return self.keyframe_a, self.keyframe_b


def loop_view(keyframe: Keyframe, world: WorldMap) -> LoopView:
    """A keyframe with the landmarks that it observes, as they are now."""
    points = np.full((len(keyframe.features), 3), np.nan)
    landmark_ids = np.full(len(keyframe.features), -1, np.int64)
    rows, ids = world.observed(keyframe)
    landmark_ids[rows] = ids
    points[rows] = transform(inverse(keyframe.T_world_camera), world.landmarks.points_world[ids])
    points[~np.isfinite(keyframe.features.disparity_px) | ~(points[:, 2] > NEAREST_M)] = np.nan
    return LoopView(keyframe.id, keyframe.features, points, landmark_ids)


def verify_loop(
    view_a: LoopView, view_b: LoopView, camera: Camera, config: LoopConfig | None = None
) -> LoopConstraint | NoLoop:
    """The pose of keyframe b in keyframe a, from their features alone, without a prior pose."""
    config = config or LoopConfig()
    views = (view_a, view_b)
    matches = _descriptor_matches(views, config)
    if len(matches) < config.min_matches:
        return NoLoop(NoLoopReason.FEW_MATCHES, len(matches), config.min_matches)
    T_a_b, agreeing = _consensus(views, matches, camera, config)
    if agreeing < config.min_consensus:
        return NoLoop(NoLoopReason.NO_CONSENSUS, agreeing, config.min_consensus)
    for radius_px in config.radii_px:
        a, b, expected = _guided_pairs(views, T_a_b, camera, radius_px)
        if (found := len(a)) >= config.min_inliers:
            refined = refine_relative_pose(views, (a, b), T_a_b, camera)
            T_a_b, found = refined.T_a_b, int(refined.inliers.sum())
        if found < config.min_inliers:
            return NoLoop(NoLoopReason.FEW_INLIERS, found, config.min_inliers)
    if found < config.min_share * expected:
        return NoLoop(NoLoopReason.LITTLE_SHARED, found / expected, config.min_share)
    limits = np.repeat([config.max_sigma_rad, config.max_sigma_m], 3)
    worst = (np.sqrt(np.diagonal(refined.covariance)) / limits).max()
    if not worst <= 1.0:
        return NoLoop(NoLoopReason.UNCERTAIN, worst, 1.0)
    ids = np.stack([view_a.landmark_ids[a], view_b.landmark_ids[b]], axis=1)
    ids = ids[refined.inliers]
    ids = np.unique(ids[(ids >= 0).all(axis=1) & (ids[:, 0] != ids[:, 1])], axis=0)
    return LoopConstraint(
        view_a.keyframe_id,
        view_b.keyframe_id,
        refined.T_a_b,
        refined.covariance,
        found,
        refined.noise_scale,
        ids,
    )


def align_triples(points_a: Array, points_b: Array) -> Array:
    """T_a_b (..., 4, 4) with least squares of ``p_a - T_a_b @ p_b`` over points (..., N, 3).

    Umeyama (1991) eq. (39)-(42) without scale, by batched SVD; N >= 3 and not on a line.
    """
    mean_a, mean_b = points_a.mean(axis=-2), points_b.mean(axis=-2)
    centred_a, centred_b = points_a - mean_a[..., None, :], points_b - mean_b[..., None, :]
    U, _, Vt = np.linalg.svd(np.swapaxes(centred_a, -1, -2) @ centred_b)
    U[..., :, 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))[..., None]  # no reflection
    R_a_b = U @ Vt
    return make_pose(R_a_b, mean_a - (R_a_b @ mean_b[..., None])[..., 0])


def _descriptor_matches(views: Views, config: LoopConfig) -> Matches:
    """Matches of keypoints of a (query) and b (train) that both have points."""
    rows_a, rows_b = (np.flatnonzero(np.isfinite(v.points_camera[:, 2])) for v in views)
    a, b = (view.features for view in views)
    first = MatchConfig(config.first_distance, config.first_ratio)
    found = match_brute_force(a.descriptors[rows_a], b.descriptors[rows_b], first)
    matches = Matches(rows_a[found.query], rows_b[found.train], found.distance)
    turn_rad = a.angles_rad[matches.query] - b.angles_rad[matches.train]
    return consistent_rotation(matches, turn_rad, config.max_turn_rad)


def _consensus(
    views: Views, matches: Matches, camera: Camera, config: LoopConfig
) -> tuple[Array, int]:
    """The T_a_b that most matches agree with, fitted to these, and their number."""
    limit_px, rows = config.ransac_px, (matches.query, matches.train)
    points_a, points_b = (v.points_camera[k] for v, k in zip(views, rows, strict=True))
    pixels = tuple(v.features.pixels[k] for v, k in zip(views, rows, strict=True))
    triples = np.random.default_rng(config.seed).integers(0, len(points_a), (config.samples, 3))
    corners_a, corners_b = points_a[triples], points_b[triples]
    sides = [np.linalg.norm(c - np.roll(c, 1, axis=1), axis=2) for c in (corners_a, corners_b)]
    alike = np.abs(sides[0] - sides[1]) < config.side_tolerance * np.minimum(*sides)
    chosen = np.flatnonzero(alike.all(axis=1))[: config.hypotheses]  # equal indices: a side of 0
    if len(chosen) == 0:
        return np.eye(4), 0
    hypotheses = align_triples(corners_a[chosen], corners_b[chosen])
    votes = _near(hypotheses, points_b, pixels[0], camera, limit_px)
    votes &= _near(inverse(hypotheses), points_a, pixels[1], camera, limit_px)
    inliers = votes[votes.sum(axis=1).argmax()]
    T_a_b = align_triples(points_a[inliers], points_b[inliers]) if inliers.sum() > 2 else np.eye(4)
    return T_a_b, int(inliers.sum())


def _near(T_x_y: Array, points_y: Array, pixels_x: Array, camera: Camera, px: float) -> Mask:
    """(..., N) whether points (N, 3) of y project near pixels (N, 2) of x."""
    points_x = transform(T_x_y, points_y)
    front = points_x[..., 2] > NEAREST_M
    points_x[..., 2] = np.where(front, points_x[..., 2], 1.0)
    return front & (np.linalg.norm(camera.project(points_x) - pixels_x, axis=-1) < px)


def _guided_pairs(
    views: Views, T_a_b: Array, camera: Camera, radius_px: float
) -> tuple[Ints, Ints, int]:
    """Keypoints (a, b) that match at the pose in both directions, and how many are in view."""
    query_a, train_b, visible_in_b = _guided(views, inverse(T_a_b), camera, radius_px)
    query_b, train_a, visible_in_a = _guided(views[::-1], T_a_b, camera, radius_px)
    pairs = np.unique(np.c_[np.r_[query_a, train_a], np.r_[train_b, query_b]], axis=0)
    once_a = np.bincount(pairs[:, 0], minlength=1)[pairs[:, 0]] == 1
    once_b = np.bincount(pairs[:, 1], minlength=1)[pairs[:, 1]] == 1
    a, b = pairs[once_a & once_b].T
    return a, b, max(min(visible_in_a, visible_in_b), 1)


def _guided(
    views: Views, T_target_source: Array, camera: Camera, radius_px: float
) -> tuple[Ints, Ints, int]:
    """Keypoints (source, target) that match within a radius, and how many points are in view."""
    source, target = views
    rows = np.flatnonzero(np.isfinite(source.points_camera[:, 2]))
    points = transform(T_target_source, source.points_camera[rows])
    rows, points = rows[points[:, 2] > NEAREST_M], points[points[:, 2] > NEAREST_M]
    pixels = camera.project(points)
    inside = ((pixels > 0) & (pixels < [camera.width - 1, camera.height - 1])).all(axis=1)
    rows, pixels = rows[inside], pixels[inside]
    query, train = WindowIndex(target.features.pixels).pairs(pixels, np.full(len(rows), radius_px))
    tables = (source.features.descriptors[rows], target.features.descriptors)
    found = match_pairs((query, train), tables, MatchConfig())
    return rows[found.query], found.train, len(rows)
