"""The calibration's process: what a state of the map shows of the camera.

It estimates and decides as an offline run does (`calibration.rematching`, `calibration.adoption`);
frames that were tracked before stay as they are.
"""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bmask_slam.back_end.reinterpretation import KeyframeMotion
from bmask_slam.calibration.adoption import (
    Estimate,
    SelfCalibration,
    adopted_parameters,
    format_found,
    judged,
    with_other_order,
)
from bmask_slam.calibration.config import FREE, SelfCalibrationConfig
from bmask_slam.calibration.edge_delay import MAX_DELAY_S, EdgeDelay, sure_registration
from bmask_slam.calibration.edge_scores import FrameEdges, scores_of
from bmask_slam.calibration.keyframe_depth import KeptDepths, KeyframeDepth, KeyframeImages
from bmask_slam.calibration.keyframe_motions import keyframe_motions
from bmask_slam.calibration.motion import twists_at
from bmask_slam.calibration.rematching import estimate_again
from bmask_slam.calibration.views import sensor_sigmas
from bmask_slam.graph.arrays import Array, Ints, no_ids
from bmask_slam.graph.calibration.model import TIME
from bmask_slam.graph.calibration.registration import Registration
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.files.array_file import part, read_arrays
from bmask_slam.graph.marginals.landmark_marginalisation import reinsert
from bmask_slam.graph.smoother.storage import factor_tables_of, read_camera
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.live.channel import Channel
from bmask_slam.live.messages import STATE_FILE, CameraEstimated, EstimateCamera, Ready
from bmask_slam.run_folder.map_file import SavedRun
from bmask_slam.world.frame_history import FrameHistory
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.map_state import world_of
from bmask_slam.world.world_map import WorldMap

logger = logging.getLogger(__name__)

BENT_SHARE = 1 / 40
"""Of the image's width: where the camera's turning, the median of all keyframes, moves the image
farther than that while depth is late, the map is bent."""
MAX_IMAGES = 80
"""Keyframes whose depth images are kept, 1.2 MB each at 640 x 480."""


@dataclass(frozen=True)
class CalibrationSetup:
    """What the process needs to start.

    Attributes:
        camera: that the run begins with.
        graph: settings of the graph.
        config: when something is adopted.
        mode: "auto": what is sure is adopted; "report": it is only said.
        free: the parameters that may be used, by their places in PARAMETERS: those that the
            source's frames follow.
        pairs: whether the source pairs images by the camera's delay of depth.
    """

    camera: Camera
    graph: SmootherConfig
    config: SelfCalibrationConfig
    mode: str
    free: tuple[int, ...]
    pairs: bool

    @property
    def looks_at_edges(self) -> bool:
        """Whether a delay that edges of depth show would be used."""
        return self.mode == "auto" and self.pairs


def serve_calibration(channel: Channel, setup: CalibrationSetup, niceness: int) -> None:
    """Keep depth images and estimate until the channel ends."""
    os.nice(niceness)
    server = CalibrationServer(setup)
    channel.send(Ready())
    for message in channel.messages():
        match message:
            case KeyframeImages():
                server.add(message)
            case EstimateCamera():
                channel.send(server.estimate(message))


class CalibrationServer:
    """Keeps depth images of keyframes, and estimates until the camera is settled."""

    def __init__(self, setup: CalibrationSetup) -> None:
        self._setup = setup
        self._depths: dict[int, KeyframeDepth] = {}
        self._edges: dict[int, FrameEdges] = {}
        self._state, self._looks = SelfCalibration(setup.camera, setup.camera), 0
        self._delay = EdgeDelay(setup.camera)

    def add(self, images: KeyframeImages) -> None:
        """Keep what is needed of a keyframe's images."""
        self._depths[images.id] = KeyframeDepth.of(images)
        if self._looks_at_edges:
            depth_m, camera = images.depth.depth_m.astype(float), self._setup.camera
            lag_s = images.lag_s + camera.depth_time_offset_s
            self._edges[images.id] = FrameEdges.of(images.rgb, depth_m, lag_s, camera)
        if len(self._depths) > MAX_IMAGES:
            oldest = min(self._depths)
            del self._depths[oldest]
            self._edges.pop(oldest, None)

    def estimate(self, message: EstimateCamera) -> CameraEstimated:
        """What the keyframes say of the camera.

        Those of a camera without a readout time are asked once more after one is adopted, those of
        a map that begins anew, since the one before was bent, and all while its delay is not known.
        """
        setup, config, before = self._setup, self._setup.config, self._state
        self._looks += 1
        run, world, paths = read_state(message.state, setup.graph)
        kept = {k: depth for k, depth in self._depths.items() if k in world.keyframes}
        estimate = self._estimate(world, run, KeptDepths(kept, run.camera))
        if estimate is not None and estimate.in_other_order:
            return CameraEstimated(None, {}, self._state.text, True)
        edges = self._register(run, world)
        by_motion, contradicted = self._by_motion(estimate, edges)
        state, doubt = self._delay.judge(by_motion, edges)
        if self._lacks_delay(state):
            doubt = _joined(contradicted, doubt) or self._doubt(state, estimate)
        self._state, text = state, _joined(state.rows, state.text, doubt)
        shown = estimate is not None and estimate.shows(TIME, config)
        clear = not doubt and (shown or not self._lacks_delay(state))
        last = self._looks >= config.stretches
        found = state.adopted or state.rows
        if found and state.camera != replace(run.camera, covered=state.camera.covered):
            motions = self._motions(world, paths, run, state.camera)
            bent = _is_bent(world, run, state.camera)
            straight = setup.camera.rolling_shutter_s != 0 and before.rows == state.rows
            done = before.adopted or (state is by_motion and straight)
            settled = last or (done and not bent and clear)
            return CameraEstimated(state.camera, motions, text, settled, bent)
        done = state.adopted or state.settled
        return CameraEstimated(None, {}, text, last or (done and clear))

    def _estimate(self, world: WorldMap, run: SavedRun, reader: KeptDepths) -> Estimate | None:
        """What keyframes say of the camera, in the order of rows that they show, if that is used.

        None if it is too little.
        """
        worth_s = self._setup.config.min_change_s
        try:
            estimate = estimate_again(world, run, reader, self._state.given, worth_s)
            if estimate is not None and estimate.in_other_order:
                self._state = with_other_order(self._state, self._setup.mode)
                if self._state.rows:
                    estimate = estimate_again(world, run, reader, self._state.given, worth_s)
        except InputError as error:
            logger.info("calibration: %s", error)
            return None
        return estimate

    @property
    def _looks_at_edges(self) -> bool:
        """Whether they are kept: until the delay that they show is used."""
        return self._setup.looks_at_edges and not self._delay.is_used

    def _register(self, run: SavedRun, world: WorldMap) -> Registration | None:
        """How depth lies on colour by its edges, with the camera that the run began with.

        None where they are not kept, or are not clear.
        """
        path = run.trajectories["trajectory.txt"]
        kept = [k for k in self._edges if k in world.keyframes]
        if not self._looks_at_edges or not kept or not len(path):
            return None
        twists = twists_at(path, np.array([world.keyframes[k].timestamp_s for k in kept]))
        moving = np.flatnonzero(twists.any(axis=1))
        edges = [self._edges[kept[i]] for i in moving.tolist()]
        return sure_registration(scores_of(edges, twists[moving], self._setup.camera))

    def _by_motion(
        self, estimate: Estimate | None, edges: Registration | None
    ) -> tuple[SelfCalibration, str]:
        """The state after an estimate, and what is not used of it.

        That is a delay that edges surely contradict, however sure: depth that comes much too late
        bends the map, and with it what the motion says.
        """
        setup, before = self._setup, self._state
        if estimate is None:
            return before, ""
        logger.info("calibration: %s", format_found(estimate, FREE, "estimated"))
        state = judged(before, estimate, setup.mode, setup.config, setup.free)
        newly = adopted_parameters(state) - adopted_parameters(before)
        if TIME not in newly or not self._delay.contradicts(edges, state.camera):
            return state, ""
        others = tuple(i for i in setup.free if i != TIME)
        contradicted = format_found(estimate, (TIME,), "edges of depth contradict it, not applied")
        return judged(before, estimate, setup.mode, setup.config, others), contradicted

    def _doubt(self, state: SelfCalibration, estimate: Estimate | None) -> str:
        """A delay that is not sure enough to be adopted beside what was; "" if there is none."""
        if estimate is None or not state.adopted:
            return ""
        differs = estimate.differs(TIME, self._setup.config)
        return format_found(estimate, (TIME,), "not sure enough to be applied") if differs else ""

    def _lacks_delay(self, state: SelfCalibration) -> bool:
        """Whether a delay that the motion shows would be used, and none was adopted."""
        usable = self._setup.mode == "auto" and TIME in self._setup.free
        return usable and TIME not in adopted_parameters(state)

    def _motions(
        self, world: WorldMap, paths: dict[int, Trajectory], run: SavedRun, camera: Camera
    ) -> dict[int, KeyframeMotion]:
        """By what the keyframes are to be interpreted anew, with another camera."""
        table, offset_s = run.tables.observations, camera.depth_time_offset_s

        def change(keyframe: Keyframe) -> tuple[Ints, Array]:
            depth = self._depths.get(keyframe.id)
            seen = table.select(table.rows_of_keyframes([keyframe.id]))
            if depth is None or not len(seen):
                return no_ids(), np.zeros(0)
            known, keypoints = observed_by(keyframe, seen.landmark_ids)
            sigmas = sensor_sigmas(seen, camera)[known]
            return keypoints, depth.delay_correction(keypoints, sigmas, offset_s)

        retimed = offset_s != run.camera.depth_time_offset_s
        keyframes = world.keyframes.values()
        return keyframe_motions(keyframes, paths, change if retimed else None)


def _joined(*texts: str) -> str:
    return "; ".join(filter(None, texts))


def _is_bent(world: WorldMap, run: SavedRun, camera: Camera) -> bool:
    """Whether depth came so late, by another camera, that it was of other surfaces.

    Depth of the same surface is brought to the colour image's time by how fast it changes.
    """
    late_s = camera.depth_time_offset_s - run.camera.depth_time_offset_s
    stamps_s = np.array([k.timestamp_s for k in world.keyframes.values()])
    rates = np.linalg.norm(twists_at(run.trajectories["trajectory.txt"], stamps_s)[:, :3], axis=1)
    moved_px = camera.fx * np.median(rates[rates > 0]) * abs(late_s) if rates.any() else 0.0
    return abs(late_s) > MAX_DELAY_S and bool(moved_px > BENT_SHARE * camera.width)


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
    path_of_all = paths.get(history.largest_segment(world), nothing)
    trajectories = {"trajectory.txt": path_of_all}
    run = SavedRun(path, tables, camera, config, stamps, trajectories, nothing, {})
    return run, world, paths


def observed_by(keyframe: Keyframe, landmark_ids: Ints) -> tuple[Ints, Ints]:
    """Which of the landmarks (N,) a keyframe observes, and the keypoints that do."""
    rows = np.flatnonzero(keyframe.landmark_ids >= 0)
    own = keyframe.landmark_ids[rows]
    _, known, at = np.intersect1d(landmark_ids, own, return_indices=True)
    return known, rows[at]
