"""Self-calibration at the start of a run: what the motion shows of the camera, found and adopted.

A first stretch of the sequence is tracked, and the readout time of the rolling shutter and the
delay of the depth images are estimated from it, with the intrinsics held fixed: those of a
published calibration are better than what a short stretch shows, and an error of the depth scale,
which images and depths alone do not show, would be taken for one of the focal length. Whether it is
adopted is decided in `calibration.adoption`; for each round the stretch is tracked again.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from bmask_slam.calibration.adoption import (
    FIXED,
    FREE,
    CalibrationRounds,
    Estimate,
    SelfCalibration,
    SelfCalibrationConfig,
    estimate_times,
    format_times,
)
from bmask_slam.calibration.calibrate import CalibrateOptions, make_problem
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.run_folder.map_file import SavedRun
from bmask_slam.runtime.progress import Progress
from bmask_slam.runtime.stop_request import StopRequest
from bmask_slam.sequences import Sequence
from bmask_slam.system import SlamSystem
from bmask_slam.system_interface import System
from bmask_slam.tracking.results import TrackingStatus

logger = logging.getLogger(__name__)

MakeSystem = Callable[[Camera], System]


class SelfCalibrator:
    """Calibrates the camera of one sequence.

    Args:
        sequence: its frames; ``reopen`` opens it with another camera.
        indices: of the frames that the run will process.
        make_system: an empty system for a camera.
    """

    def __init__(
        self,
        sequence: Sequence,
        reopen: Callable[[Camera], Sequence],
        indices: range,
        make_system: MakeSystem,
        config: SelfCalibrationConfig | None = None,
    ) -> None:
        self._sequence, self._reopen = sequence, reopen
        self._indices, self._make_system = indices, make_system
        self._config = config or SelfCalibrationConfig()

    def calibrate(self, stop: StopRequest, quiet: bool) -> SelfCalibration:
        """What the first stretch that shows enough motion says of the camera.

        A stop request ends it with nothing adopted.
        """
        camera, config = self._sequence.camera, self._config
        for number in range(config.stretches):
            start = number * config.frames
            stretch = self._indices[start : start + config.frames]
            if len(stretch) < config.min_frames:
                break
            estimate = self._estimate(camera, stretch, stop, quiet)
            if estimate is None:
                return SelfCalibration(camera, camera)
            rounds = CalibrationRounds(camera, config)
            if rounds.shows(estimate):
                return self._in_rounds(rounds, estimate, stretch, stop, quiet)
        return SelfCalibration(camera, camera, "readout and delay not observable in the motion")

    def _in_rounds(
        self,
        rounds: CalibrationRounds,
        estimate: Estimate,
        stretch: range,
        stop: StopRequest,
        quiet: bool,
    ) -> SelfCalibration:
        """Track a stretch again with what was found, until that changes no more."""
        given = self._sequence.camera
        while (camera := rounds.add(estimate)) is not None:
            again = self._estimate(camera, stretch, stop, quiet)
            if again is None:
                return SelfCalibration(given, given)
            estimate = again
        return rounds.result()

    def _estimate(
        self, camera: Camera, stretch: range, stop: StopRequest, quiet: bool
    ) -> Estimate | None:
        """What a stretch tracked with a camera says; None if that is too little, or stopped."""
        sequence = self._reopen(camera)
        with _quiet_log():
            run = self._track(sequence, stretch, stop, quiet)
        if run is None:
            return None
        try:
            problem, _ = make_problem(CalibrateOptions(Path(), fixed=FIXED), run, sequence)
        except InputError as error:
            logger.info("calibration: %s", error)
            return None
        estimate = estimate_times(problem)
        text = format_times(estimate, FREE, "estimated")
        logger.info("calibration: frames %d to %d: %s", stretch[0], stretch[-1], text)
        return None if stop.signal is not None else estimate

    def _track(
        self, sequence: Sequence, stretch: range, stop: StopRequest, quiet: bool
    ) -> SavedRun | None:
        """A stretch of frames through a new system."""
        system = self._make_system(sequence.camera)
        if not isinstance(system, SlamSystem):
            return None
        frames = sequence.frames(stretch.start, stretch.stop, stretch.step, prepare=system.prepare)
        keyframes = lost = 0
        with closing(frames), Progress(len(stretch), quiet) as bar:
            for frame, features in frames:
                result = system.process(frame, features)
                keyframes += result.keyframe_id is not None
                lost += result.status is TrackingStatus.LOST
                bar.update(result.status, keyframes, lost)
                if stop.signal is not None:
                    return None
        return system.as_run()


@contextmanager
def _quiet_log() -> Iterator[None]:
    """Only errors are logged: what is tracked here is tracked again."""
    root = logging.getLogger("bmask_slam")
    level = root.level
    root.setLevel(logging.ERROR)
    try:
        yield
    finally:
        root.setLevel(level)
