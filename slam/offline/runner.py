"""One offline run: a sequence through the system into a run folder."""

from __future__ import annotations

import logging
import platform
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from bmask_slam.config.configuration import dump
from bmask_slam.datasets.weights import find_weights
from bmask_slam.evaluation import Row
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.trajectory import MAX_TIME_DIFFERENCE_S, Trajectory, associate_stamps
from bmask_slam.graph.trajectory_formats import read_trajectory
from bmask_slam.offline.checkpoint import Checkpoints, read_checkpoint
from bmask_slam.offline.map_localisation import MapLocalisation
from bmask_slam.offline.options import RunOptions
from bmask_slam.run_folder.folder import CHECKPOINT, RunFolder, free_run_path
from bmask_slam.run_folder.map_file import read_map
from bmask_slam.run_folder.metrics import RunCounters, measure, save
from bmask_slam.run_folder.origin import Origin
from bmask_slam.runtime.progress import Progress
from bmask_slam.runtime.stop_request import StopRequest
from bmask_slam.semantics.segmenters.segmenter import NoSegmenter
from bmask_slam.semantics.segmenters.segmenter_table import make_segmenter
from bmask_slam.sequences import Sequence, open_sequence
from bmask_slam.sequences.frame import Frame
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.system_interface import System
from bmask_slam.tracking.results import FrameResult

__all__ = ["RunOptions", "RunSummary", "resume", "run"]
logger = logging.getLogger(__name__)

SNAPSHOT_FRAMES = 30
SNAPSHOT_GROWTH = 1.05
MIN_REFERENCE_POSES = 3


@dataclass(frozen=True)
class RunSummary:
    """How a run ended.

    Attributes:
        folder: the run folder.
        rows: what metrics.json holds.
        frames: frames given to the system.
        skipped: frames that were broken, not counted in ``frames``.
        stopped_by: the signal that ended the run early, or None.
        resumable: the run can be resumed from its last checkpoint, since it was stopped.
    """

    folder: Path
    rows: list[Row]
    frames: int
    skipped: int
    stopped_by: signal.Signals | None = None
    resumable: bool = False


MakeSystem = Callable[[Camera, SystemConfig], System]


def run(options: RunOptions, make_system: MakeSystem | None = None) -> RunSummary:
    """Run the system over a sequence and fill the run folder.

    SIGINT and SIGTERM end it after the current frame; what was tracked so far is then finished
    and saved like a whole run.

    Raises:
        InputError: a broken sequence, reference or map, or a run folder that cannot be used;
            nothing is left behind unless frames had been tracked before.
    """
    sequence = open_sequence(options.sequence, camera=options.camera)
    reference = find_reference(options.reference, sequence)
    name = "-".join(filter(None, (sequence.name, options.config_name)))
    with (
        RunFolder(options.out or free_run_path(name), options.overwrite) as folder,
        StopRequest() as stop,
    ):
        describe_run(folder, options, sequence)
        system = start_system(options, sequence, make_system or _with_segmenter(options, sequence))
        counters = RunCounters()
        track((system, counters), sequence, folder, options, stop)
        return conclude((system, counters), (sequence, reference), folder, options, stop)


def resume(
    path: Path, given: Mapping[str, Any] | None = None, make_system: MakeSystem | None = None
) -> RunSummary | None:
    """Go on with a run that was killed, from its last checkpoint; None if it is finished.

    ``given`` are options (attributes of RunOptions) that the user repeats: the sequence may have
    been moved, the others must be the run's own.

    Raises:
        InputError: there is no checkpoint, it is broken or of another version, or sequence,
            configuration or options are not those that the run was begun with.
    """
    if (path / "metrics.json").exists() and not (path / CHECKPOINT).exists():
        return None
    checkpoint = read_checkpoint(path)
    options = checkpoint.options.with_given(given or {})
    sequence = open_sequence(options.sequence, camera=options.camera)
    checkpoint.check_sequence(sequence)
    reference = find_reference(options.reference, sequence)
    make = make_system or _with_segmenter(options, sequence)
    system, counters = make(sequence.camera, options.config), checkpoint.counters
    system.restore(checkpoint.state, path / CHECKPOINT)
    with RunFolder(path, resume_bytes=checkpoint.frames_bytes) as folder, StopRequest() as stop:
        logger.info("resumed after %d frames: %s", counters.frames, shlex.join(sys.argv))
        if not counters.frames:
            logger.warning("%s: no checkpoint was reached; starting from the beginning", path)
        for index, reason in checkpoint.skipped:
            sequence.skip(index, reason)
        track((system, counters), sequence, folder, options, stop)
        return conclude((system, counters), (sequence, reference), folder, options, stop)


def find_reference(path: Path | None, sequence: Sequence) -> Trajectory | None:
    """The trajectory to compare with: a file's, a sequence folder's, or the sequence's own.

    Raises:
        InputError: the given file is missing or broken, or shares no time with the sequence.
    """
    if path is None:
        return sequence.groundtruth
    file = path / "groundtruth.txt" if path.is_dir() else path
    reference = read_trajectory(file, sequence.timestamps_s)
    shared = len(associate_stamps(sequence.timestamps_s, reference.timestamps_s)[0])
    if shared < MIN_REFERENCE_POSES:
        raise InputError(
            f"{file}: has a pose within {MAX_TIME_DIFFERENCE_S:g} s for {shared} frames of "
            f"{sequence.folder}; give the reference of this sequence, in its clock"
        )
    return reference


def describe_run(folder: RunFolder, options: RunOptions, sequence: Sequence) -> None:
    """Write the resolved configuration, and to the log what is run, by what and where."""
    origin = Origin(sequence.folder, options.stride)
    folder.write_text("config.yaml", f"# {origin}\n{dump(options.config)}")
    logger.info("%s: %s", origin, shlex.join(sys.argv))
    packages = ("gtsam", "numpy", "opencv-python-headless")
    versions = ", ".join(f"{package} {version(package)}" for package in packages)
    logger.info("%s, Python %s, %s", platform.platform(), platform.python_version(), versions)
    logger.info("camera from %s: %s", sequence.camera_source, sequence.camera)
    pairs = sequence.pairs
    unpaired = f"{pairs.unpaired_rgb} colour and {pairs.unpaired_depth} depth images"
    logger.info("%d frames; %s without a partner", len(sequence), unpaired)
    for index, reason in sequence.skipped:  # found while opening, before there was a log
        logger.info("frame %d is broken: %s", index, reason)


def _with_segmenter(options: RunOptions, sequence: Sequence) -> MakeSystem:
    """The real system, with the segmenter of its configuration. Raises InputError."""
    chosen = options.config.semantics.segmenter
    segmenter = (
        NoSegmenter() if options.localise else make_segmenter(chosen, sequence.folder, find_weights)
    )
    return partial(SlamSystem, segmenter=segmenter)


def start_system(options: RunOptions, sequence: Sequence, make_system: MakeSystem) -> System:
    """The system of a new run: empty, or with the map that the options name.

    Raises:
        InputError: the map cannot be read, or is to be continued with another camera.
    """
    source = options.map or options.localise
    if source is None:
        return make_system(sequence.camera, options.config)
    state, camera = read_map(source)
    if options.map and camera != sequence.camera:
        raise InputError(
            f"{source}: made with {camera}, but {sequence.folder} has {sequence.camera}; a map "
            "goes on with its own camera only (--localise takes any)"
        )
    make = MapLocalisation if options.localise else make_system
    system = make(sequence.camera, options.config)
    system.restore(state, source)
    system.begin_session()
    logger.info("%s: %s keyframes", source, system.statistics()["keyframes"])
    return system


def track(
    progress: tuple[System, RunCounters],
    sequence: Sequence,
    folder: RunFolder,
    options: RunOptions,
    stop: StopRequest,
) -> None:
    """Process frames until the end, ``max_frames`` or a stop request, recording each.

    The system and what is counted of it go on from where they are.
    """
    system, counters = progress
    end = len(sequence)
    if options.max_frames is not None:
        end = min(end, options.max_frames * options.stride)
    indices = range(0, end, options.stride)
    begin = -(-counters.next_index // options.stride)
    frames = sequence.frames(
        begin * options.stride, end, options.stride, prepare=_timed(system.prepare)
    )
    checkpoints = Checkpoints(folder, options, sequence)
    follow = _dense_follower(system, sequence, folder) if options.dense else None
    start_s = time.perf_counter() - counters.wall_s
    with (
        closing(frames),  # type: ignore[type-var]
        Progress(len(indices), options.quiet, begin) as bar,
        _snapshots(system, folder, counters) as snapshot,
    ):
        if not counters.frames:
            checkpoints.write(system, counters)
        for frame, (features, features_ms) in frames:
            result = system.process(frame, features)
            result = replace(result, stage_ms={**result.stage_ms, "features": features_ms})
            folder.write_frame(result)
            counters.count(result)
            if follow is not None:
                follow(result)
            counters.wall_s = time.perf_counter() - start_s
            bar.update(result.status, counters.keyframes, counters.lost)
            snapshot()
            if stop.signal is not None:
                break
            checkpoints.after_frame(system, counters)
        else:
            counters.next_index = end
            checkpoints.write(system, counters)
    logger.info("%d frames in %.1f s", counters.frames, counters.wall_s)


def conclude(
    progress: tuple[System, RunCounters],
    inputs: tuple[Sequence, Trajectory | None],
    folder: RunFolder,
    options: RunOptions,
    stop: StopRequest,
) -> RunSummary:
    """Finish the system, measure and save; a run that was not stopped is complete then."""
    (system, counters), (sequence, reference) = progress, inputs
    system.finish()
    rows = measure(system, reference, counters, options.stride)
    title = "-".join(filter(None, (sequence.name, options.config_name)))
    save(system, folder, rows, reference, title)
    if options.dense:
        from bmask_slam.dense.map_run import map_run  # noqa: PLC0415
        from bmask_slam.dense.options import MapOptions  # noqa: PLC0415 - torch, as below

        map_run(MapOptions(folder.path))
    if stop.signal is None:
        folder.complete()
    skipped = sum(index < counters.next_index for index, _ in sequence.skipped)
    resumable = stop.signal is not None and options.checkpoint_every is not None
    return RunSummary(folder.path, rows, counters.frames, skipped, stop.signal, resumable)


def _dense_follower(
    system: System, sequence: Sequence, folder: RunFolder
) -> Callable[[FrameResult], None]:
    """Fuses keyframes on the way. Imports torch, which takes a second and 200 MB."""
    from bmask_slam.dense.map_run import dense_follower  # noqa: PLC0415 - only for those who need it

    if not isinstance(system, SlamSystem):
        return lambda result: None
    return dense_follower(system.mapper.world, system.semantics, sequence, folder.path)


@contextmanager
def _snapshots(
    system: System, folder: RunFolder, counters: RunCounters
) -> Iterator[Callable[[], None]]:
    """A function, called after every frame, that saves the trajectory now and then.

    It grows rarer with the trajectory, so that the cost of a frame does not grow. Whatever ends
    the block, the trajectory is saved once more if there were any frames.
    """
    due = counters.frames + SNAPSHOT_FRAMES

    def snapshot() -> None:
        nonlocal due
        if counters.frames >= due:
            folder.write_trajectory(system.trajectory())
            due = int(counters.frames * SNAPSHOT_GROWTH) + SNAPSHOT_FRAMES

    try:
        yield snapshot
    finally:
        if counters.frames:
            folder.write_trajectory(system.trajectory())


def _timed(prepare: Callable[[Frame], Any]) -> Callable[[Frame], tuple[Any, float]]:
    """The function with the milliseconds it took."""

    def timed(frame: Frame) -> tuple[Any, float]:
        start_s = time.perf_counter()
        features = prepare(frame)
        return features, 1e3 * (time.perf_counter() - start_s)

    return timed
