"""The last adjustment of a run: the whole map together with the frames that are no keyframes."""

from __future__ import annotations

import logging

import numpy as np

from bmask_slam.back_end.factor_selection import read_back
from bmask_slam.back_end.factors import quantised, stereo_measurements
from bmask_slam.back_end.mapper import Mapper
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.batch.joint_adjustment import Frames, adjust_jointly
from bmask_slam.graph.factors.graph_update import Observations, concatenate
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.smoother.isam2 import SolverError
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.world.frame_observations import FrameObservations

logger = logging.getLogger(__name__)

MIN_LANDMARKS = 15
"""A frame that observes fewer landmarks of the map keeps its pose beside its keyframe."""
MAX_OBSERVATIONS = 500_000
"""Of keyframes and frames; beyond, nothing is done: it would take minutes."""


def adjust_with_frames(mapper: Mapper, frames: FrameObservations, config: SmootherConfig) -> None:
    """Adjust map and graph with what other frames observe too, and give these their poses."""
    smoother, history = mapper.smoother, mapper.history
    stamps_s, given = _frames_in(mapper, frames)
    total = len(smoother.tables.observations) + len(given.observations)
    if not len(stamps_s) or total > MAX_OBSERVATIONS:
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


def _frames_in(mapper: Mapper, frames: FrameObservations) -> tuple[Array, Frames]:
    """Stamps (F,) of the frames that observe enough of the graph, and what they observe."""
    known, current = mapper.smoother.tables.landmarks, mapper.world.landmarks.current
    parts: list[Observations] = []
    poses: list[Array] = []
    stamps_s: list[float] = []
    paths = mapper.history.trajectories(mapper.world).values()
    pose_at = {
        t: T
        for p in paths
        for t, T in zip(p.timestamps_s.tolist(), p.poses_world_camera, strict=True)
    }
    camera = mapper.camera
    weights = np.array([1.0, 1.0, camera.graph_depth_factor])
    for view in frames.views:
        ids, first = np.unique(current(view.landmark_ids), return_index=True)  # some were fused
        rows = first[known.contains(ids)]
        if len(rows) < MIN_LANDMARKS or view.timestamp_s not in pose_at:
            continue
        features = view.features(camera.stereo_bf_px_m)
        sigmas_px = quantised(features.sigmas_px[rows] * weights)
        measured = stereo_measurements(features, rows), sigmas_px
        frame = np.full(len(rows), len(poses))
        parts.append(Observations(frame, ids[known.contains(ids)], *measured))
        poses.append(pose_at[view.timestamp_s])
        stamps_s.append(view.timestamp_s)
    return np.array(stamps_s), Frames(np.array(poses).reshape(-1, 4, 4), concatenate(parts))
