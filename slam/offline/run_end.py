"""The end of a run: the last look at its camera, the last optimisation, measures and files."""

from __future__ import annotations

import logging
import signal
from dataclasses import dataclass
from pathlib import Path

from bmask_slam.back_end.reinterpretation import KeyframeMotion
from bmask_slam.calibration.camera_check import CameraCheck, check_camera, depth_warning
from bmask_slam.evaluation import Row
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.whole_file import remove
from bmask_slam.offline.frame_loop import ActiveRun, map_options, write_found_camera
from bmask_slam.offline.inherited_camera import recorded_motions
from bmask_slam.offline.weak_frames import weakly_tracked
from bmask_slam.run_folder.folder import CHECKPOINT, DENSE
from bmask_slam.run_folder.frame_file import FRAMES
from bmask_slam.run_folder.map_file import read_map
from bmask_slam.run_folder.metrics import measure, row, save
from bmask_slam.run_folder.reader import STOPPED
from bmask_slam.runtime.memory import give_back_memory
from bmask_slam.runtime.progress import counting_bar
from bmask_slam.system import SlamSystem

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class RunSummary:
    """How a run ended.

    Attributes:
        folder: the run folder.
        rows: what metrics.json holds.
        frames: frames given to the system.
        skipped: frames that were broken, not counted in ``frames``.
        stopped_by: the signal that ended the run early, or None.
        calibration: what was found of the camera, in one line; "" if nothing was tried.
        warnings: what the run says against its stamps, frames and camera, each with its evidence.
        resumable: the run can be resumed from its last checkpoint, since it was stopped.
    """

    folder: Path
    rows: list[Row]
    frames: int
    skipped: int
    stopped_by: signal.Signals | None = None
    resumable: bool = False
    calibration: str = ""
    warnings: tuple[str, ...] = ()


def finish_run(run: ActiveRun) -> RunSummary:
    """Finish the system, measure and save; a run that was not stopped is complete then."""
    counters, options, stopped_by = run.counters, run.options, run.stop.signal
    skipped = sum(index < counters.next_index for index, _ in run.sequence.skipped)
    _look_back(run)
    run.system.finish()
    give_back_memory()  # ISAM2's, which is not needed any more
    run.folder.write_events(run.system.events.take())
    rows = measure(run.system, run.reference, counters, _arrived(run))
    checked = _camera_checked(run)
    rows += checked.rows
    if stopped_by is not None:
        rows.append(row(STOPPED, counters.frames, "frames"))
    title = "-".join(filter(None, (run.sequence.name, options.config_name)))
    apart = save(run.system, run.folder, rows, run.reference, title)
    if options.dense:
        _make_dense_map(run)
    if stopped_by is None:
        run.folder.complete()
    folder = run.folder.path
    resumable = stopped_by is not None and (folder / CHECKPOINT).is_file()
    text = "; ".join(run.calibrator.state.texts)
    return RunSummary(
        folder,
        rows,
        counters.frames,
        skipped,
        stopped_by,
        resumable,
        text,
        run.sequence.recording.warnings
        + weakly_tracked(
            folder / FRAMES, options.config.tracking.min_inliers, bool(options.localise)
        )
        + apart
        + checked.warnings
        + _unwritten_checkpoints(run),
    )


def _make_dense_map(run: ActiveRun) -> None:
    from bmask_slam.dense.map_run import map_run  # noqa: PLC0415 - loads torch

    with counting_bar(run.options.quiet) as progress:
        map_run(map_options(run), progress)


def _look_back(run: ActiveRun) -> None:
    """Let the calibrator look at the whole run.

    If it finds another camera, a dense map, of a run that was stopped, is removed to be made again.
    """
    source = run.options.map

    def earlier() -> dict[int, KeyframeMotion]:
        return recorded_motions(read_map(source)[0]) if source else {}

    if run.calibrator.look_back(run.system, run.sequence, earlier):
        run.sequence = run.sequence.with_camera(run.calibrator.state.camera)
        write_found_camera(run)
        remove(run.folder.path / DENSE)


def _arrived(run: ActiveRun) -> int:
    """Frames of the sequence so far, with the broken ones."""
    return len(range(0, run.counters.next_index, run.options.stride))


def _unwritten_checkpoints(run: ActiveRun) -> tuple[str, ...]:
    """A warning if there are any; a resumed run would have begun with an earlier one."""
    if not run.unwritten:
        return ()
    return (f"{len(run.unwritten)} checkpoints not written, the last: {run.unwritten[-1]}",)


def _camera_checked(run: ActiveRun) -> CameraCheck:
    """What a run that was not stopped says against its camera, which is logged too."""
    nothing = CameraCheck((), (), ())
    if not isinstance(run.system, SlamSystem) or run.stop.signal is not None:
        return nothing
    if unit := depth_warning(run.sequence, run.options.config.features.max_depth_m):
        logger.warning("camera: %s", unit)
        return CameraCheck((unit,), (), (row("camera_warnings", 1, "1"),))
    try:
        checked = check_camera(run.system.as_run(), run.sequence, run.system.mapper.world)
    except InputError as error:
        logger.info("camera not checked: %s", error)
        return nothing
    for text in checked.notes:
        logger.info("camera: %s", text)
    for text in checked.warnings:
        logger.warning("camera: %s", text)
    return checked
