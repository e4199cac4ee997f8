"""The calibration's process: readout time and depth delay of the camera, from a state of the map.

It decides as an offline run does (`calibration.adoption`), but a round is what was tracked since
the camera was last changed, not the same frames again.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bmask_slam.back_end.reinterpretation import KeyframeMotion
from bmask_slam.calibration.adoption import (
    TIMES,
    CalibrationRounds,
    SelfCalibrationConfig,
    estimate_times,
    format_found,
)
from bmask_slam.calibration.calibrate import MAX_KEYFRAMES
from bmask_slam.calibration.keyframe_depth import (
    DepthSamples,
    KeyframeDepth,
    KeyframeImages,
    keyframe_problem,
)
from bmask_slam.calibration.motion import twists_at
from bmask_slam.calibration.views import connected_views, sensor_sigmas
from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.calibration.model import SHUTTER, parameters_of
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.graph_update import Observations
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.files.array_file import part, read_arrays
from bmask_slam.graph.marginals.landmark_marginalisation import reinsert
from bmask_slam.graph.smoother.storage import factor_tables_of, read_camera
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.live.channel import Channel
from bmask_slam.live.messages import STATE_FILE, EstimateTimes, Ready, TimesEstimated
from bmask_slam.run_folder.map_file import SavedRun
from bmask_slam.world.frame_history import FrameHistory
from bmask_slam.world.map_state import world_of
from bmask_slam.world.world_map import WorldMap

logger = logging.getLogger(__name__)

MAX_IMAGES = 120
"""Keyframes whose depth images are kept, 1.2 MB each at 640 x 480."""


@dataclass(frozen=True)
class CalibrationSetup:
    """What the process needs to start.

    Attributes:
        camera: that the run begins with.
        graph: settings of the graph.
        config: when something is adopted.
        interpolates: whether the source makes use of the camera's depth delay.
    """

    camera: Camera
    graph: SmootherConfig
    config: SelfCalibrationConfig
    interpolates: bool


def serve_calibration(channel: Channel, setup: CalibrationSetup) -> None:
    """Keep depth images and estimate until the channel ends."""
    server = CalibrationServer(setup)
    channel.send(Ready())
    for message in channel.messages():
        match message:
            case KeyframeImages():
                server.add(message)
            case EstimateTimes():
                channel.send(server.estimate(message))


class CalibrationServer:
    """Keeps depth images of keyframes, and estimates in rounds."""

    def __init__(self, setup: CalibrationSetup) -> None:
        self._setup = setup
        self._depths: dict[int, KeyframeDepth] = {}
        self._rounds = self._new_rounds()
        self._begun = False
        self._given = parameters_of(setup.camera, setup.camera.depth_scale)

    def _new_rounds(self) -> CalibrationRounds:
        free = set(TIMES if self._setup.interpolates else (SHUTTER,))
        if self._setup.camera.rolling_shutter_s:  # the sensor's, as for a run that is not live
            free.discard(SHUTTER)
        return CalibrationRounds(self._setup.camera, self._setup.config, tuple(free))

    def add(self, images: KeyframeImages) -> None:
        """Keep what is needed of a keyframe's depth images."""
        self._depths[images.id] = KeyframeDepth.of(images)
        if len(self._depths) > MAX_IMAGES:
            del self._depths[min(self._depths)]

    def estimate(self, message: EstimateTimes) -> TimesEstimated:
        """What the keyframes since the last change of the camera say of it."""
        run, world, paths = read_state(message.state, self._setup.graph)
        chosen = [k for k in self._depths if k >= message.first_keyframe and k in world.keyframes]
        seen = connected_views(run.tables, np.array(sorted(chosen), np.int64), MAX_KEYFRAMES)
        try:
            seen, samples = self._sampled(seen, world, run.camera)
            estimate = estimate_times(keyframe_problem(run, seen, samples))
        except InputError as error:
            logger.info("calibration: %s", error)
            return TimesEstimated(None, {}, "", False)
        text = format_found(estimate, TIMES, "estimated")
        logger.info("calibration: %d keyframes: %s", len(np.unique(seen.keyframe_ids)), text)
        if not self._begun and not self._rounds.shows(estimate):
            return TimesEstimated(None, {}, "not observable in the motion so far", False)
        camera = self._rounds.add(estimate)
        result, done = self._rounds.result(), camera is None
        used = [i for i in TIMES if estimate.before[i] != self._given[i]]
        if self._begun and done and result.adopted and estimate.settled(used):
            return TimesEstimated(None, {}, "", True)  # what is in use was found again
        if camera is None and not self._begun:
            self._rounds = self._new_rounds()
            differs = any(estimate.differs(i, self._setup.config) for i in TIMES)
            return TimesEstimated(None, {}, result.text, done=not differs)
        self._begun = True
        camera = camera or result.camera
        return TimesEstimated(camera, self._motions(world, paths, run, camera), result.text, done)

    def _sampled(
        self, seen: Observations, world: WorldMap, camera: Camera
    ) -> tuple[Observations, DepthSamples]:
        """The observations whose keypoints are known, and their samples of the depth images."""
        if not len(seen):
            raise InputError("no keyframes share landmarks, too few to calibrate")
        sigmas, parts, rows = sensor_sigmas(seen, camera), [], []
        for k in np.unique(seen.keyframe_ids).tolist():
            of_keyframe = np.flatnonzero(seen.keyframe_ids == k)
            known, keypoints = observed_by(world, k, seen.landmark_ids[of_keyframe])
            rows.append(of_keyframe[known])
            parts.append(self._depths[k].sample(keypoints, sigmas[rows[-1]]))
        names = ("pixels", "inverse_depth", "rms", "rate", "lag_s", "sigmas")
        columns = [np.concatenate([getattr(p, name) for p in parts]) for name in names]
        return seen.select(np.concatenate(rows)), DepthSamples(*columns)

    def _motions(
        self, world: WorldMap, paths: dict[int, Trajectory], run: SavedRun, camera: Camera
    ) -> dict[int, KeyframeMotion]:
        """By what the keyframes are to be interpreted anew, with another camera."""
        table, motions = run.tables.observations, {}
        retimed = camera.depth_time_offset_s != run.camera.depth_time_offset_s
        for k in world.keyframes.values():
            twist = twist_of(k.timestamp_s, paths.get(k.segment))
            motions[k.id] = KeyframeMotion(twist)
            depth = self._depths.get(k.id)
            if not retimed or depth is None:
                continue
            seen = table.select(table.rows_of_keyframes([k.id]))
            if not len(seen):
                continue
            known, keypoints = observed_by(world, k.id, seen.landmark_ids)
            samples = depth.sample(keypoints, sensor_sigmas(seen, camera)[known])
            change = samples.delay_correction(camera.depth_time_offset_s)
            motions[k.id] = KeyframeMotion(twist, keypoints, change)
            self._depths[k.id] = replace(depth, lag_s=-camera.depth_time_offset_s)
        return motions


def read_state(
    path: Path, config: SmootherConfig
) -> tuple[SavedRun, WorldMap, dict[int, Trajectory]]:
    """A saved state of the map as a run, with its world and its trajectories by segment.

    Raises:
        InputError: the file is missing or broken.
    """
    header, state = read_arrays(path, STATE_FILE)
    mapper, camera = part(state, "mapper"), read_camera(header, path)
    world, history = world_of(part(mapper, "world")), FrameHistory()
    history.restore(part(mapper, "history"))
    tables = factor_tables_of(part(mapper, "graph"), path)
    reinsert(tables, camera, config)
    paths = history.trajectories(world)
    stamps_s = {k.id: k.timestamp_s for k in world.keyframes.values()}
    stamps = np.array([stamps_s.get(i, np.nan) for i in tables.keyframes.ids.tolist()])
    nothing = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
    path_of_all = paths.get(world.largest_segment(), nothing)
    trajectories = {"trajectory.txt": path_of_all}
    run = SavedRun(path, tables, camera, config, stamps, trajectories, nothing, {})
    return run, world, paths


def observed_by(world: WorldMap, keyframe_id: int, landmark_ids: Ints) -> tuple[Ints, Ints]:
    """Which of the landmarks (N,) a keyframe observes, and the keypoints that do."""
    own = world.keyframes[keyframe_id].landmark_ids
    rows = np.flatnonzero(own >= 0)
    _, known, at = np.intersect1d(landmark_ids, own[rows], return_indices=True)
    return known, rows[at]


def twist_of(stamp_s: float, path: Trajectory | None) -> Array:
    """The camera's velocity (6,) at a stamp; zero where it is not known."""
    if path is None or not len(path):
        return np.zeros(6)
    return twists_at(path, np.array([stamp_s]))[0]
