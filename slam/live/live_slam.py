"""SLAM for a camera that does not wait: ``with LiveSlam(camera) as slam: slam.track(...)``."""

from __future__ import annotations

import logging
import shutil
import tempfile
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import TracebackType

import numpy as np

from bmask_slam.config.configuration import dump
from bmask_slam.evaluation import Row
from bmask_slam.features.brisk import Features
from bmask_slam.graph.arrays import Floats, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.labelling.results import LandmarkCloud
from bmask_slam.live.display import Display
from bmask_slam.live.health import WINDOW, FrameMeter, Health
from bmask_slam.live.live_options import LiveOptions
from bmask_slam.live.processes.dense_messages import MapWritten
from bmask_slam.live.processes.start import start_system
from bmask_slam.live.recorder import Recorder, rescued
from bmask_slam.live.sources.source import SourceCounts
from bmask_slam.live.system import LiveSystem
from bmask_slam.run_folder.folder import DISK_ERRORS, HEALTH, RunFolder
from bmask_slam.run_folder.metrics import RunCounters, measure, row, save
from bmask_slam.sequences.frame import Frame, check_frame
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import FrameResult
from bmask_slam.viewer.scene import Scene

__all__ = ["LiveOptions", "LiveSlam", "Prepared"]
logger = logging.getLogger(__name__)

MAP_S = 1.0
"""The longest wait for the map in one go."""
CLOUDS_S = 600.0
"""How long the dense map may take to be finished at the end."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """A frame's features, computed ahead of tracking.

    Attributes:
        features: see there. ms: time that they took.
        arrived_s: ``time.monotonic()`` when the frame was there.
    """

    features: Features
    ms: float
    arrived_s: float


class LiveSlam:
    """The live loop. Map with graph and loops, segmentation and dense map have processes.

    A context manager: leaving it ends them and saves everything, whatever the reason.

    Attributes:
        frames_dropped: by the source, which counts them here.
        source_counts: of the source, for ``health``.
        rows: what metrics.json holds, once it is closed. dense: how the dense map ended, then.
    """

    def __init__(
        self, camera: Camera, config: SystemConfig | None = None, options: LiveOptions | None = None
    ) -> None:
        """Start the processes; returns when they can work.

        Raises:
            InputError: the run folder cannot be used, or the segmenter cannot start.
        """
        self.camera = camera
        self.config = config or SystemConfig()
        self.options = options or LiveOptions()
        self.frames_dropped = 0
        self.source_counts = SourceCounts()
        self.rows: list[Row] = []
        self.dense: MapWritten | None = None
        self._counters, self._meter = RunCounters(), FrameMeter()
        self._refused = 0
        self._closed = False
        self._last_s = -np.inf
        self._begin_s = time.monotonic()
        self._scene: Scene | None = None
        self._display: Display | None = None
        self._scratch = Path(tempfile.mkdtemp(prefix="bmask-slam-"))
        self._recorder: Recorder | None = None
        try:
            if self.options.out is not None:
                folder = RunFolder(self.options.out, self.options.overwrite).__enter__()
                self._recorder = Recorder(folder)
                origin = self.options.origin
                folder.write_text("config.yaml", f"# {origin}\n{dump(self.config)}")
                logger.info("%s: %s", origin, self.options.title)
            if self.options.view.anywhere:
                self._scene = Scene(self.options.title, self.options.view)
                self._scene.camera(camera)
                self._display = Display(self._scene)
            self._system = self._start()
        except BaseException:
            self._leave()
            raise

    def __enter__(self) -> LiveSlam:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def prepare(self, rgb: Image, depth_m: Floats) -> Prepared:
        """A frame's features, for ``track``; may be called ahead in another thread."""
        arrived_s, started_s = time.monotonic(), time.perf_counter()
        features = self._system.prepare(Frame(0, 0.0, rgb, depth_m))
        return Prepared(features, 1e3 * (time.perf_counter() - started_s), arrived_s)

    def track(
        self,
        timestamp_s: float,
        rgb: Image,
        depth_m: Floats,
        prepared: Prepared | None = None,
        name: str = "",
    ) -> FrameResult:
        """Where the camera is: ``T_world_camera`` (4, 4) and a status, in bounded time.

        The result's ``covariance`` says how sure that is.

        Args:
            timestamp_s: of the frame; later than the one before.
            rgb: (H, W, 3) uint8, red first.
            depth_m: (H, W) float z-depth in metres, NaN or 0 where missing, registered to rgb.
            prepared: from ``prepare``, if the features were computed ahead.
            name: of the image, for a segmenter that looks masks up.

        Raises:
            InputError: a frame that ``check_frame`` refuses. It is not used; the next one may be.
        """
        arrived_s = time.monotonic() if prepared is None else prepared.arrived_s
        try:
            given = Frame(self._meter.frames, timestamp_s, rgb, depth_m, name)
            frame = check_frame(given, self.camera, self._last_s)
        except InputError:
            self._refused += 1
            raise
        if not self._meter.frames:
            self._begin_s = time.monotonic()
        self._last_s = timestamp_s
        result = self._system.process(frame, prepared.features if prepared else None)
        if prepared is not None:
            result = replace(result, stage_ms={**result.stage_ms, "features": prepared.ms})
        self._counters.count(result)
        self._meter.count(result, 1e3 * (time.monotonic() - arrived_s))
        if self._recorder is not None:
            self._recorder.frame(result, self.health, self.trajectory)
        if self._display is not None and self._display.frame(result, rgb, self._system):
            self._display.map(self._system, self.health())
        return result

    def trajectory(self) -> Trajectory:
        """Every frame of the largest map segment so far, from the keyframes as they are."""
        return self._system.trajectory()

    def map(self) -> LandmarkCloud:
        """The landmarks of the largest map segment as they are."""
        return self._system.landmarks()

    def catch_up(self, waiting: float = np.inf) -> None:
        """Take in what the others have found, until only so many keyframes wait for the map."""
        self._system.wait_for_map(waiting, MAP_S)

    def processes(self) -> dict[str, int]:
        """Process ids by name."""
        found = {"map": self._system.remote.pid}
        if self._system.segmenter is not None:
            found["segmenter"] = self._system.segmenter.pid
        if self._system.dense is not None:
            found["dense"] = self._system.dense.pid
        return found

    def health(self) -> Health:
        """How the loop is doing."""
        system, meter = self._system, self._meter
        median, high = meter.percentiles_ms(WINDOW)
        segmenter, remote, dense = system.segmenter, system.remote, system.dense
        return Health(
            status=meter.status,
            frames=meter.frames,
            frames_per_second=meter.frames_per_second,
            latency_ms_median=median,
            latency_ms_p95=high,
            keyframes=len(remote.world.keyframes),
            landmarks=int(remote.world.landmarks.alive.sum()),
            loops_closed=remote.loops_closed,
            submaps=len(dense.submaps) if dense else 0,
            keyframes_waiting=remote.pending,
            masks_waiting=segmenter.waiting if segmenter else 0,
            submaps_waiting=dense.waiting if dense else 0,
            frames_dropped=self.frames_dropped,
            frames_refused=self._refused,
            masks_dropped=segmenter.dropped if segmenter else 0,
            submaps_dropped=dense.dropped if dense else 0,
            unwritten=self._unwritten(),
            lost_frames=meter.lost_frames,
            lost_episodes=meter.lost_episodes,
            map_deaths=remote.deaths,
            segmenter_deaths=segmenter.deaths if segmenter else 0,
            dense_deaths=dense.deaths if dense else 0,
            source=asdict(self.source_counts),
        )

    def close(self) -> None:
        """End the processes and save everything. Safe to call twice.

        Raises:
            InputError: the disk is full; it says where the trajectory is.
        """
        if self._closed:
            return
        self._closed = True
        health = self.health()
        self._counters.wall_s = max(time.monotonic() - self._begin_s, 1e-9)
        failure: InputError | None = None
        try:
            self._conclude(health)
        except OSError as error:
            if self.options.out is None or error.errno not in DISK_ERRORS:
                raise
            where = rescued(self.trajectory())
            failure = InputError(f"{self.options.out}: {error.strerror}; {where}")
            raise failure from error
        finally:
            self._system.close()
            self._leave(failure)

    def _start(self) -> LiveSystem:
        options = self.options
        if options.dense and options.out is None:
            raise InputError("a dense map needs a run folder; give one, as out")
        run, shown = options.out if options.dense else None, self._display is not None
        return start_system(self.camera, self.config, self._scratch, options.images, run, shown)

    def _unwritten(self) -> int:
        """How often the disk was full."""
        dense = self._system.dense
        recorded = self._recorder.unwritten if self._recorder else 0
        return recorded + (dense.unwritten if dense else 0)

    def _conclude(self, health: Health) -> None:
        """Save what an offline run saves; the trajectory at least, if the map cannot be had."""
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
        except InputError as error:
            logger.error("the map is lost, the trajectory is saved: %s", error)
            return
        rows = measure(self._system, self.options.reference, self._counters, 1)
        median, high = self._meter.percentiles_ms()
        rows += [row("latency_ms_median", median, "ms"), row("latency_ms_p95", high, "ms")]
        rows.append(row("frames_dropped", health.frames_dropped, "frames"))
        self.rows = rows
        save(self._system, folder, rows, self.options.reference, self.options.title)
        folder.complete()
        self._conclude_dense(folder, health)

    def _conclude_dense(self, folder: RunFolder, health: Health) -> None:
        """Let the dense map be finished, and say what is not in it."""
        dense, world, run = self._system.dense, self._system.mapper.world, folder.path
        if dense is None:
            return
        self.dense = dense.finish(world, CLOUDS_S)
        if self._display is not None:
            self._display.submaps(dense, world, True, len(world.keyframes))
        if self.dense.failure:
            logger.error("%s; bmask-slam map %s completes it", self.dense.failure, run)
        elif self.dense.missing:
            count, here = len(self.dense.missing), self.options.images != Path()
            cure = "adds" if here else "with their images as --sequence adds"
            logger.warning("bmask-slam map %s %s the %d keyframes left out", run, cure, count)
        ended = replace(health, submaps=len(dense.submaps), submaps_waiting=0)
        folder.write_text(HEALTH, ended.as_json())

    def _leave(self, failure: InputError | None = None) -> None:
        if self._scene is not None:
            self._scene.close()
        shutil.rmtree(self._scratch, ignore_errors=True)
        if self._recorder is not None:
            self._recorder.folder.__exit__(None, failure, None)
