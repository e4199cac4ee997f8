"""Summaries of marginalised landmarks: one observation that stands for all of a landmark's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_update import GraphUpdate, Observations, concatenate
from bmask_slam.graph.factors.marginalised_landmarks import MarginalisedLandmarks, Summary
from bmask_slam.graph.geometry import inverse
from bmask_slam.graph.marginals.point_elimination import PointInformation, projection_jacobian


def make_summaries(
    observations: Observations, points: PointInformation, tables: FactorTables, camera: Camera
) -> list[Summary]:
    """One observation a landmark, in the base that observes most of them, else in a keyframe.

    Its covariance in u, v and disparity is not diagonal; the diagonal is scaled by the largest
    eigenvalue of the correlations, so that the sigmas are never too small.
    """
    in_base = np.isin(observations.keyframe_ids, sorted(tables.marginalised.bases))
    _, which, count = np.unique(observations.keyframe_ids, return_inverse=True, return_counts=True)
    order = np.lexsort((count[which], in_base, observations.landmark_ids))
    last = np.append(np.flatnonzero(np.diff(observations.landmark_ids[order])), len(order) - 1)
    hosts = observations.keyframe_ids[order[last]]
    T_host_world = inverse(tables.keyframes.get(hosts))
    p = (T_host_world[:, :3, :3] @ points.points_world[:, :, None])[:, :, 0]
    p += T_host_world[:, :3, 3]
    J = projection_jacobian(p, camera) @ T_host_world[:, :3, :3]
    covariances = J @ points.covariances @ np.swapaxes(J, 1, 2)
    sigmas = np.sqrt(np.einsum("lii->li", covariances))
    correlations = covariances / (sigmas[:, :, None] * sigmas[:, None, :])
    sigmas *= np.sqrt(np.linalg.eigvalsh(correlations)[:, -1:])
    measured = camera.project_stereo(p)
    return [Summary(int(k), z, s) for k, z, s in zip(hosts, measured, sigmas, strict=True)]


def points_of(ids: Ints, tables: FactorTables, camera: Camera) -> Array:
    """Points (N, 3) of landmarks (N,): of the graph, or given by summaries and their keyframes."""
    points = np.zeros((len(ids), 3))
    inside = tables.landmarks.contains(ids)
    points[inside] = tables.landmarks.get(ids[inside])
    summaries = [tables.marginalised.summaries[j] for j in ids[~inside].tolist()]
    if summaries:
        z = np.array([s.measurement for s in summaries])
        hosts = np.array([s.keyframe_id for s in summaries], np.int64)
        p = camera.backproject(z[:, :2], camera.stereo_bf_px_m / (z[:, 0] - z[:, 2]))
        T = tables.keyframes.get(hosts)
        points[~inside] = (T[:, :3, :3] @ p[:, :, None])[:, :, 0] + T[:, :3, 3]
    return points


def with_returning(update: GraphUpdate, tables: FactorTables, camera: Camera) -> GraphUpdate:
    """The update with the summaries and points of the marginalised landmarks that it names."""
    marginalised = tables.marginalised
    known = np.array([j in marginalised.summaries for j in update.landmark_ids.tolist()], bool)
    if not known.any():
        return update
    ids = update.landmark_ids[known]
    points = update.points_world.copy()
    points[known] = points_of(ids, tables, camera)
    summaries = [marginalised.summaries[j] for j in ids.tolist()]
    again = Observations(
        np.array([s.keyframe_id for s in summaries], np.int64),
        ids,
        np.array([s.measurement for s in summaries]),
        np.array([s.sigmas_px for s in summaries]),
    )
    return replace(
        update, points_world=points, observations=concatenate([again, update.observations])
    )


def mark_returned(landmark_ids: Ints, marginalised: MarginalisedLandmarks) -> None:
    """These landmarks entered the graph; those that were marginalised are so no longer."""
    for landmark in landmark_ids.tolist():
        marginalised.returned.pop(landmark, None)
        if landmark in marginalised.summaries:
            marginalised.returned[landmark] = marginalised.summaries.pop(landmark)


def mark_retracted(landmark_ids: Ints, marginalised: MarginalisedLandmarks) -> None:
    """These landmarks were removed again: those that had come back are marginalised as before."""
    for landmark in landmark_ids.tolist():
        if landmark in marginalised.returned:
            marginalised.summaries[landmark] = marginalised.returned.pop(landmark)
