"""The frames of one run through the system, recorded on the way."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from bmask_slam.features.brisk import Features
from bmask_slam.graph.files.whole_file import remove
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.offline.checkpoint import Checkpoints
from bmask_slam.offline.options import RunOptions
from bmask_slam.offline.self_calibration import SelfCalibrator
from bmask_slam.run_folder.folder import CAMERA, DENSE, RunFolder
from bmask_slam.run_folder.metrics import RunCounters
from bmask_slam.runtime.progress import Progress
from bmask_slam.runtime.stop_request import StopRequest
from bmask_slam.sequences.cameras import format_camera
from bmask_slam.sequences.frame import Frame
from bmask_slam.sequences.prefetch import FEATURES_AHEAD, prefetched
from bmask_slam.sequences.sequence import Sequence
from bmask_slam.system_interface import System

if TYPE_CHECKING:
    from bmask_slam.dense.options import MapOptions

logger = logging.getLogger(__name__)

SNAPSHOT_FRAMES = 30
SNAPSHOT_GROWTH = 1.05


@dataclass(eq=False)
class ActiveRun:
    """A run that has its system and its folder.

    Where it begins anew, sequence, system and counters are replaced, so that nothing keeps the old.

    Attributes:
        options: what to run, and how.
        sequence: its frames.
        reference: trajectory to compare with, if there is one.
        system: what processes the frames.
        folder: where results are written.
        stop: says when a signal asked to end the run.
        calibrator: finds what the camera file does not say; ``sequence`` has the camera in use.
        counters: of the frames processed so far.
        unwritten: why checkpoints could not be written, each.
    """

    options: RunOptions
    sequence: Sequence
    reference: Trajectory | None
    system: System
    folder: RunFolder
    stop: StopRequest
    calibrator: SelfCalibrator
    counters: RunCounters = field(default_factory=RunCounters)
    unwritten: list[str] = field(default_factory=list)

    @property
    def indices(self) -> range:
        """Indices in the sequence of all frames of the run."""
        return run_indices(self.sequence, self.options)

    @property
    def remaining(self) -> range:
        """The indices that are still to be processed."""
        done = -(-self.counters.next_index // self.options.stride)
        return self.indices[done:]


def run_indices(sequence: Sequence, options: RunOptions) -> range:
    """Indices in a sequence of all frames that a run processes."""
    end, stride = len(sequence), options.stride
    if options.max_frames is not None:
        end = min(end, options.max_frames * stride)
    return range(0, end, stride)


def _begin(run: ActiveRun, checkpoints: Checkpoints) -> None:
    """Before the first frame: the checkpoint, the camera that was found, and that as an event.

    Files that hold frames of an earlier beginning are cut after the checkpoint, which states their
    sizes, was written: a kill at any moment leaves files that fit the checkpoint.
    """
    found, events, first = run.calibrator.state, run.system.events, run.indices[:1]
    write_found_camera(run)
    checkpoints.write(run.system, run.counters)
    run.folder.begin_anew()
    if found.adopted:
        remove(run.folder.path / DENSE)
    for text in found.texts if first else ():
        events.begin_frame(first[0], float(run.sequence.timestamps_s[first[0]]))
        events.calibration(text)
        run.folder.write_events(events.take())


def process_frames(run: ActiveRun) -> bool:
    """Process the remaining frames; whether the run is to begin anew, with the camera found."""
    system, counters, remaining = run.system, run.counters, run.remaining
    frames = _prepared(run) if run.options.parallel else _plain(run)
    checkpoints = Checkpoints(run.folder, run.options, run.sequence, run.calibrator, run.unwritten)
    if not counters.frames:
        _begin(run, checkpoints)
    start_s, done = time.perf_counter() - counters.wall_s, len(run.indices) - len(remaining)
    with (
        closing(frames),
        Progress(len(run.indices), run.options.quiet, done) as bar,
        _snapshots(run) as snapshot,
    ):
        for ready in frames:
            result = system.process(*ready)
            run.folder.write_frame(result)
            counters.count(result)
            counters.wall_s = time.perf_counter() - start_s
            bar.update(result.status, counters.keyframes, counters.lost)
            snapshot()
            if run.stop.signal is not None:
                break
            if _is_to_begin_anew(run, last=False):
                return True
            checkpoints.after_frame(system, counters)
        else:
            if _is_to_begin_anew(run, last=True):
                return True
            counters.next_index = run.indices.stop
            checkpoints.write(system, counters)
    logger.info("%d frames in %.1f s", counters.frames, counters.wall_s)
    return False


def write_found_camera(run: ActiveRun) -> None:
    """Write the camera that was found; without one, take back that of an earlier beginning."""
    found = run.calibrator.state
    if found.adopted or found.rows or (found.covered and found.camera.covered):
        comment = "\n".join(found.texts)
        run.folder.write_text(CAMERA, format_camera(found.camera, comment))
    else:
        run.folder.remove_text(CAMERA)


def _plain(run: ActiveRun) -> Generator[tuple[Frame], None, None]:
    """The remaining frames."""
    remaining = run.remaining
    with closing(run.sequence.frames(remaining.start, remaining.stop, remaining.step)) as frames:
        for frame in frames:
            yield (frame,)


def _prepared(run: ActiveRun) -> Generator[tuple[Frame, Features], None, None]:
    """The remaining frames and their features, which a thread finds ahead of tracking."""
    prepare = run.system.prepare
    return prefetched(((frame, prepare(frame)) for (frame,) in _plain(run)), FEATURES_AHEAD)


def _is_to_begin_anew(run: ActiveRun, last: bool) -> bool:
    """Let the calibrator look at the run if it is time; whether the run has to begin anew."""
    if not run.calibrator.is_due(run.counters.frames, last):
        return False
    anew = run.calibrator.look(run.system, run.sequence)
    run.folder.write_events(run.system.events.take())
    if anew:
        logger.info("calibration: tracking begins anew with the camera that was found")
    return anew


def map_options(run: ActiveRun) -> MapOptions:
    """How the dense map of a run is made."""
    from bmask_slam.dense.options import MapOptions  # noqa: PLC0415 - loads torch

    return MapOptions(run.folder.path, mesh_voxel_m=run.options.mesh_voxel_m)


@contextmanager
def _snapshots(run: ActiveRun) -> Iterator[Callable[[], None]]:
    """A function, to be called after every frame, that saves the trajectory now and then.

    The interval grows with the trajectory, so that the mean cost of a frame does not. One that
    cannot be written does not end the run. When the block ends, for whatever reason, the trajectory
    is saved once more if there were any frames.
    """
    counters, failures = run.counters, 0
    due = counters.frames + SNAPSHOT_FRAMES

    def snapshot() -> None:
        nonlocal due, failures
        if counters.frames < due:
            return
        due = int(counters.frames * SNAPSHOT_GROWTH) + SNAPSHOT_FRAMES
        try:
            run.folder.write_trajectory(run.system.trajectory())
        except OSError as error:
            failures += 1
            level = logging.INFO if failures > 1 else logging.WARNING
            logger.log(level, "trajectory.txt: %s; the run goes on", error.strerror)

    try:
        yield snapshot
    finally:
        if counters.frames:
            run.folder.write_trajectory(run.system.trajectory())
