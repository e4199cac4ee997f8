"""Self-calibration in rounds: run again with the estimated camera, and calibrate that run.

A run with a wrong camera matches and checks observations with that camera, so the observations that
it keeps are biased toward it; a second run removes most of this bias.
"""

from __future__ import annotations

import dataclasses
import logging
import signal
from pathlib import Path

from bmask_slam.calibration.calibrate import (
    CalibrateOptions,
    calibrate_run,
    check_options,
)
from bmask_slam.calibration.report import Calibrated, format_calibration
from bmask_slam.config.configuration import resolve
from bmask_slam.evaluation import frame_stamps
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.whole_file import folder_beside
from bmask_slam.offline.runner import RunOptions, run
from bmask_slam.run_folder.origin import find_sequence, read_origin
from bmask_slam.sequences.cameras import write_camera
from bmask_slam.system_config import SystemConfig

logger = logging.getLogger(__name__)


def calibrate_in_rounds(options: CalibrateOptions, rounds: int, quiet: bool = False) -> Calibrated:
    """Calibrate a run, then ``rounds - 1`` times a new run made with the estimated camera.

    It ends earlier when a round agrees with the one before within the bounds of both.

    The new runs have the configuration of the first and are not kept. The camera file is written at
    the end. A signal that stops one of them ends all, and acts as usual.

    Returns:
        The last calibration; its ``before`` is the camera of the first run.

    Raises:
        InputError: as `calibrate_run`, or ``rounds`` is below 1.
    """
    if rounds < 1:
        raise InputError(f"--rounds {rounds}: must be a whole number of at least 1")
    out = check_options(options)
    sequence = options.sequence or find_sequence(options.run)
    with folder_beside(out, ".calibrate-") as folder:
        options_1 = dataclasses.replace(options, out=folder / "camera-1.yaml", sequence=sequence)
        done = calibrate_run(options_1)
        before = done.before
        for k in range(2, rounds + 1):
            logger.info("calibrated %d of %d times; running again", k - 1, rounds)
            again = folder / f"run-{k}"
            used = _again(options.run, sequence, done.path, again)
            full_size = before.reduced_by == 1
            summary = run(dataclasses.replace(used, quiet=quiet, full_size=full_size))
            if summary.stopped_by is not None:
                signal.raise_signal(summary.stopped_by)
            camera, earlier = folder / f"camera-{k}.yaml", done
            done = calibrate_run(dataclasses.replace(options_1, run=again, out=camera))
            if done.agrees_with(earlier):
                logger.info("calibrated %d times: nothing changes any more", k)
                break
    done = dataclasses.replace(done, path=out, before=before)
    write_camera(out, done.camera, format_calibration(done))
    return done


def _again(before: Path, sequence: Path, camera: Path, out: Path) -> RunOptions:
    """Options for the same frames and configuration with another camera."""
    config = before / "config.yaml"
    frames = frame_stamps(before / "trajectory.txt")
    return RunOptions(
        sequence,
        resolve(SystemConfig, config),
        out=out,
        camera=camera,
        max_frames=None if frames is None else len(frames),
        stride=read_origin(before).stride,
        calibrate="off",
    )
