"""SLAM for a live camera: ``with LiveSlam(camera) as slam: slam.track(...)``."""

from __future__ import annotations

import logging
import time
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from bmask_slam.config.configuration import dump
from bmask_slam.evaluation import Row
from bmask_slam.features.brisk import Features
from bmask_slam.graph.arrays import Floats, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.live.display import Display
from bmask_slam.live.health import FrameMeter, Health, measure_health
from bmask_slam.live.live_map import LiveMap
from bmask_slam.live.recorder import Recorder, rescued
from bmask_slam.live.sources.source import SourceCounts
from bmask_slam.live.sources.source_clock import SourceClock
from bmask_slam.live.start import LiveOptions, start_system
from bmask_slam.run_folder import metrics
from bmask_slam.run_folder.folder import HEALTH, RunFolder
from bmask_slam.run_folder.metrics import RunCounters, row
from bmask_slam.runtime.scratch import scratch_folder
from bmask_slam.sequences.frame import Frame, check_frame, reduced_frame
from bmask_slam.sequences.images import working_camera
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import FrameResult
from bmask_slam.viewer.scene import Scene

if TYPE_CHECKING:  # it loads torch
    from bmask_slam.live.processes.remote_dense import MapWritten, RemoteDenseMapper

__all__ = ["LiveOptions", "LiveSlam", "Prepared"]
logger = logging.getLogger(__name__)

DENSE_FINISH_S = 600.0
"""Longest time that the dense map may take to finish at the end."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """A frame's features, extracted ahead of tracking.

    Attributes:
        frame: as it is tracked, without a stamp.
        features: as of ``SlamSystem.prepare``.
        ms: time that they took.
        arrived_s: ``time.monotonic()`` when the frame arrived, from which its latency counts.
    """

    frame: Frame
    features: Features
    ms: float
    arrived_s: float


class LiveSlam(LiveMap):
    """Tracks frames as they come; map, segmentation and dense map run in processes of their own.

    A context manager: leaving it ends the processes and saves everything, also after an error.

    Attributes:
        camera: of the frames as they are tracked, reduced if they are large; another one once
            calibration has found one.
        frames_dropped: by the source, which sets it.
        source_counts: of the source, for ``health``.
        rows: what metrics.json holds, after ``close``.
        viewer_url: to open in a browser, if the view is served.
        viewer_addresses: where it can be seen, in words.
        dense: how the dense map ended, after ``close``; None without one.
    """

    def __init__(
        self, camera: Camera, config: SystemConfig | None = None, options: LiveOptions | None = None
    ) -> None:
        """Start the processes; returns when all of them are ready.

        ``camera`` is that of the frames that will be given.

        Raises:
            InputError: the run folder cannot be used, or a process cannot start.
        """
        self.config = config or SystemConfig()
        self.options = options or LiveOptions()
        self.camera = camera if self.options.full_size else working_camera(camera)
        self._given = camera
        self.frames_dropped = 0
        self.source_counts = SourceCounts()
        self.rows: list[Row] = []
        self.viewer_url, self.viewer_addresses = "", list[str]()
        self.dense: MapWritten | None = None
        self._counters, self._meter = RunCounters(), FrameMeter()
        self._begin_s = time.monotonic()
        self._clock = SourceClock()
        self._closed = False
        with ExitStack() as stack:  # closed in the opposite order
            self._recorder = self._open_recorder(stack)
            folder = stack.enter_context(scratch_folder())
            self._display = self._open_display(stack)
            system = start_system(self.camera, self.config, self.options, folder)
            self._system = stack.enter_context(closing(system))
            if self._display is not None:
                self._display.follow(system)
            self._resources = stack.pop_all()

    def __enter__(self) -> LiveSlam:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open_recorder(self, stack: ExitStack) -> Recorder | None:
        options = self.options
        if options.out is None:
            return None
        folder = stack.enter_context(RunFolder(options.out, options.overwrite))
        folder.write_text("config.yaml", f"# {options.origin}\n{dump(self.config)}")
        logger.info("%s: %s", options.origin, options.title)
        return Recorder(folder)

    def _open_display(self, stack: ExitStack) -> Display | None:
        if not self.options.view.enabled:
            return None
        scene = Scene(self.options.title, self.options.view)
        display = Display(scene)
        stack.callback(display.close)
        self.viewer_url, self.viewer_addresses = scene.url, scene.addresses
        scene.log_camera(self.camera)
        return display

    def prepare(self, rgb: Image, depth_m: Floats) -> Prepared:
        """Extract a frame's features for ``track``; may be called ahead, in another thread.

        Raises:
            InputError: a large frame that ``check_frame`` refuses.
        """
        arrived_s, started_s = time.monotonic(), time.perf_counter()
        frame = self._reduced(Frame(0, 0.0, rgb, depth_m))
        features = self._system.prepare(frame)
        return Prepared(frame, features, 1e3 * (time.perf_counter() - started_s), arrived_s)

    def _reduced(self, frame: Frame) -> Frame:
        """The frame as it is tracked; large images are reduced. Raises InputError if not usable."""
        k = self.camera.reduced_by // self._given.reduced_by
        return frame if k == 1 else reduced_frame(check_frame(frame, self._given), k)

    def track(
        self,
        timestamp_s: float,
        rgb: Image,
        depth_m: Floats,
        prepared: Prepared | None = None,
        name: str = "",
        depth_lag_s: float = 0.0,
    ) -> FrameResult:
        """Track a frame: its pose ``T_world_camera`` (4, 4), status and covariance.

        The time that it takes is bounded: it does not wait for the other processes, but up to
        ``segmentation.BEGINNING_S`` for the masks of a frame that has begun a map.

        Args:
            timestamp_s: of the frame; later than the one before. Where the source's clock goes
                back for good, an offset is added from then on, and a warning logged.
            rgb: (H, W, 3) uint8, red first.
            depth_m: (H, W) float z-depth in metres, NaN or 0 where missing, registered to rgb.
            prepared: from ``prepare``, if the features were extracted ahead.
            name: of the image, for a segmenter that looks masks up.
            depth_lag_s: stamp of the depth image less ``timestamp_s``, to find the depth's delay.

        Raises:
            InputError: a frame that ``check_frame`` or ``SourceClock`` refuses. It is not used; the
                next one may be. After ``close`` all are refused.
        """
        if self._closed:
            raise InputError("track: this LiveSlam is closed; track frames in its with block")
        arrived_s = time.monotonic() if prepared is None else prepared.arrived_s
        if not self._meter.frames:
            self._begin_s = arrived_s
        frame = Frame(self._meter.frames, timestamp_s, rgb, depth_m, name, depth_lag_s)
        frame, result = self._process(frame, prepared)
        self._follow_camera()
        self._counters.count(result)
        self._meter.count(result, 1e3 * (time.monotonic() - arrived_s))
        self._show(result, frame.rgb)
        return result

    def _process(self, frame: Frame, prepared: Prepared | None) -> tuple[Frame, FrameResult]:
        """Do a frame's step; also the frame as it is tracked. One that is refused is counted."""
        try:
            if prepared is None:
                frame = self._reduced(frame)
            else:
                done = prepared.frame
                frame = replace(frame, rgb=done.rgb, depth_m=done.depth_m)
            stamp_s = self._clock.checked(frame.timestamp_s)
            features = prepared.features if prepared else None
            result = self._system.process(replace(frame, timestamp_s=stamp_s), features)
        except InputError:
            self._meter.refused += 1
            raise
        self._clock.used(stamp_s)
        if prepared is not None:
            result = replace(result, stage_ms={**result.stage_ms, "features": prepared.ms})
        return frame, result

    def _show(self, result: FrameResult, rgb: Image) -> None:
        """Write and display a frame."""
        if self._recorder is not None:
            self._recorder.frame(result, self.health, self.trajectory)
            if self._system.dense is not None:
                self._system.dense.follow(self._recorder.folder.last_path)
        if self._display is not None and self._display.frame(result, rgb, self._system):
            self._display.map(self._system, self.health())

    def _follow_camera(self) -> None:
        """Take over the camera that calibration has found, and keep it in the run folder."""
        if self._system.camera == self.camera:
            return
        self.camera = self._system.camera
        if self._recorder is not None:
            self._recorder.camera(self.camera, self.calibration)

    @property
    def out(self) -> Path | None:
        """The run folder: another one than asked for if that was renamed or removed meanwhile."""
        return self._recorder.folder.last_path if self._recorder else None

    def health(self) -> Health:
        """The state of the live loop."""
        counts, dropped = self.source_counts, self.frames_dropped
        unwritten = self._recorder.unwritten if self._recorder else 0
        return measure_health(self._system, self._meter, counts, dropped, unwritten)

    def close(self) -> None:
        """End the processes and save everything; a second call does nothing.

        Raises:
            InputError: the disk is full, or the map is lost; the text says where the poses are.
        """
        if self._closed:
            return
        self._closed = True
        with self._resources:
            self._counters.wall_s = max(time.monotonic() - self._begin_s, 1e-9)
            try:
                self._save(self.health())
            except OSError as error:
                where = rescued(self.trajectory())
                raise InputError(f"{self.out}: {error.strerror or error}; {where}") from error

    def _save(self, health: Health) -> None:
        """Save what an offline run saves; poses and points only if the map is lost."""
        if self._recorder is None:
            return
        folder = self._recorder.folder
        if self._counters.frames:
            folder.write_trajectory(self.trajectory())
        folder.write_text(HEALTH, health.as_json())
        if not self._counters.frames:
            return
        try:
            self._system.finish()
            self._follow_camera()
        except InputError as error:
            metrics.save_poses_and_points(self._system, folder)
            saved = f"all poses, and the landmarks as they were last, are in {folder.path}"
            raise InputError(f"{error}: the map is lost; {saved}") from error
        finally:
            folder.write_events(self._system.events.take())
            lost = self._system.map.history.without_map()
            self._recorder.frames_apart(lost, max(self._system.segments(), default=-1) + 1)
        arrived = health.frames + health.frames_refused + self.source_counts.broken
        rows = metrics.measure(self._system, self.options.reference, self._counters, arrived)
        median_ms, p95_ms = self._meter.percentiles_ms()
        rows += [row("latency_ms_median", median_ms, "ms"), row("latency_ms_p95", p95_ms, "ms")]
        rows.append(row("frames_dropped", health.frames_dropped, "frames"))
        self.rows = rows
        metrics.save(self._system, folder, rows, self.options.reference, self.options.title)
        folder.complete()
        if self._system.dense is not None:
            self._finish_dense(self._system.dense, folder, health)

    def _finish_dense(self, dense: RemoteDenseMapper, folder: RunFolder, health: Health) -> None:
        """Let the dense map's process finish, and log which keyframes are missing."""
        world = self._system.mapper.world
        dense.follow(folder.path)
        self.dense = dense.finish(world, self._system.map.history, DENSE_FINISH_S)
        if self._display is not None:
            self._display.submaps(dense, world, True, len(world.keyframes))
            self._display.surface(dense, len(dense.shown.parts))
        self.dense.log_missing(folder.path, self.options.images is not None)
        made_of = len(dense.submaps), self.dense.frames
        ended = replace(health, submaps=made_of[0], surface_frames=made_of[1], submaps_waiting=0)
        folder.write_text(HEALTH, ended.as_json())
