"""Checkpoints: the state of a run in one file of its folder, from which a killed run is resumed.

A run with checkpoints and one that was killed and resumed write the same bytes. ISAM2, which cannot
be saved, is therefore rebuilt at each checkpoint in both: `SlamSystem.restart`.
"""

from __future__ import annotations

import dataclasses
import hashlib
import logging
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bmask_slam import __version__
from bmask_slam.calibration.adoption import SelfCalibration
from bmask_slam.config.configuration import dump, from_text, resolve
from bmask_slam.events import EVENTS
from bmask_slam.graph.arrays import Arrays
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.array_file import FileKind, nested, part, read_arrays, write_arrays
from bmask_slam.graph.files.whole_file import remove
from bmask_slam.graph.smoother.storage import read_camera
from bmask_slam.offline.options import RunOptions
from bmask_slam.offline.self_calibration import SelfCalibrator
from bmask_slam.run_folder.folder import CHECKPOINT, RunFolder
from bmask_slam.run_folder.frame_file import FRAMES
from bmask_slam.run_folder.metrics import RunCounters
from bmask_slam.sequences.sequence import Sequence
from bmask_slam.system_config import SystemConfig
from bmask_slam.system_interface import System

logger = logging.getLogger(__name__)

CHECKPOINT_FILE = FileKind("checkpoint", 7)


@dataclass(frozen=True)
class Checkpoint:
    """The state of a run after some frames.

    Attributes:
        options: of the run.
        camera: of the sequence, as the run uses it.
        calibration: what was found of the camera, whose ``given`` was the sequence's.
        stamps: digest of all timestamps of the sequence.
        skipped: index and reason of the broken frames so far.
        sizes: of the files that grow, in bytes by name; 0 for one that older versions lack.
        counters: of the frames so far.
        state: of the system.
    """

    options: RunOptions
    camera: Camera
    calibration: SelfCalibration
    stamps: str
    skipped: list[tuple[int, str]]
    sizes: dict[str, int]
    counters: RunCounters
    state: Arrays

    def check_sequence(self, sequence: Sequence) -> None:
        """Raise InputError for a sequence with another camera or other timestamps."""
        for what, same in (
            ("camera", sequence.camera == self.camera),
            ("frames", digest(sequence) == self.stamps),
        ):
            if not same:
                raise InputError(
                    f"{sequence.folder}: not the {what} that the run was started with; "
                    "restore the sequence, or start a new run"
                )


def digest(sequence: Sequence) -> str:
    """SHA-256 of a sequence's timestamps."""
    return hashlib.sha256(sequence.timestamps_s.tobytes()).hexdigest()


class Checkpoints:
    """Writes the checkpoints of one run; none without ``checkpoint_every``.

    One that cannot be written, as on a full disk, does not end the run: the next one may be, and
    what the run writes at its end does not depend on it.
    """

    def __init__(
        self,
        folder: RunFolder,
        options: RunOptions,
        sequence: Sequence,
        calibrator: SelfCalibrator,
        unwritten: list[str],
    ) -> None:
        """``unwritten`` gets the reason for every checkpoint that cannot be written."""
        self._folder = folder
        self._options = options
        self._sequence = sequence
        self._calibrator = calibrator
        self._every = options.checkpoint_every
        self._unwritten = unwritten
        self._frames = -1  # number of frames at the last checkpoint

    def after_frame(self, system: System, counters: RunCounters) -> None:
        """Write a checkpoint if it is due."""
        if self._every is not None and counters.frames % self._every == 0:
            self.write(system, counters)

    def write(self, system: System, counters: RunCounters) -> None:
        """Write a checkpoint, unless the last one is of the same frame.

        The last one stays until the new one is complete.
        """
        if self._every is None or counters.frames == self._frames:
            return
        start_s = time.perf_counter()
        system.restart()
        if counters.frames:  # what other processes told while they were waited for
            self._folder.write_events(system.events.take())
        skipped = [(i, reason) for i, reason in self._sequence.skipped if i < counters.next_index]
        checkpoint = Checkpoint(
            self._options,
            self._sequence.camera,
            self._calibrator.state,
            digest(self._sequence),
            skipped,
            self._folder.synced_bytes() if counters.frames else self._folder.empty_bytes,
            counters,
            system.state(),
        )
        self._frames = counters.frames
        try:
            self._folder.written(lambda path: write_checkpoint(path / CHECKPOINT, checkpoint))
        except InputError as error:
            self._note_failure(error)
            return
        size = (self._folder.path / CHECKPOINT).stat().st_size
        megabytes, ms = size / 1e6, 1e3 * (time.perf_counter() - start_s)
        logger.info("checkpoint after %d frames: %.1f MB, %.0f ms", counters.frames, megabytes, ms)

    def _note_failure(self, error: InputError) -> None:
        """Warn once; before the first frame an older checkpoint, of another beginning, goes."""
        level = logging.INFO if self._unwritten else logging.WARNING
        logger.log(level, "%s; the run goes on and tries again at the next checkpoint", error)
        self._unwritten.append(str(error))
        if not self._frames:
            with suppress(OSError):
                remove(self._folder.path / CHECKPOINT)


def write_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Save a checkpoint in one file, atomically. Raises InputError if it cannot."""
    counters = dataclasses.asdict(checkpoint.counters)
    header = {
        "bmask-slam": __version__,
        "options": checkpoint.options.recorded(),
        "config": dump(checkpoint.options.config),
        "camera": dataclasses.asdict(checkpoint.camera),
        "calibration": dataclasses.asdict(checkpoint.calibration),
        "stamps": checkpoint.stamps,
        "skipped": checkpoint.skipped,
        "frames_bytes": checkpoint.sizes[FRAMES],
        "events_bytes": checkpoint.sizes[EVENTS],
        "tally": {name: value for name, value in counters.items() if name != "tracking_ms"},
    }
    tracking_ms = np.array(checkpoint.counters.tracking_ms, float)
    arrays = nested(run={"tracking_ms": tracking_ms}, system=checkpoint.state)
    write_arrays(path, CHECKPOINT_FILE, header, arrays)


def read_checkpoint(folder: Path) -> Checkpoint:
    """Read the checkpoint of a run folder.

    Raises:
        InputError: it is missing, broken, of another kind or version, or config.yaml has changed
            since it was written.
    """
    path = folder / CHECKPOINT
    if not path.exists():
        raise InputError(
            f"{folder}: holds no checkpoint, so there is nothing to resume; give the folder of a "
            "run that was started with --checkpoint-every, or start the run again with --overwrite"
        )
    header, arrays = read_arrays(path, CHECKPOINT_FILE)
    config = resolve(SystemConfig, folder / "config.yaml")
    try:
        written = header["config"]
        if written != dump(config) and from_text(SystemConfig, written, str(path)) != config:
            raise InputError(
                f"{folder / 'config.yaml'}: not the configuration that {path.name} was made with; "
                "restore it, or start a new run"
            )
        if header["bmask-slam"] != __version__:
            logger.warning("%s: written by bmask-slam %s", path, header["bmask-slam"])
        tracking_ms = arrays["run.tracking_ms"].tolist()
        return Checkpoint(
            RunOptions.from_recorded(header["options"], config, folder),
            read_camera(header, path),
            _calibration(header["calibration"], path),
            header["stamps"],
            [(int(i), str(reason)) for i, reason in header["skipped"]],
            {FRAMES: int(header["frames_bytes"]), EVENTS: int(header.get("events_bytes", 0))},
            RunCounters(tracking_ms=tracking_ms, **header["tally"]),
            part(arrays, "system"),
        )
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{path}: its header cannot be read ({error}); start the run again"
        ) from error


def _calibration(header: dict[str, Any], path: Path) -> SelfCalibration:
    """What a checkpoint says of the calibration. Raises InputError, KeyError or TypeError."""
    cameras = {name: read_camera({"camera": header[name]}, path) for name in ("camera", "given")}
    return SelfCalibration(**{**header, **cameras})
