"""Whether a run should use what was found of its camera: by one estimate and the next.

Of a camera's parameters the readout time, the delay of depth and the distortion of depth may be
adopted; the last, five coefficients, as a whole.

What was found is adopted if it is observable, differs from what the camera has, is found in both
halves of the observations, and fits the half that it was not estimated from better by two standard
errors (`graph.calibration.cross_validation`).

A run with a wrong camera has matched what fits that camera, which draws the estimate towards it. An
offline run therefore searches its landmarks again (`calibration.rematching`); where that cannot be
done, estimates are made in rounds, each from frames tracked with what the round before found, until
that changes no more.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from bmask_slam.calibration.calibrate import camera_from, with_rate_error
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.calibration.calibration import CalibrationResult, calibrate
from bmask_slam.graph.calibration.cross_validation import CrossValidation, cross_validate
from bmask_slam.graph.calibration.model import BEND, PARAMETERS, SHUTTER, TIME, parameters_of
from bmask_slam.graph.calibration.problem import CalibrationProblem
from bmask_slam.graph.camera import Camera, depth_distortion_terms

logger = logging.getLogger(__name__)

TIMES = (SHUTTER, TIME)
BENDS = tuple(range(len(PARAMETERS))[BEND])
FREE = (*TIMES, *BENDS)
"""The parameters that are estimated, by their places in PARAMETERS."""
CALIBRATE = ("auto", "report", "off")
"""Whether what is found is used, only told, or not looked for."""
NAMES = {SHUTTER: "rolling shutter", TIME: "colour-depth delay"}
MIN_STEP_S, MAX_SHARE, MAX_S = 0.002, 0.6, 0.035
PLACES = np.stack(np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-0.75, 0.75, 7)), axis=-1)
BEND_TERMS = depth_distortion_terms(PLACES).reshape(-1, len(BENDS))
"""Those of the distortion of depth at places all over an image of 4:3."""


@dataclass(frozen=True)
class SelfCalibrationConfig:
    """How much is tracked, and when something is adopted.

    Attributes:
        frames: after which an offline run is looked at first; then after twice and four times as
            many, as long as the motion does not show the parameters.
        min_frames: fewer are not looked at, at the end of a sequence.
        stretches: how often it is looked at in vain at most.
        rounds: number of estimates of a live run at most.
        max_sigma_s: largest standard deviation of a parameter that counts as observable.
        min_change_sigmas: what is adopted differs by so many standard deviations,
        min_change_s: and by so much.
        min_gain_sigmas: so many standard errors is the gain on observations kept out of the fit.
        max_s: a time that is surely larger is no readout within a frame's interval, but an error;
            of one that may be, so much is adopted.
        max_bend_sigma, min_bend, max_bend: the same limits of the distortion of depth, in 1/m.
    """

    frames: int = 210
    min_frames: int = 90
    stretches: int = 3
    rounds: int = 4
    max_sigma_s: float = 0.004
    min_change_sigmas: float = 3.0
    min_change_s: float = 0.002
    min_gain_sigmas: float = 2.0
    max_s: float = MAX_S
    max_bend_sigma: float = 0.004
    min_bend: float = 0.003
    max_bend: float = 0.1

    def limits(self, i: int) -> tuple[float, float, float]:
        """Largest sigma, smallest change and largest value of a parameter."""
        if i in BENDS:
            return self.max_bend_sigma, self.min_bend, self.max_bend
        return self.max_sigma_s, self.min_change_s, self.max_s


@dataclass(frozen=True)
class SelfCalibration:
    """What was found of a camera, and whether a run should use it.

    Attributes:
        given: the camera before.
        camera: to run with, that one if nothing is adopted.
        text: one line for the summary and the log; "" if nothing could be said.
        looks: how often an offline run was looked at in vain.
        settled: whether it needs no other look.
    """

    given: Camera
    camera: Camera
    text: str = ""
    looks: int = 0
    settled: bool = False

    @property
    def adopted(self) -> bool:
        """Whether the camera is another one."""
        return self.camera != self.given


@dataclass(frozen=True, eq=False)
class Estimate:
    """Of one stretch: the vector (18,) before and after, standard deviations, and the problem."""

    before: Array
    found: Array
    sigmas: Array
    problem: CalibrationProblem

    def differs(self, i: int, config: SelfCalibrationConfig) -> bool:
        """Whether a parameter is observable, possible, and not what the camera has."""
        _, min_change, largest = config.limits(i)
        change = abs(self.found[i] - self.before[i])
        return bool(
            self.shows(i, config)
            and change > max(config.min_change_sigmas * self.sigmas[i], min_change)
            and abs(self.found[i]) - 1.96 * self.sigmas[i] < largest
        )

    def shows(self, i: int, config: SelfCalibrationConfig) -> bool:
        """Whether a parameter is observable; the distortion of depth is so over the whole image."""
        sigma = _rms_sigma(self.sigmas[BEND]) if i in BENDS else self.sigmas[i]
        return bool(0 < sigma < config.limits(i)[0])

    def settled(self, chosen: list[int]) -> bool:
        """Whether the run found what its camera had, within 95 % bounds of two rounds."""
        bounds = np.maximum(1.96 * np.sqrt(2) * self.sigmas[chosen], MIN_STEP_S)
        return bool((np.abs(self.found - self.before)[chosen] <= bounds).all())

    def agrees(self, i: int, halves: CrossValidation, config: SelfCalibrationConfig) -> bool:
        """Whether both halves alone find a parameter: within their bounds, or nearer to what was
        found than to what the camera has. The distortion of depth is compared over the image.
        """
        if i in BENDS:
            return self._bend_agrees(halves, config)
        bounds = config.min_change_sigmas * np.hypot(halves.sigmas[:, i], self.sigmas[i])
        nearer = abs(self.found[i] - self.before[i]) / 2
        off = np.abs(halves.calibrations[:, i] - self.found[i])
        return bool((off <= np.maximum(bounds, nearer)).all())

    def _bend_agrees(self, halves: CrossValidation, config: SelfCalibrationConfig) -> bool:
        found, sigma = self.found[BEND], _rms_sigma(self.sigmas[BEND])
        nearer = _rms(found - self.before[BEND]) / 2
        return all(
            _rms(half[BEND] - found)
            <= max(nearer, config.min_change_sigmas * np.hypot(_rms_sigma(sigmas[BEND]), sigma))
            for half, sigmas in zip(halves.calibrations, halves.sigmas, strict=True)
        )


def _rms(bend: Array) -> float:
    """Of a distortion of depth (5,) over the image, in 1/m."""
    return float(np.sqrt(np.mean((BEND_TERMS @ bend) ** 2)))


def _rms_sigma(sigmas: Array) -> float:
    """Standard deviation of a distortion with those (5,) of its coefficients, in 1/m."""
    return float(np.sqrt(np.mean(BEND_TERMS**2 @ sigmas**2)))


def estimate_times(problem: CalibrationProblem) -> Estimate:
    """What the observations of a problem say of a camera's times."""
    return estimate_of(problem, calibrate(problem))


def estimate_of(problem: CalibrationProblem, result: CalibrationResult) -> Estimate:
    """The estimate of a problem that was solved."""
    sigmas = np.sqrt(np.diag(with_rate_error(result).covariance))
    return Estimate(problem.calibration, result.calibration, sigmas, problem)


class CalibrationRounds:
    """Takes one estimate a round; says which camera to track with next, and what is adopted.

    Args:
        given: the camera of the first round.
        free: the parameters that may be adopted, by their places in PARAMETERS.
    """

    def __init__(
        self,
        given: Camera,
        config: SelfCalibrationConfig | None = None,
        free: tuple[int, ...] = TIMES,
    ) -> None:
        self._given, self._config, self._free = given, config or SelfCalibrationConfig(), free
        self._sure: list[int] = []
        self._rounds: list[Estimate] = []

    def shows(self, estimate: Estimate) -> bool:
        """Whether the motion of a stretch shows any of the parameters."""
        return any(estimate.shows(i, self._config) for i in TIMES)

    def add(self, estimate: Estimate) -> Camera | None:
        """Add the estimate of a round; the camera to track the next one with, None at the end."""
        tried = [i for i in self._free if i not in self._sure]
        more = newly_sure(estimate, tried, self._config)
        settled = bool(self._rounds) and not more and estimate.settled(self._sure)
        self._rounds.append(estimate)
        self._sure += more
        if not self._sure or settled or len(self._rounds) == self._config.rounds:
            return None
        return camera_with(self._given, next_start(self._rounds), self._sure)

    def result(self) -> SelfCalibration:
        """What the rounds together say of the given camera."""
        given, config = self._given, self._config
        start = parameters_of(given, given.depth_scale)
        final = dataclasses.replace(self._rounds[-1], before=start)
        kept = [i for i in self._sure if final.differs(i, config)]
        if not kept:
            return SelfCalibration(given, given, format_found(final, TIMES, self._refused(final)))
        camera = camera_with(given, final.found, kept)
        return SelfCalibration(given, camera, format_found(final, kept, "found and applied"))

    def _refused(self, estimate: Estimate) -> str:
        """Why nothing is adopted."""
        differs = any(estimate.differs(i, self._config) for i in TIMES)
        return "not sure enough to be applied" if differs else "the camera keeps its values"


def newly_sure(
    estimate: Estimate, tried: Iterable[int], config: SelfCalibrationConfig
) -> list[int]:
    """Those of the parameters tried that are to be adopted."""
    sure = [i for i in tried if estimate.differs(i, config)]
    halves = cross_validate(estimate.problem, FREE) if sure else None
    if halves is None:
        return []
    logger.info(
        "calibration: better on observations kept out of the fit by %.1f standard errors",
        halves.gain_sigmas,
    )
    if halves.gain_sigmas < config.min_gain_sigmas:
        return []
    agreed = {i for i in sure if estimate.agrees(i, halves, config)}
    if agreed & set(BENDS):  # one surface, of which no part is right alone
        possible = np.abs(estimate.found[BEND]).max() < config.max_bend
        agreed = agreed | set(BENDS) if possible else agreed - set(BENDS)
    return sorted(agreed)


def next_start(rounds: list[Estimate]) -> Array:
    """The vector (18,) to track with after some rounds.

    A run with a camera that is off by d finds one that is off by a share r of d, which two rounds
    show; what it tends to is x + (found - x) / (1 - r) (Aitken's extrapolation).
    """
    last = rounds[-1]
    if len(rounds) == 1:
        return last.found
    moved, changed = last.before - rounds[-2].before, last.found - rounds[-2].found
    share = np.divide(changed, moved, out=np.zeros(len(moved)), where=np.abs(moved) > MIN_STEP_S)
    return last.before + (last.found - last.before) / (1 - np.clip(share, 0.0, MAX_SHARE))


def camera_with(camera: Camera, values: Array, chosen: list[int]) -> Camera:
    """The camera with some of the parameters of a vector (18,), rounded as in camera.yaml."""
    calibration = parameters_of(camera, camera.depth_scale)
    calibration[chosen] = values[chosen]
    times = list(TIMES)
    calibration[times] = np.clip(calibration[times], -MAX_S, MAX_S)
    found = camera_from(camera, calibration)
    return dataclasses.replace(
        camera,
        rolling_shutter_s=found.rolling_shutter_s,
        depth_time_offset_s=found.depth_time_offset_s,
        depth_distortion=found.depth_distortion,
    )


def format_found(estimate: Estimate, parameters: tuple[int, ...] | list[int], verdict: str) -> str:
    """Parameters in milliseconds and millimetres with 95 % bounds, and what became of them."""
    parts = [
        f"{NAMES[i]} {1e3 * estimate.found[i]:.1f} ± {1.96e3 * estimate.sigmas[i]:.1f} ms"
        for i in parameters
        if i in TIMES and estimate.sigmas[i] > 0
    ]
    if set(BENDS) <= set(parameters):
        parts.append(_format_bend(estimate))
    return f"{', '.join(parts)}: {verdict}"


def _format_bend(estimate: Estimate) -> str:
    """The distortion of depth where it is largest."""
    bend = BEND_TERMS @ estimate.found[BEND]
    at = int(np.abs(bend).argmax())
    bound = 1.96 * float(np.linalg.norm(BEND_TERMS[at] * estimate.sigmas[BEND]))
    return f"depth bent by up to {1e3 * abs(bend[at]):.0f} ± {1e3 * bound:.0f} mm at 1 m"
