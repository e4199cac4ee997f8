"""What holds a keyframe that factors hold no more: a loose bridge to a neighbour, or a prior.

A keyframe that no chain of shared landmarks ties to a prior is bridged to the neighbour that
shared most with it; a part of the graph without any prior gets one at its current estimate. A
bridge leaves again when other factors hold its keyframe.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.factors.factor_tables import NO_SLOT, FactorTables, ids_array
from bmask_slam.graph.factors.graph_update import Observations, PosePrior, RelativePose
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
    loose: Ints, gone: Observations, edges: Edges, tables: FactorTables, config: SmootherConfig
) -> list[int]:
    """Bridge or anchor loose keyframes until none is left; numbers of the factors added.

    ``gone`` and ``edges`` are what was taken just before: each keyframe is tied inside the part
    of the graph that it was in then, to the firm keyframe that shared most with it.
    """
    added: list[int] = []
    before = _Before.of(gone, edges, tables) if len(loose) else None
    while before is not None and len(loose):
        factor = before.anchor_for(loose, tables, config)
        added += tables.add_pose_factors([factor])
        loose = loose_in(tables, config)
    return added


def loose_in(tables: FactorTables, config: SmootherConfig) -> Ints:
    """The keyframes of the graph that nothing ties firmly to a prior."""
    numbers = tables.pose_factors
    return loose_among(
        tables.keyframes.ids, tables.observations.used_rows(), numbers, tables, config
    )


def anchor_components(tables: FactorTables, config: SmootherConfig) -> list[int]:
    """Give each connected part of the graph without a prior one; numbers of the new priors."""
    ids, edges = tables.keyframes.ids, [f.keyframes for f in tables.pose_factors.values()]
    seen = tables.observations.select(tables.observations.used_rows())
    labels = component_labels(ids, seen, edges)
    fixed = labels[np.searchsorted(ids, [edge[0] for edge in edges if len(edge) == 1])]
    parts, first = np.unique(labels, return_index=True)
    loose = np.sort(ids[first[~np.isin(parts, fixed)]])
    return tables.add_pose_factors([prior_here(k, tables, config) for k in loose.tolist()])


def release_anchors(
    new: Observations, tables: FactorTables, config: SmootherConfig
) -> tuple[Ints, list[int]]:
    """Take out the bridges that new observations, in the shadow already, made needless.

    Returns the keyframes that they held, and their places in ISAM2.
    """
    table = tables.observations
    rows = table.rows_of_landmarks(np.unique(new.landmark_ids).tolist())
    touched = np.unique(table.select(rows).keyframe_ids)
    bridges = [
        number
        for number in tables.numbers_of_keyframes(touched.tolist())
        if getattr(tables.pose_factors[number].factor, "kind", "") == "bridge"
    ]
    if not bridges:
        return np.zeros(0, np.int64), []
    others = set(tables.pose_factors) - set(bridges)
    loose = loose_among(
        tables.keyframes.ids, tables.observations.used_rows(), others, tables, config
    )
    held = keyframes_held_by(bridges, tables)
    released = [n for n in bridges if tables.pose_factors[n].keyframes[-1] not in loose]
    slots = [tables.pose_factors[number].slot for number in released]
    tables.remove_pose_factors(released)
    return np.setdiff1d(held, loose), [slot for slot in slots if slot != NO_SLOT]


def prior_here(keyframe: int, tables: FactorTables, config: SmootherConfig) -> PosePrior:
    """A prior at a keyframe's current estimate, with the sigmas of the first pose's prior."""
    covariance = diagonal_covariance(
        config.prior_sigma_rotation_rad, config.prior_sigma_translation_m
    )
    T_world_camera = tables.keyframes.get(np.array([keyframe]))[0]
    return PosePrior(keyframe, T_world_camera, covariance)


def bridge(a: int, b: int, tables: FactorTables, config: SmootherConfig) -> RelativePose:
    """A loose relative pose between two keyframes at their current estimates."""
    T_world_a, T_world_b = tables.keyframes.get(np.array([a, b]))
    covariance = diagonal_covariance(
        config.anchor_sigma_rotation_rad, config.anchor_sigma_translation_m
    )
    return RelativePose(a, b, inverse(T_world_a) @ T_world_b, covariance, kind="bridge")


def keyframes_held_by(numbers: list[int], tables: FactorTables) -> Ints:
    """The keyframes (N,) that these bridges and priors were made for."""
    return ids_array(tables.pose_factors[number].keyframes[-1] for number in numbers)


def loose_among(
    ids: Ints,
    rows: Ints,
    numbers: Iterable[int],
    tables: FactorTables,
    config: SmootherConfig,
) -> Ints:
    """The keyframes that these rows and pose factors of the shadow would leave loose."""
    seen, poses, points = rows_in_front(rows, tables, config)
    edges = [tables.pose_factors[number].keyframes for number in sorted(numbers)]
    return loose_keyframes(ids, seen, (poses, points), edges, config)


def rows_in_front(
    rows: Ints, tables: FactorTables, config: SmootherConfig
) -> tuple[Observations, Array, Array]:
    """Those of the rows whose landmark lies before the camera, their poses and points.

    A factor with its landmark behind the camera has a zero Jacobian.
    """
    seen = tables.observations.select(rows)
    poses = tables.keyframes.get(seen.keyframe_ids)
    points = tables.landmarks.get(seen.landmark_ids)
    depth_m = np.einsum("ij,ij->i", points - poses[:, :3, 3], poses[:, :3, 2])
    front = depth_m >= config.min_depth_m
    return seen.select(front), poses[front], points[front]


@dataclass(frozen=True)
class _Before:
    """How the keyframes that are left hung together before a removal.

    Attributes:
        parts: (K,) connected part of each keyframe.
        shared: (K, K) landmarks and relative poses that two of them shared.
    """

    parts: Ints
    shared: Array

    @classmethod
    def of(cls, gone: Observations, edges: Edges, tables: FactorTables) -> _Before:
        """From the shadow as it is and what was taken from it."""
        table = tables.observations
        seen = table.select(table.used_rows())
        seen = Observations(
            np.concatenate([seen.keyframe_ids, gone.keyframe_ids]),
            np.concatenate([seen.landmark_ids, gone.landmark_ids]),
        )
        edges = [*edges, *(f.keyframes for f in tables.pose_factors.values())]
        ends = np.array([k for edge in edges for k in edge], np.int64)
        ids = np.unique(np.concatenate([tables.keyframes.ids, seen.keyframe_ids, ends]))
        shared = shared_landmarks(ids, seen).toarray()
        pairs = np.array([edge for edge in edges if len(edge) == 2], np.int64).reshape(-1, 2)
        a, b = np.searchsorted(ids, pairs.T)
        np.add.at(shared, (np.concatenate([a, b]), np.concatenate([b, a])), 1)
        left = np.searchsorted(ids, tables.keyframes.ids)
        return cls(component_labels(ids, seen, edges)[left], shared[np.ix_(left, left)])

    def anchor_for(
        self, loose: Ints, tables: FactorTables, config: SmootherConfig
    ) -> PosePrior | RelativePose:
        """A prior in a part without any firm keyframe; else the bridge that shared most."""
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
        return bridge(int(ids[columns[column]]), int(ids[rows[row]]), tables, config)
