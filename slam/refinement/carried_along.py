"""Frames, landmarks and the saved map of a run, moved with its adjusted graph."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from bmask_slam.back_end.factor_selection import read_back
from bmask_slam.graph.arrays import Array, Arrays, Ints
from bmask_slam.graph.batch.bundle_adjustment import Adjustment
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.files.array_file import nested, part
from bmask_slam.graph.geometry import inverse, se3_exp, se3_log
from bmask_slam.graph.smoother.smoother import Smoother
from bmask_slam.graph.smoother.storage import graph_arrays
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.refinement.adjustment_plot import GraphSnapshot
from bmask_slam.world.map_state import world_of, world_state

_WORLD, _GRAPH, _LOOPS = "mapper.world.", "mapper.graph.", "mapper.loops."


def move_frames(
    trajectory: Trajectory, stamps_s: Array, poses_before: Array, poses_after: Array
) -> Trajectory:
    """Frames moved with the keyframes, whose poses (K, 4, 4) changed from ``before`` to ``after``.

    A frame has two predictions, each rigid with one of the two keyframes around it. They are
    blended by time along the geodesic between them, so that there is no step at a keyframe. Before
    the first and after the last keyframe there is one prediction. Keyframes whose stamps (K,) are
    NaN or of no frame of this trajectory do not count.
    """
    own = np.flatnonzero(np.isin(_microseconds(stamps_s), _microseconds(trajectory.timestamps_s)))
    if not len(own):
        return trajectory
    own = own[np.argsort(stamps_s[own])]
    stamps_s, t_s = stamps_s[own], trajectory.timestamps_s
    T_new_old = poses_after[own] @ inverse(poses_before[own])
    left = np.clip(np.searchsorted(stamps_s, t_s, side="right") - 1, 0, len(own) - 1)
    right = np.minimum(left + 1, len(own) - 1)
    by_left, by_right = (T_new_old[k] @ trajectory.poses_world_camera for k in (left, right))
    step_s = np.maximum(stamps_s[right] - stamps_s[left], 1e-9)
    share = np.clip((t_s - stamps_s[left]) / step_s, 0.0, 1.0)
    blended = by_left @ se3_exp(share[:, None] * se3_log(inverse(by_left) @ by_right))
    return Trajectory(t_s, blended)


def _microseconds(stamps_s: Array) -> Ints:
    """Stamps in the resolution of the files; -1 for NaN."""
    return np.where(np.isfinite(stamps_s), np.rint(stamps_s * 1e6), -1.0).astype(np.int64)


def move_landmarks(
    columns: Arrays, before: GraphSnapshot, tables: FactorTables, adjustment: Adjustment
) -> Arrays:
    """Columns of landmarks.ply after the adjustment; without those that it dropped.

    A landmark outside the graph moves rigidly with the first keyframe that observes its nearest
    neighbour in the graph, since the run folder does not say which keyframe created it.
    """
    columns = {name: column.copy() for name, column in columns.items()}
    ids = columns["id"].astype(np.int64)
    points = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(float)
    inside = tables.landmarks.contains(ids)
    dropped = np.isin(ids, adjustment.dropped_landmarks)
    outside = np.flatnonzero(~inside & ~dropped)
    if inside.any() and len(outside):
        points[outside] = _move_with_neighbours(points[outside], before, tables)
    points[inside] = tables.landmarks.get(ids[inside])
    for axis, values in zip("xyz", points.T, strict=True):
        columns[axis] = values.astype(columns[axis].dtype)
    left, views = np.unique(adjustment.wrong_observations[:, 1], return_counts=True)
    _, at, which = np.intersect1d(ids, left, return_indices=True)
    columns["observations"][at] -= views[which].astype(columns["observations"].dtype)
    return {name: column[~dropped] for name, column in columns.items()}


def _move_with_neighbours(points: Array, before: GraphSnapshot, tables: FactorTables) -> Array:
    """Points (N, 3) moved with the first observer of the nearest landmark of the graph."""
    observations = tables.observations.all()  # by keyframe
    landmark_ids, first = np.unique(observations.landmark_ids, return_index=True)
    observer = observations.keyframe_ids[first]
    where = before.points_world[np.searchsorted(before.landmark_ids, landmark_ids)]
    _, nearest = KDTree(where).query(points)
    keyframes = observer[nearest]
    T_old = before.poses_world_camera[np.searchsorted(before.keyframe_ids, keyframes)]
    T_new_old = tables.keyframes.get(keyframes) @ inverse(T_old)
    return (T_new_old[:, :3, :3] @ points[..., None])[..., 0] + T_new_old[:, :3, 3]


def adjusted_map(
    state: Arrays, tables: FactorTables, adjustment: Adjustment, camera: Camera, path: Path
) -> Arrays:
    """A map's state, from ``read_map``, with its graph replaced by the adjusted one.

    As at the end of a run, landmarks that left the graph stay in the map, and those outside it move
    with the keyframes that created them. Loops that the adjustment found wrong are removed.

    Raises:
        InputError: the graph does not fit the map; ``path`` names it.
    """
    graph = graph_arrays(tables)
    smoother = Smoother(camera)
    smoother.restore(graph, path)
    world = world_of(part(state, _WORLD[:-1]))
    read_back(world, smoother.estimate())
    loops = part(state, _LOOPS[:-1])
    wrong = set(map(tuple, adjustment.wrong_loops.tolist()))
    kept = [ends not in wrong for ends in map(tuple, loops["closed"].tolist())]
    loops |= {name: loops[name][kept] for name in ("closed", "believed")}
    others = {
        name: array
        for name, array in state.items()
        if not name.startswith((_WORLD, _GRAPH, _LOOPS))
    }
    mapper = nested(world=world_state(world), graph=graph, loops=loops)
    return others | nested(mapper=mapper)
