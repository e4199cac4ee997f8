"""Which variables are constrained: landmarks by their views, keyframes by a chain to a prior."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from bmask_slam.graph.arrays import Array, Ints, distinct, numbered
from bmask_slam.graph.factors.graph_update import Observations
from bmask_slam.graph.factors.smoother_config import SmootherConfig

Edges = Sequence[tuple[int, ...]]
"""Keyframe ids of pose factors: one for a prior, two for a relative pose."""


def constrained_landmarks(
    observations: Observations,
    poses_world_camera: Array,
    points_world: Array,
    min_parallax_deg: float,
) -> Ints:
    """Sorted ids of the landmarks that these observations alone constrain.

    ``poses_world_camera`` (M, 4, 4) and ``points_world`` (M, 3) are those of each observation, in
    any order. The parallax is the angle between the ray from a landmark's first
    keyframe and any other: at least half of the largest angle between any two.
    """
    stereo = np.isfinite(observations.measurements[:, 2])
    by_stereo = distinct(observations.landmark_ids[stereo])
    rows = np.flatnonzero(~np.isin(observations.landmark_ids, by_stereo))
    if not len(rows):
        return by_stereo
    rows = rows[np.lexsort((observations.keyframe_ids[rows], observations.landmark_ids[rows]))]
    ids, first, group = np.unique(
        observations.landmark_ids[rows], return_index=True, return_inverse=True
    )
    rays = points_world[rows] - poses_world_camera[rows, :3, 3]
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    between = np.linalg.norm(np.cross(rays, rays[first][group]), axis=1)
    angle_rad = np.arctan2(between, np.sum(rays * rays[first][group], axis=1))
    widest_rad = np.maximum.reduceat(angle_rad, first)
    return np.sort(np.concatenate([by_stereo, ids[widest_rad >= np.radians(min_parallax_deg)]]))


def loose_keyframes(
    ids: Ints,
    observations: Observations,
    poses_world_camera: Array,
    points_world: Array,
    edges: Edges,
    config: SmootherConfig,
) -> Ints:
    """Those of the sorted ids (K,) that are not firmly connected to a prior.

    Grown from the priors: a keyframe is firm by a relative pose to a firm one, or by
    ``min_left_observations`` landmarks that firm ones observe. A landmark counts if the firm
    ones constrain it, or if the keyframe itself measures its depth: one that is monocular in all
    views would leave the scale open. Poses (M, 4, 4) and points (M, 3) are those of each
    observation.
    """
    keyframe = np.searchsorted(ids, observations.keyframe_ids)
    names, landmark = numbered(observations.landmark_ids)
    stereo = np.isfinite(observations.measurements[:, 2])
    places = [np.searchsorted(ids, edge) for edge in edges]
    pairs = np.array([place for place in places if len(place) == 2], np.int64).reshape(-1, 2)
    firm = np.zeros(len(ids), bool)
    firm[[place[0] for place in places if len(place) == 1]] = True
    while True:
        inside = firm[keyframe]
        observed, known = np.zeros(len(names), bool), np.zeros(len(names), bool)
        observed[landmark[inside]] = True
        known[landmark[inside & stereo]] = True
        rest = np.flatnonzero(inside & ~known[landmark])
        values = poses_world_camera[rest], points_world[rest]
        by_rays = constrained_landmarks(observations.select(rest), *values, config.min_parallax_deg)
        known[np.searchsorted(names, by_rays)] = True
        counts = known[landmark] | (stereo & observed[landmark])
        shared = np.bincount(keyframe[counts], minlength=len(ids))
        now = firm | (shared >= config.min_left_observations)
        now[pairs[now[pairs].any(axis=1)].ravel()] = True
        if (now == firm).all():
            return ids[~firm]
        firm = now


def firm_components(ids: Ints, observations: Observations, edges: Edges, minimum: int) -> Ints:
    """The number (K,) of the component that each of the sorted ids is in, by firm links alone.

    A link is a relative pose between two of them, or ``minimum`` landmarks that both observe and
    whose depth one of them measures.
    """
    stereo = np.isfinite(observations.measurements[:, 2])
    monocular = observations.select(~stereo)
    shared = shared_landmarks(ids, observations)
    if len(monocular):
        shared = shared - shared_landmarks(ids, monocular)
    row, column = (shared >= minimum).nonzero()
    pairs = np.array([edge for edge in edges if len(edge) == 2], np.int64).reshape(-1, 2)
    ends = np.searchsorted(ids, pairs[np.isin(pairs, ids).all(axis=1)])
    starts, stops = np.concatenate([row, ends[:, 0]]), np.concatenate([column, ends[:, 1]])
    links = coo_array((np.ones(len(starts), np.int8), (starts, stops)), (len(ids), len(ids)))
    return connected_components(links, directed=False)[1].astype(np.int64)


def component_labels(ids: Ints, observations: Observations, edges: Edges) -> Ints:
    """The number (K,) of the connected component that each of the sorted ids is in."""
    names, landmark = numbered(observations.landmark_ids)
    pairs = np.array([edge for edge in edges if len(edge) == 2], np.int64).reshape(-1, 2)
    starts = np.searchsorted(ids, np.concatenate([observations.keyframe_ids, pairs[:, 0]]))
    ends = np.concatenate([len(ids) + landmark, np.searchsorted(ids, pairs[:, 1])])
    size = len(ids) + len(names)
    links = coo_array((np.ones(len(starts), np.int8), (starts, ends)), (size, size))
    return connected_components(links, directed=False)[1][: len(ids)].astype(np.int64)


def shared_landmarks(ids: Ints, observations: Observations) -> csr_array:
    """How many landmarks each two of the sorted ids (K,) share: (K, K), sparse."""
    names, landmark = numbered(observations.landmark_ids)
    rows = np.searchsorted(ids, observations.keyframe_ids)
    ones = np.ones(len(rows), np.int64)
    sees = coo_array((ones, (rows, landmark)), (len(ids), len(names))).tocsr()
    return (sees @ sees.T).tocsr()


def diagonal_covariance(sigma_rotation_rad: float, sigma_translation_m: float) -> Array:
    """A (6, 6) covariance with one sigma for all rotations and one for all translations."""
    return np.diag([sigma_rotation_rad**2] * 3 + [sigma_translation_m**2] * 3)
