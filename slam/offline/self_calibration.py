"""Self-calibration at the start of a run: what the motion shows of the camera, found and adopted.

A first stretch of the sequence is tracked, and the readout time of the rolling shutter and the
delay of the depth images are estimated from it, with the intrinsics held fixed: those of a
published calibration are better than what a short stretch shows, and an error of the depth scale,
which images and depths alone do not show, would be taken for one of the focal length. What was
found is adopted if it is observable, differs from what the camera has, fits observations that it
was not estimated from better (`graph.calibration.cross_validation`), and is found in both halves
of the stretch. A run with a wrong camera has matched what fits that camera, which draws the
estimate towards it, so the stretch is then tracked again with what was found, until that changes
no more.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bmask_slam.calibration.calibrate import (
    CalibrateOptions,
    camera_from,
    make_problem,
    with_rate_error,
)
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.calibration.calibration import calibrate
from bmask_slam.graph.calibration.cross_validation import CrossValidation, cross_validate
from bmask_slam.graph.calibration.model import PARAMETERS, SHUTTER, TIME, parameters_of
from bmask_slam.graph.calibration.problem import CalibrationProblem
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

FREE = (SHUTTER, TIME)
"""The parameters that are estimated, by their places in PARAMETERS."""
NAMES = {SHUTTER: "rolling shutter", TIME: "colour-depth delay"}
MIN_STEP_S, MAX_SHARE = 0.002, 0.6


@dataclass(frozen=True)
class SelfCalibrationConfig:
    """How much is tracked, and when something is adopted.

    Attributes:
        frames: of a stretch.
        min_frames: of a sequence; a shorter one is not calibrated.
        stretches: how many are tried until one shows the parameters.
        rounds: how often a stretch is tracked at most.
        max_sigma_s: largest standard deviation of a parameter that counts as observable.
        min_change_sigmas: what is adopted differs by so many standard deviations.
        min_gain_sigmas: so many standard errors is the gain on observations kept out of the fit.
        max_s: a larger time is no readout within a frame's interval, but an error.
    """

    frames: int = 210
    min_frames: int = 90
    stretches: int = 3
    rounds: int = 4
    max_sigma_s: float = 0.004
    min_change_sigmas: float = 3.0
    min_gain_sigmas: float = 2.0
    max_s: float = 0.035


@dataclass(frozen=True)
class SelfCalibration:
    """What was found of a camera, and whether a run should use it.

    Attributes:
        given: the camera before.
        camera: to run with, that one if nothing is adopted.
        text: one line for the summary and the log; "" if nothing could be said.
    """

    given: Camera
    camera: Camera
    text: str = ""

    @property
    def adopted(self) -> bool:
        """Whether the camera is another one."""
        return self.camera != self.given


@dataclass(frozen=True, eq=False)
class _Estimate:
    """Of one stretch: the vector (13,) before and after, standard deviations, and the problem."""

    before: Array
    found: Array
    sigmas: Array
    problem: CalibrationProblem

    def differs(self, i: int, config: SelfCalibrationConfig) -> bool:
        """Whether a parameter is observable, possible, and not what the camera has."""
        change_s = abs(self.found[i] - self.before[i])
        return bool(
            self.sigmas[i] < config.max_sigma_s
            and change_s > config.min_change_sigmas * self.sigmas[i]
            and abs(self.found[i]) < config.max_s
        )

    def settled(self, chosen: list[int]) -> bool:
        """Whether the run found what its camera had, within 95 % bounds of two rounds."""
        bounds = 1.96 * np.sqrt(2) * self.sigmas[chosen]
        return bool((np.abs(self.found - self.before)[chosen] <= bounds).all())

    def agrees(self, i: int, halves: CrossValidation, config: SelfCalibrationConfig) -> bool:
        """Whether both halves alone find a parameter, as far as they show it."""
        bounds = config.min_change_sigmas * np.hypot(halves.sigmas[:, i], self.sigmas[i])
        return bool((np.abs(halves.calibrations[:, i] - self.found[i]) <= bounds).all())


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
            if stop.signal is not None or estimate is None:
                return SelfCalibration(camera, camera)
            if min(estimate.sigmas[i] for i in FREE) < config.max_sigma_s:
                return self._rounds(estimate, stretch, stop, quiet)
        return SelfCalibration(camera, camera, "readout and delay not observable in the motion")

    def _rounds(
        self, estimate: _Estimate, stretch: range, stop: StopRequest, quiet: bool
    ) -> SelfCalibration:
        """Track a stretch again with what was found, until that changes no more."""
        given, config = self._sequence.camera, self._config
        sure, rounds = self._sure(estimate, ()), [estimate]
        for _ in range(config.rounds - 1 if sure else 0):
            camera = _with(given, _next(rounds), sure)
            again = self._estimate(camera, stretch, stop, quiet)
            if again is None or stop.signal is not None:
                return SelfCalibration(given, given)
            rounds.append(again)
            more = self._sure(again, sure)
            if not more and again.settled(sure):
                break
            sure += more
        start = parameters_of(given, given.depth_scale)
        final = dataclasses.replace(rounds[-1], before=start)
        kept = [i for i in sure if final.differs(i, config)]
        if not kept:
            return SelfCalibration(given, given, _told(final, FREE, self._refused(final)))
        camera = _with(given, final.found, kept)
        return SelfCalibration(given, camera, _told(final, kept, "found and applied"))

    def _refused(self, estimate: _Estimate) -> str:
        """Why nothing is adopted."""
        differs = any(estimate.differs(i, self._config) for i in FREE)
        return "not sure enough to be applied" if differs else "the camera keeps its values"

    def _sure(self, estimate: _Estimate, known: Iterable[int]) -> list[int]:
        """The parameters that are to be adopted beside those that already are."""
        sure = [i for i in FREE if i not in known and estimate.differs(i, self._config)]
        halves = cross_validate(estimate.problem) if sure else None
        if halves is None:
            return []
        logger.info(
            "calibration: better on observations kept out of the fit by %.1f standard errors",
            halves.gain_sigmas,
        )
        if halves.gain_sigmas < self._config.min_gain_sigmas:
            return []
        return [i for i in sure if estimate.agrees(i, halves, self._config)]

    def _estimate(
        self, camera: Camera, stretch: range, stop: StopRequest, quiet: bool
    ) -> _Estimate | None:
        """What a stretch of frames tracked with a camera says; None if that is too little."""
        sequence = self._reopen(camera)
        with _quiet_log():
            run = self._track(sequence, stretch, stop, quiet)
        if run is None:
            return None
        fixed = tuple(name for i, name in enumerate(PARAMETERS) if i not in FREE)
        try:
            problem, _ = make_problem(CalibrateOptions(Path(), fixed=fixed), run, sequence)
        except InputError as error:
            logger.info("calibration: %s", error)
            return None
        result = with_rate_error(calibrate(problem))
        sigmas = np.sqrt(np.diag(result.covariance))
        estimate = _Estimate(problem.calibration, result.calibration, sigmas, problem)
        text = _told(estimate, FREE, "estimated")
        logger.info("calibration: frames %d to %d: %s", stretch[0], stretch[-1], text)
        return estimate

    def _track(
        self, sequence: Sequence, stretch: range, stop: StopRequest, quiet: bool
    ) -> SavedRun | None:
        """A stretch of frames through a new system."""
        system = self._make_system(sequence.camera)
        if not isinstance(system, SlamSystem):
            return None
        frames = sequence.frames(stretch.start, stretch.stop, stretch.step, prepare=system.prepare)
        keyframes = lost = 0
        with closing(frames), Progress(len(stretch), quiet) as bar:  # type: ignore[type-var]
            for frame, features in frames:
                result = system.process(frame, features)
                keyframes += result.keyframe_id is not None
                lost += result.status is TrackingStatus.LOST
                bar.update(result.status, keyframes, lost)
                if stop.signal is not None:
                    return None
        return system.as_run()


def _next(rounds: list[_Estimate]) -> Array:
    """The vector (13,) to track with after some rounds.

    A run with a camera that is off by d finds one that is off by a share r of d, which two rounds
    show; what it tends to is x + (found - x) / (1 - r) (Aitken's extrapolation).
    """
    last = rounds[-1]
    if len(rounds) == 1:
        return last.found
    moved, changed = last.before - rounds[-2].before, last.found - rounds[-2].found
    share = np.divide(changed, moved, out=np.zeros(len(moved)), where=np.abs(moved) > MIN_STEP_S)
    return last.before + (last.found - last.before) / (1 - np.clip(share, 0.0, MAX_SHARE))


def _with(camera: Camera, values: Array, chosen: list[int]) -> Camera:
    """The camera with some of the parameters of a vector (13,)."""
    calibration = parameters_of(camera, camera.depth_scale)
    calibration[chosen] = values[chosen]
    found = camera_from(camera, calibration)
    return dataclasses.replace(
        camera,
        rolling_shutter_s=found.rolling_shutter_s,
        depth_time_offset_s=found.depth_time_offset_s,
    )


def _told(estimate: _Estimate, parameters: tuple[int, ...] | list[int], verdict: str) -> str:
    """Parameters in milliseconds with 95 % bounds, and what became of them."""
    parts = [
        f"{NAMES[i]} {1e3 * estimate.found[i]:.1f} ± {1.96e3 * estimate.sigmas[i]:.1f} ms"
        for i in parameters
    ]
    return f"{', '.join(parts)}: {verdict}"


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
