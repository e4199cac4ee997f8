"""The last adjustment of a run: the whole map together with the frames that are no keyframes."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from bmask_slam.back_end.factor_selection import read_back
from bmask_slam.back_end.factors import observations_in
from bmask_slam.back_end.mapper import Mapper
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.batch.joint_adjustment import Frames, adjust_jointly
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_update import Observations, concatenate
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.smoother.isam2 import SolverError
from bmask_slam.graph.trajectory import MAX_STAMP_ERROR_S, Trajectory, nearest_indices
from bmask_slam.world.frame_observations import FrameObservations, FrameView
from bmask_slam.world.world_map import WorldMap

logger = logging.getLogger(__name__)

MIN_LANDMARKS = 15
"""A frame that observes fewer landmarks of the map keeps its pose beside its keyframe."""
MAX_OBSERVATIONS = 500_000
"""Of keyframes and frames; beyond, nothing is done: it would take minutes."""


def adjust_with_frames(mapper: Mapper, frames: FrameObservations, config: SmootherConfig) -> None:
    """Adjust map and graph with what other frames observe too, and give these their poses."""
    smoother, history = mapper.smoother, mapper.history
    paths = history.trajectories(mapper.world).values()
    stamps_s, given = frames_in(frames.views, mapper.world, smoother.tables, paths, mapper.camera)
    if not len(stamps_s):
        return
    try:
        found = adjust_jointly(smoother.tables, given, mapper.camera, config)
    except SolverError as error:
        logger.warning("the map is not adjusted with other frames: %s", error)
        return
    logger.info(
        "keyframes and %d other frames adjusted together: cost %.0f -> %.0f in %d steps, "
        "%d of %d observations of these left out",
        *(len(stamps_s), found.cost_before, found.cost_after, found.steps),
        *(found.outliers, len(given.observations)),
    )
    smoother.restart()
    read_back(mapper.world, smoother.estimate())
    history.place(mapper.world, Trajectory(stamps_s, found.poses_world_camera))


def frames_in(
    views: Sequence[FrameView],
    world: WorldMap,
    tables: FactorTables,
    paths: Iterable[Trajectory],
    camera: Camera,
) -> tuple[Array, Frames]:
    """Stamps (F,) of the frames that observe enough of the graph, and what they observe.

    They begin at their poses in the paths. The errors of images in a row are alike: the same patch
    of a landmark and the same error of the depth sensor are in all of them. So all frames together
    count as much as the keyframes: their sigmas are larger by the root of how many more they are.
    Loops and sensors get so much more weight that beside them the images count as in the graph.
    Both are empty if graph and frames have more observations than ``MAX_OBSERVATIONS``.
    """
    known, bf, depth_factor = tables.landmarks, camera.stereo_bf_px_m, camera.graph_depth_factor
    parts: list[Observations] = []
    poses: list[Array] = []
    stamps_s: list[float] = []
    for view, pose in _with_poses(views, paths):
        exist = np.flatnonzero(view.landmark_ids < len(world.landmarks))
        ids = world.landmarks.current(view.landmark_ids[exist])  # some were fused since
        ids, first = np.unique(ids, return_index=True)
        rows = exist[first]
        in_graph = known.contains(ids)
        ids, rows = ids[in_graph], rows[in_graph]
        if len(ids) < MIN_LANDMARKS:
            continue
        parts.append(observations_in(len(poses), view.features(bf), rows, ids, depth_factor))
        poses.append(pose)
        stamps_s.append(view.timestamp_s)
    if not parts or sum(map(len, parts)) + len(tables.observations) > MAX_OBSERVATIONS:
        return np.zeros(0), Frames(np.zeros((0, 4, 4)), Observations())
    given = concatenate(parts)
    frames_each = len(poses) / len(tables.keyframes.ids)
    given.sigmas_px[:] *= np.sqrt(max(frames_each, 1.0))
    return np.array(stamps_s), Frames(np.array(poses), given, 1 + min(frames_each, 1.0))


def _with_poses(
    views: Sequence[FrameView], paths: Iterable[Trajectory]
) -> Iterator[tuple[FrameView, Array]]:
    """The views that have a pose T_world_camera (4, 4) in one of the paths, with it, in order."""
    stamps_s = np.array([view.timestamp_s for view in views])
    found: dict[int, Array] = {}
    for path in paths:
        at = nearest_indices(path.timestamps_s, stamps_s)
        same = np.abs(path.timestamps_s[at] - stamps_s) < MAX_STAMP_ERROR_S
        found |= dict(
            zip(np.flatnonzero(same).tolist(), path.poses_world_camera[at[same]], strict=True)
        )
    return ((views[k], found[k]) for k in sorted(found))
