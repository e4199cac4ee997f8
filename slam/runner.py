"""One offline run: a sequence through the system into a run folder."""

from __future__ import annotations

import logging
import platform
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from graph.camera import Camera
from graph.errors import InputError
from graph.trajectory import MAX_TIME_DIFFERENCE_S, Trajectory, associate_stamps
from graph.trajectory_formats import read_trajectory
from slam import __version__
from slam.configuration import dump
from slam.evaluation import Row
from slam.frame import Frame
from slam.progress import Progress
from slam.run_folder import RunFolder, free_run_path
from slam.run_results import Tally, measure, save
from slam.sequences import Sequence, open_sequence
from slam.stop import StopRequest
from slam.system import SlamSystem, SystemConfig
from slam.system_interface import System

logger = logging.getLogger(__name__)

SNAPSHOT_FRAMES = 30
SNAPSHOT_GROWTH = 1.05
MIN_REFERENCE_POSES = 3


@dataclass(frozen=True)
class RunOptions:
    """What to run and where to put it.

    Attributes:
        sequence: folder in TUM layout.
        config: of the system.
        config_name: for the name of the run folder, where ``out`` is None.
        out: the run folder; None: the first free ``runs/<sequence>[-<config_name>][-<n>]``.
        overwrite: replace the run that ``out`` holds.
        reference: TUM file or sequence folder to compare with; None: the sequence's own, if any.
        max_frames: stop after so many frames.
        stride: take every n-th frame.
        quiet: no progress bar.
    """

    sequence: Path
    config: SystemConfig = field(default_factory=SystemConfig)
    config_name: str = ""
    out: Path | None = None
    overwrite: bool = False
    reference: Path | None = None
    max_frames: int | None = None
    stride: int = 1
    quiet: bool = False

    def __post_init__(self) -> None:
        for option in ("stride", "max_frames"):
            value = getattr(self, option)
            if value is not None and value < 1:
                name = option.replace("_", "-")
                raise InputError(f"--{name} {value}: must be a whole number of at least 1")


@dataclass(frozen=True)
class RunSummary:
    """How a run ended.

    Attributes:
        folder: the run folder.
        rows: what metrics.json holds.
        frames: frames given to the system.
        skipped: frames that were broken, not counted in ``frames``.
        stopped_by: the signal that ended the run early, or None.
    """

    folder: Path
    rows: list[Row]
    frames: int
    skipped: int
    stopped_by: signal.Signals | None = None


def run(
    options: RunOptions, make_system: Callable[[Camera, SystemConfig], System] = SlamSystem
) -> RunSummary:
    """Run the system over a sequence and fill the run folder.

    SIGINT and SIGTERM end it after the current frame; what was tracked so far is then finished
    and saved like a whole run.

    Raises:
        InputError: a broken sequence or reference, or a run folder that cannot be used; nothing is
            left behind unless frames had been tracked before.
    """
    sequence = open_sequence(options.sequence)
    reference = find_reference(options.reference, sequence)
    name = "-".join(filter(None, (sequence.name, options.config_name)))
    with (
        RunFolder(options.out or free_run_path(name), options.overwrite) as folder,
        StopRequest() as stop,
    ):
        describe_run(folder, options, sequence)
        system = make_system(sequence.camera, options.config)
        tally = track(system, sequence, folder, options, stop)
        system.finish()
        rows = measure(system, reference, tally, options.stride)
        save(system, folder, rows, reference, name)
    skipped = sum(index < tally.next_index for index, _ in sequence.skipped)
    return RunSummary(folder.path, rows, len(tally.tracking_ms), skipped, stop.signal)


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
    origin = f"bmask-slam {__version__}, sequence {sequence.folder}, stride {options.stride}"
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


def track(
    system: System, sequence: Sequence, folder: RunFolder, options: RunOptions, stop: StopRequest
) -> Tally:
    """Process frames until the end, ``max_frames`` or a stop request, recording each."""
    end = len(sequence)
    if options.max_frames is not None:
        end = min(end, options.max_frames * options.stride)
    frames = sequence.frames(0, end, options.stride, prepare=_timed(system.prepare))
    tally, total = Tally(), len(range(0, end, options.stride))
    start_s = time.perf_counter()
    with (
        closing(frames),  # type: ignore[type-var]
        Progress(total, options.quiet) as bar,
        _snapshots(system, folder) as snapshot,
    ):
        for frame, (features, features_ms) in frames:
            result = system.process(frame, features)
            result = replace(result, stage_ms={**result.stage_ms, "features": features_ms})
            folder.write_frame(result)
            tally.count(result)
            bar.update(result)
            snapshot(len(tally.tracking_ms))
            if stop.signal is not None:
                break
        else:
            tally.next_index = end
    tally.wall_s = time.perf_counter() - start_s
    logger.info("%d frames in %.1f s", len(tally.tracking_ms), tally.wall_s)
    return tally


@contextmanager
def _snapshots(system: System, folder: RunFolder) -> Iterator[Callable[[int], None]]:
    """A function that, told the number of frames, saves the trajectory now and then.

    It grows rarer with the trajectory, so that the cost of a frame does not grow. Whatever ends
    the block, the trajectory is saved once more if there were any frames.
    """
    frames, due = 0, SNAPSHOT_FRAMES

    def snapshot(count: int) -> None:
        nonlocal frames, due
        frames = count
        if count >= due:
            folder.write_trajectory(system.trajectory())
            due = int(count * SNAPSHOT_GROWTH) + SNAPSHOT_FRAMES

    try:
        yield snapshot
    finally:
        if frames:
            folder.write_trajectory(system.trajectory())


def _timed(prepare: Callable[[Frame], Any]) -> Callable[[Frame], tuple[Any, float]]:
    """The function with the milliseconds it took."""

    def timed(frame: Frame) -> tuple[Any, float]:
        start_s = time.perf_counter()
        features = prepare(frame)
        return features, 1e3 * (time.perf_counter() - start_s)

    return timed
