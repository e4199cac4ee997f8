"""Whether two keyframes really show the same place, and the pose between them if they do.

Descriptors are matched without a prior and give a pose by RANSAC on 3-D to 3-D triples. There the
points of each keyframe are searched in the other, and what both ways find refines the pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from bmask_slam.features.brisk import Features
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
from bmask_slam.graph.geometry import (
    adjoint,
    inverse,
    make_pose,
    orthonormalised,
    se3_exp,
    transform,
)
from bmask_slam.tracking.pose_optimisation import CHI2_2DOF, CHI2_3DOF, jacobian, residuals
from bmask_slam.world.world_map import Keyframe, WorldMap

NEAREST_M = 0.1
MAX_NOISE_SCALE = 3.0
MEDIAN_TO_GATE = 2.366 / CHI2_3DOF  # of chi-square


@dataclass(frozen=True)
class LoopConfig:
    """Gates of a loop.

    ``samples`` triples are drawn with ``seed``; of those whose sides are as long in both keyframes
    the first ``hypotheses`` are tried. A match agrees if it is within ``ransac_px`` in BOTH images.
    Guided matching looks within each of ``radii_px`` in turn. A loop needs ``min_inliers`` matches,
    ``min_share`` of the points that the other keyframe should see, and sigmas below the limits.
    ``max_turn_rad`` bounds how far a match may turn otherwise in the image than most.
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


@dataclass(frozen=True)
class LoopView:
    """What a keyframe brings to a loop.

    ``features`` are its N keypoints, ``landmark_ids`` (N,) their living landmarks, -1 for none,
    ``points_camera`` (N, 3) these in its camera's frame, NaN also where the keypoint has no depth.
    """

    keyframe_id: int
    features: Features
    points_camera: Array
    landmark_ids: Ints


Views = tuple[LoopView, LoopView]
Pairs = tuple[Ints, Ints]  # keypoint a[k] goes with b[k]
Search = tuple[float, Camera, LoopConfig]  # radius in px


class NoLoopReason(Enum):
    """Why a candidate was refused."""

    FEW_MATCHES = "too few descriptors match"
    NO_CONSENSUS = "too few matches agree on a pose"
    FEW_INLIERS = "too few points are found where the pose says"
    LITTLE_SHARED = "too little is found of what should be seen"
    UNCERTAIN = "a sigma of the pose is too large, given in units of its limit"


@dataclass(frozen=True)
class NoLoop:
    """A refusal: ``value`` is what was found, ``limit`` what would have been accepted."""

    reason: NoLoopReason
    value: float
    limit: float


@dataclass(frozen=True)
class LoopConstraint:
    """A measured pose between two keyframes: what
    bmask_slam.graph.factors.graph_update.RelativePose takes.

    Attributes:
        T_a_b: (4, 4), ``p_a = T_a_b @ p_b``.
        covariance: (6, 6) of the tangent [rotation rad, translation m] at b (right side).
        inliers: number of matches that it rests on.
        noise_scale: residuals over their sigmas, at least 1; it has raised the covariance.
        landmark_pairs: (P, 2) ids of landmarks, of a and of b, that are one and the same.
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
    living = np.full(len(keyframe.features), -1, np.int64)
    rows, ids = world.observed(keyframe)
    living[rows] = ids
    points[rows] = transform(inverse(keyframe.T_world_camera), world.landmarks.points_world[ids])
    points[~np.isfinite(keyframe.features.disparity_px) | ~(points[:, 2] > NEAREST_M)] = np.nan
    return LoopView(keyframe.id, keyframe.features, points, living)


def verify_loop(
    view_a: LoopView, view_b: LoopView, camera: Camera, config: LoopConfig | None = None
) -> LoopConstraint | NoLoop:
    """The pose of keyframe b in keyframe a from what they see alone; no prior pose is used."""
    config = config or LoopConfig()
    views = (view_a, view_b)
    matches = _descriptor_matches(views, config)
    if len(matches) < config.min_matches:
        return NoLoop(NoLoopReason.FEW_MATCHES, len(matches), config.min_matches)
    T_a_b, agreeing = _consensus(views, matches, (config.ransac_px, camera, config))
    if agreeing < config.min_consensus:
        return NoLoop(NoLoopReason.NO_CONSENSUS, agreeing, config.min_consensus)
    for radius_px in config.radii_px:
        a, b, expected = _guided_pairs(views, T_a_b, (radius_px, camera, config))
        if (found := len(a)) >= config.min_inliers:
            T_a_b, covariance, inliers, scale = _refine(views, (a, b), T_a_b, camera)
            found = int(inliers.sum())
        if found < config.min_inliers:
            return NoLoop(NoLoopReason.FEW_INLIERS, found, config.min_inliers)
    if found < config.min_share * expected:
        return NoLoop(NoLoopReason.LITTLE_SHARED, found / expected, config.min_share)
    limits = np.repeat([config.max_sigma_rad, config.max_sigma_m], 3)
    worst = (np.sqrt(np.diagonal(covariance)) / limits).max()
    if not worst <= 1.0:
        return NoLoop(NoLoopReason.UNCERTAIN, worst, 1.0)
    ids = np.stack([view_a.landmark_ids[a], view_b.landmark_ids[b]], axis=1)[inliers]
    ids = np.unique(ids[(ids >= 0).all(axis=1) & (ids[:, 0] != ids[:, 1])], axis=0)
    result = (T_a_b, covariance, found, scale, ids)
    return LoopConstraint(view_a.keyframe_id, view_b.keyframe_id, *result)


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
    """Keypoints of a (query) and b (train), both with points, of like descriptors and turn."""
    rows_a, rows_b = (np.flatnonzero(np.isfinite(v.points_camera[:, 2])) for v in views)
    a, b = (view.features for view in views)
    first = MatchConfig(config.first_distance, config.first_ratio)
    found = match_brute_force(a.descriptors[rows_a], b.descriptors[rows_b], first)
    matches = Matches(rows_a[found.query], rows_b[found.train], found.distance)
    turn_rad = a.angles_rad[matches.query] - b.angles_rad[matches.train]
    return consistent_rotation(matches, turn_rad, config.max_turn_rad)


def _consensus(views: Views, matches: Matches, search: Search) -> tuple[Array, int]:
    """The T_a_b that most matches agree with, fitted to these, and their number."""
    (limit_px, camera, config), rows = search, (matches.query, matches.train)
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
    """(..., N) whether points (N, 3) of y come to lie near pixels (N, 2) of x."""
    points_x = transform(T_x_y, points_y)
    front = points_x[..., 2] > NEAREST_M
    points_x[..., 2] = np.where(front, points_x[..., 2], 1.0)
    return front & (np.linalg.norm(camera.project(points_x) - pixels_x, axis=-1) < px)


def _guided_pairs(views: Views, T_a_b: Array, search: Search) -> tuple[Ints, Ints, int]:
    """Keypoints that match near the pose, neither way in conflict, and how many could have."""
    query_a, train_b, seen_in_b = _guided(views, inverse(T_a_b), search)
    query_b, train_a, seen_in_a = _guided(views[::-1], T_a_b, search)
    pairs = np.unique(np.c_[np.r_[query_a, train_a], np.r_[train_b, query_b]], axis=0)
    once_a = np.bincount(pairs[:, 0], minlength=1)[pairs[:, 0]] == 1
    once_b = np.bincount(pairs[:, 1], minlength=1)[pairs[:, 1]] == 1
    a, b = pairs[once_a & once_b].T
    return a, b, max(min(seen_in_a, seen_in_b), 1)


def _guided(views: Views, T_target_source: Array, search: Search) -> tuple[Ints, Ints, int]:
    """Keypoints (source, target) that match within a radius, and how many points are in view."""
    (source, target), (radius_px, camera, _) = views, search
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


def _refine(
    views: Views, pairs: Pairs, T_a_b: Array, camera: Camera
) -> tuple[Array, Array, Mask, float]:
    """T_a_b on pairs, its covariance, which pairs are inliers, and the noise scale.

    Gauss-Newton with Cauchy's kernel on all pairs, then on inliers alone. A pair with points on
    both sides enters each way with half the weight, since it is one piece of information.
    """
    scale, active = 1.0, np.ones(len(pairs[0]), bool)
    for kernel in (16.0, 4.0, 1.0, None, None, None, None):
        r, J, W, gate = _linearised(views, pairs, T_a_b, camera)
        chi2 = np.einsum("wni,wnij,wnj->n", r, W, r)
        if kernel is None or kernel == 1.0:
            asked = np.sqrt(np.median(chi2 / gate) / MEDIAN_TO_GATE)
            scale = float(np.clip(asked, 1.0, MAX_NOISE_SCALE))
        active = chi2 < gate * scale**2
        w = active if kernel is None else 1 / (1 + chi2 / (kernel * gate))
        H = np.einsum("n,wnia,wnij,wnjb->ab", w, J, W, J)
        g = np.einsum("n,wnia,wnij,wnj->a", w, J, W, r)
        T_a_b = orthonormalised(T_a_b @ se3_exp(-np.linalg.solve(H + 1e-9 * np.eye(6), g)))
    return T_a_b, np.linalg.inv(H + 1e-9 * np.eye(6)) * scale**2, active, scale


def _linearised(views: Views, pairs: Pairs, T_a_b: Array, camera: Camera) -> tuple[Array, ...]:
    """Residuals (2, M, 3), Jacobians (2, M, 3, 6), weights (2, M, 3, 3), gates (M,), for two ways.

    Way 0 is a's points in b, way 1 b's points in a. For ``T_a_b <- T_a_b @ se3_exp(xi)`` the
    inverse becomes ``T_b_a @ se3_exp(-Ad(T_a_b) @ xi)``. Without a point the weight is zero.
    """
    r_b, J_b, W_b = _way(views, pairs, T_a_b, camera)
    r_a, J_a, W_a = _way(views[::-1], pairs[::-1], inverse(T_a_b), camera)
    W = np.stack([W_b, W_a])
    has_point, has_depth = W[:, :, 0, 0] > 0, W[:, :, 2, 2] > 1e-9
    W /= has_point.sum(axis=0)[:, None, None]
    gate = np.where(has_depth.any(axis=0), CHI2_3DOF, CHI2_2DOF)
    return np.stack([r_b, r_a]), np.stack([J_b, -J_a @ adjoint(T_a_b)]), W, gate


def _way(views: Views, pairs: Pairs, T_source_target: Array, camera: Camera) -> tuple[Array, ...]:
    """Residuals, Jacobians and weights of the source's points in the target's image.

    A point is taken to be as uncertain as its own keyframe's measurement of it alone.
    """
    source, target = views
    own, measured = source.points_camera[pairs[0]], target.features.measurements[pairs[1]]
    known, stereo = np.isfinite(own[:, 2]), np.isfinite(measured[:, 2])
    own, measured = np.where(known[:, None], own, [0, 0, 1]), np.nan_to_num(measured)
    r, points = residuals(T_source_target, own, measured, camera)
    J = jacobian(points, camera)
    to_pixels = -J[:, :, 3:] @ T_source_target[:3, :3].T  # d(u, v, disparity) / d(own)
    spread = to_pixels @ np.linalg.inv(-jacobian(own, camera)[:, :, 3:])
    own_sigmas = np.where(known[:, None], source.features.sigmas_px[pairs[0]], 1.0)
    sigmas = target.features.sigmas_px[pairs[1]].copy()
    sigmas[~stereo, 2] = 1e6  # without depth, no weight
    S = (spread * own_sigmas[:, None] ** 2) @ np.swapaxes(spread, 1, 2)
    W = np.linalg.inv(S + sigmas[:, None] ** 2 * np.eye(3))
    return r, J, W * known[:, None, None]
