"""Anchors: weak between factors and priors that hold underconstrained keyframes.

A keyframe that no chain of shared landmarks connects to a prior gets a weak between factor to the
neighbour that shared most with it; a component of the graph without any prior gets one at its
current estimate. A weak between factor is removed again when other factors constrain its keyframe.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from bmask_slam.graph.arrays import Array, Ints, no_ids
from bmask_slam.graph.factors.factor_tables import NO_SLOT, FactorTables, ids_array
from bmask_slam.graph.factors.graph_update import (
    ANCHOR,
    GraphUpdate,
    Observations,
    PosePrior,
    RelativePose,
)
from bmask_slam.graph.factors.observability import (
    Edges,
    component_labels,
    diagonal_covariance,
    loose_keyframes,
    shared_landmarks,
)
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.geometry import inverse


def anchor_loose(
    loose: Ints, removed: Observations, edges: Edges, tables: FactorTables, config: SmootherConfig
) -> list[int]:
    """Anchor loose keyframes until none is left; returns the numbers of the factors added.

    ``removed`` (observations) and ``edges`` (pose factors) were removed just before: each keyframe
    is anchored inside the component that it was in then, to the firm keyframe that shared most with
    it.
    """
    added: list[int] = []
    before = _Before.of(removed, edges, tables) if len(loose) else None
    while before is not None and len(loose):
        factor = before.anchor_for(loose, tables, config)
        added += tables.add_pose_factors([factor])
        loose = loose_in(tables, config)
    return added


def loose_in(tables: FactorTables, config: SmootherConfig) -> Ints:
    """The keyframes of the graph that are not firmly connected to a prior."""
    numbers = tables.pose_factors
    return loose_among(
        tables.keyframes.ids, tables.observations.used_rows(), numbers, tables, config
    )


def anchor_components(tables: FactorTables, config: SmootherConfig) -> list[int]:
    """Add a prior to each connected component without one; returns their numbers."""
    ids, edges = tables.keyframes.ids, [f.link for f in tables.pose_factors.values()]
    observations = tables.observations.select(tables.observations.used_rows())
    labels = component_labels(ids, observations, edges)
    fixed = labels[np.searchsorted(ids, [edge[0] for edge in edges if len(edge) == 1])]
    parts, first = np.unique(labels, return_index=True)
    loose = np.sort(ids[first[~np.isin(parts, fixed)]])
    return tables.add_pose_factors([prior_here(k, tables, config) for k in loose.tolist()])


def release_anchors(
    new: Observations, tables: FactorTables, config: SmootherConfig
) -> tuple[Ints, list[int]]:
    """Remove the weak between factors that new observations, already added, make unnecessary.

    Returns the keyframes that they held, and their slots in ISAM2.
    """
    table = tables.observations
    rows = table.rows_of_landmarks(np.unique(new.landmark_ids).tolist())
    touched = np.unique(table.select(rows).keyframe_ids)
    anchors = [
        number
        for number in tables.numbers_of_keyframes(touched.tolist())
        if tables.pose_factors[number].factor.kind == ANCHOR
    ]
    if not anchors:
        return no_ids(), []
    others = set(tables.pose_factors) - set(anchors)
    loose = loose_among(
        tables.keyframes.ids, tables.observations.used_rows(), others, tables, config
    )
    anchored = keyframes_anchored_by(anchors, tables)
    released = [n for n in anchors if tables.pose_factors[n].keyframes[-1] not in loose]
    slots = [tables.pose_factors[number].slot for number in released]
    tables.remove_pose_factors(released)
    return np.setdiff1d(anchored, loose), [slot for slot in slots if slot != NO_SLOT]


def with_first_prior(
    update: GraphUpdate, tables: FactorTables, config: SmootherConfig
) -> GraphUpdate:
    """The update, with a prior on its first keyframe if the graph is empty and it brings none."""
    if len(tables.keyframes.ids) or update.priors or not len(update.keyframe_ids):
        return update
    first = int(np.argmin(update.keyframe_ids))
    keyframe, T_world_camera = int(update.keyframe_ids[first]), update.poses_world_camera[first]
    return replace(update, priors=(firm_prior(keyframe, T_world_camera, config),))


def prior_here(keyframe: int, tables: FactorTables, config: SmootherConfig) -> PosePrior:
    """A prior at a keyframe's current estimate, with the sigmas of the first pose's prior."""
    return firm_prior(keyframe, tables.keyframes.get(np.array([keyframe]))[0], config)


def firm_prior(keyframe: int, T_world_camera: Array, config: SmootherConfig) -> PosePrior:
    """A prior with the sigmas of the first pose's: it fixes a coordinate frame."""
    covariance = diagonal_covariance(
        config.prior_sigma_rotation_rad, config.prior_sigma_translation_m
    )
    return PosePrior(keyframe, T_world_camera, covariance)


def weak_between(a: int, b: int, tables: FactorTables, config: SmootherConfig) -> RelativePose:
    """A weak between factor of two keyframes at their current estimates."""
    return anchor_between(a, b, tables.keyframes.get(np.array([a, b])), config)


def anchor_between(
    a: int, b: int, T_world_keyframes: Array, config: SmootherConfig
) -> RelativePose:
    """A weak between factor of two keyframes at these poses (2, 4, 4)."""
    T_world_a, T_world_b = T_world_keyframes
    covariance = diagonal_covariance(
        config.anchor_sigma_rotation_rad, config.anchor_sigma_translation_m
    )
    return RelativePose(a, b, inverse(T_world_a) @ T_world_b, covariance, kind=ANCHOR)


def keyframes_anchored_by(numbers: list[int], tables: FactorTables) -> Ints:
    """The keyframes (N,) that these anchors were added for."""
    return ids_array(tables.pose_factors[number].keyframes[-1] for number in numbers)


def loose_among(
    ids: Ints, rows: Ints, numbers: Iterable[int], tables: FactorTables, config: SmootherConfig
) -> Ints:
    """The keyframes that would be loose with these rows and pose factors alone."""
    observations, poses, points = rows_in_front(rows, tables, config)
    edges = [tables.pose_factors[number].link for number in sorted(numbers)]
    return loose_keyframes(ids, observations, poses, points, edges, config)


def rows_in_front(
    rows: Ints, tables: FactorTables, config: SmootherConfig
) -> tuple[Observations, Array, Array]:
    """Those of the rows whose landmark lies in front of the camera, their poses and points.

    A factor with its landmark behind the camera has a zero Jacobian.
    """
    observations = tables.observations.select(rows)
    poses, points = tables.values_of(observations)
    front = depths_m(poses, points) >= config.min_depth_m
    return observations.select(front), poses[front], points[front]


def depths_m(poses_world_camera: Array, points_world: Array) -> Array:
    """Depths (M,) of points (M, 3) along the optical axes of cameras (M, 4, 4)."""
    offsets = points_world - poses_world_camera[:, :3, 3]
    return np.einsum("ij,ij->i", offsets, poses_world_camera[:, :3, 2])


@dataclass(frozen=True)
class _Before:
    """How the remaining keyframes were connected before a removal.

    Attributes:
        parts: (K,) connected component of each keyframe.
        shared: (K, K) number of landmarks and relative poses that two of them shared.
    """

    parts: Ints
    shared: Array

    @classmethod
    def of(cls, removed: Observations, edges: Edges, tables: FactorTables) -> _Before:
        """From the factor tables as they are and what was removed from them."""
        table = tables.observations
        observations = table.select(table.used_rows())
        observations = Observations(
            np.concatenate([observations.keyframe_ids, removed.keyframe_ids]),
            np.concatenate([observations.landmark_ids, removed.landmark_ids]),
        )
        edges = [*edges, *(f.link for f in tables.pose_factors.values())]
        ends = np.array([k for edge in edges for k in edge], np.int64)
        ids = np.unique(np.concatenate([tables.keyframes.ids, observations.keyframe_ids, ends]))
        shared = shared_landmarks(ids, observations).toarray()
        pairs = np.array([edge for edge in edges if len(edge) == 2], np.int64).reshape(-1, 2)
        a, b = np.searchsorted(ids, pairs.T)
        np.add.at(shared, (np.concatenate([a, b]), np.concatenate([b, a])), 1)
        left = np.searchsorted(ids, tables.keyframes.ids)
        return cls(component_labels(ids, observations, edges)[left], shared[np.ix_(left, left)])

    def anchor_for(
        self, loose: Ints, tables: FactorTables, config: SmootherConfig
    ) -> PosePrior | RelativePose:
        """A prior in a component without any firm keyframe, else a weak between factor."""
        ids = tables.keyframes.ids
        is_loose = np.isin(ids, loose)
        unfixed = is_loose & ~np.isin(self.parts, self.parts[~is_loose])
        if unfixed.any():
            return prior_here(int(ids[unfixed][0]), tables, config)
        rows, columns = np.flatnonzero(is_loose), np.flatnonzero(~is_loose)
        same = self.parts[rows][:, None] == self.parts[columns]
        shared = np.where(same, self.shared[np.ix_(rows, columns)], -1)
        apart = np.abs(ids[rows][:, None] - ids[columns])
        best = np.lexsort((apart.ravel(), -shared.ravel()))[0]
        row, column = np.unravel_index(best, shared.shape)
        return weak_between(int(ids[columns[column]]), int(ids[rows[row]]), tables, config)
