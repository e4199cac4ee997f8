"""What a graph that is built anew keeps of sensors whose measurements are gone.

Poses of the graph that are no keyframes (reference frames, planes, markers) follow the keyframes
that measured them, which may be in another segment now.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bmask_slam.graph.arrays import Array, Arrays
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_update import (
    FIRST_FRAME,
    FRAMES_OF_A_KIND,
    MARKER,
    PosePrior,
    RelativePose,
    RelativePoseName,
    marker_id,
    marker_of,
    plane_id,
)
from bmask_slam.graph.factors.observability import diagonal_covariance
from bmask_slam.graph.files.array_file import nested
from bmask_slam.graph.geometry import inverse
from bmask_slam.graph.sensors.streams import COLUMNS
from bmask_slam.sensing.reference_frame import (
    RETIRED_FRAME,
    SIGMA_M,
    SIGMA_RAD,
    Made,
    SensorChanges,
)
from bmask_slam.world.world_map import WorldMap


def carried_frames(
    factors: Sequence[RelativePose], old: FactorTables, world: WorldMap
) -> SensorChanges:
    """Factors of another graph for a new one, with reference frames where their keyframes are now.

    A frame whose segment is no more gets an id that no segment has; markers are those of the
    segment in which their keyframes are. Where that has the same marker already, the other one
    keeps its id until `back_end.marker_loops.unite_markers` has compared their places.
    """
    segments = {k.segment for k in world.keyframes.values()}
    pairs = [(f.keyframe_a, f.keyframe_b) for f in factors if f.keyframe_a >= FIRST_FRAME]
    planes = plane_id(0)
    free = max([RETIRED_FRAME, *(a + 1 for a, _ in pairs if a < planes)])
    ids: dict[int, int] = {}
    poses: dict[int, Array] = {}
    homes = {a: _marker_where(a, world.keyframes[b].segment) for a, b in pairs}
    markers_in_place_first = sorted(dict(pairs).items(), key=lambda p: (homes[p[0]] != p[0], p))
    for frame, keyframe in markers_in_place_first:
        segment, home = (frame - FIRST_FRAME) % FRAMES_OF_A_KIND, homes[frame]
        stays = segment in segments or RETIRED_FRAME <= frame < planes
        ids[frame] = frame if stays else free
        if marker_of(frame) is not None:
            ids[frame] = frame if home in ids.values() else home
        free += ids[frame] == free
        T_old, T_frame = old.keyframes.get(np.array([keyframe, frame]))
        poses.setdefault(
            ids[frame], world.keyframes[keyframe].T_world_camera @ inverse(T_old) @ T_frame
        )
    covariance = diagonal_covariance(SIGMA_RAD, SIGMA_M)
    held = [(i, T) for i, T in poses.items() if marker_of(i) is None]
    return SensorChanges(
        np.array(list(poses), np.int64),
        np.array(list(poses.values())).reshape(-1, 4, 4),
        tuple(PosePrior(i, T, covariance) for i, T in held),
        tuple(replace(f, keyframe_a=ids.get(f.keyframe_a, f.keyframe_a)) for f in factors),
    )


def _marker_where(frame: int, segment: int) -> int:
    """The id that a marker has in a map segment; other frames keep theirs."""
    marker = marker_of(frame)
    return frame if marker is None else marker_id(segment, marker[1])


def carried_verdicts(made: Made, first_keyframe: int, world: WorldMap) -> Made:
    """Refused sightings of markers by keyframes of earlier recordings, with the markers' ids."""
    return {
        (_marker_where(a, world.keyframes[b].segment), b, kind): verdict
        for (a, b, kind), verdict in made.items()
        if kind == MARKER and not np.isnan(verdict) and b < first_keyframe and b in world.keyframes
    }


def example_state() -> Arrays:
    """The arrays that a state has when there are measurements of all sensors, without rows."""
    rows = {sensor: np.zeros((0, len(names))) for sensor, names in COLUMNS.items()}
    made: Arrays = {"made": np.zeros((0, 3), np.int64), "made_s": np.zeros(0)}
    plumbs: Arrays = {"plumb_ids": np.zeros(0, np.int64), "plumbs": np.zeros((0, 13))}
    first: Arrays = {"first_keyframe": np.array(0), "newest": np.zeros(0)}
    found: Arrays = {"marker_sizes": np.zeros((0, 3)), "imu_mounting": np.zeros(0)}
    return {**nested(streams=rows), **first, **made, **plumbs, **found}


def is_known(name: RelativePoseName, world: WorldMap) -> bool:
    """Whether the keyframes of a factor are in the map."""
    return all(k >= FIRST_FRAME or k in world.keyframes for k in name[:2])
