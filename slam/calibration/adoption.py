"""Whether a run should use what was found of its camera: by one estimate and the next.

Of a camera's parameters the readout time, the delay of depth and the distortion of depth may be
adopted; the last, five coefficients, as a whole.

What was found is adopted if it is observable, differs from what the camera has, is found in both
halves of the observations, and fits the half that it was not estimated from better by two standard
errors (`graph.calibration.cross_validation`). Half of them may be too few to know it, so quarters
are tried if halves fail: each is judged by what the other three say.

A run with a wrong camera has matched what fits that camera, which draws the estimate towards it. So
its landmarks are searched again (`calibration.rematching`).
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from bmask_slam.calibration.calibrate import camera_from, with_rate_error
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.calibration.calibration import CalibrationResult
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
MAX_S = 0.035
PARTS = 2, 4
"""Into which the keyframes are split, one after the other, until the proof succeeds."""
UNOBSERVABLE = "readout, delay and bend of depth not observable in the motion"
PLACES = np.stack(np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-0.75, 0.75, 7)), axis=-1)
BEND_TERMS = depth_distortion_terms(PLACES).reshape(-1, len(BENDS))
"""Those of the distortion of depth at places all over an image of 4:3."""


@dataclass(frozen=True)
class SelfCalibrationConfig:
    """How much is tracked, and when something is adopted.

    Attributes:
        frames: after which a run is looked at first; then after twice and four times as many, as
            long as the motion does not show the parameters.
        min_frames: fewer are not looked at, at the end of a sequence.
        stretches: how often it is looked at in vain at most.
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
        looks: how often the run was looked at in vain.
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

    def agrees(self, i: int, parts: CrossValidation, config: SelfCalibrationConfig) -> bool:
        """Whether a parameter is found without each part: within its bounds, or nearer to what was
        found than to what the camera has. The distortion of depth is compared over the image.
        """
        if i in BENDS:
            return self._bend_agrees(parts, config)
        bounds = config.min_change_sigmas * np.hypot(parts.sigmas[:, i], self.sigmas[i])
        nearer = abs(self.found[i] - self.before[i]) / 2
        off = np.abs(parts.calibrations[:, i] - self.found[i])
        return bool((off <= np.maximum(bounds, nearer)).all())

    def _bend_agrees(self, parts: CrossValidation, config: SelfCalibrationConfig) -> bool:
        found, sigma = self.found[BEND], _rms_sigma(self.sigmas[BEND])
        nearer = _rms(found - self.before[BEND]) / 2
        return all(
            _rms(other[BEND] - found)
            <= max(nearer, config.min_change_sigmas * np.hypot(_rms_sigma(sigmas[BEND]), sigma))
            for other, sigmas in zip(parts.calibrations, parts.sigmas, strict=True)
        )


def _rms(bend: Array) -> float:
    """Of a distortion of depth (5,) over the image, in 1/m."""
    return float(np.sqrt(np.mean((BEND_TERMS @ bend) ** 2)))


def _rms_sigma(sigmas: Array) -> float:
    """Standard deviation of a distortion with those (5,) of its coefficients, in 1/m."""
    return float(np.sqrt(np.mean(BEND_TERMS**2 @ sigmas**2)))


def estimate_of(problem: CalibrationProblem, result: CalibrationResult) -> Estimate:
    """The estimate of a problem that was solved."""
    sigmas = np.sqrt(np.diag(with_rate_error(result).covariance))
    return Estimate(problem.calibration, result.calibration, sigmas, problem)


def judged(
    state: SelfCalibration,
    estimate: Estimate,
    mode: str,
    config: SelfCalibrationConfig,
    free: tuple[int, ...] = FREE,
) -> SelfCalibration:
    """The state after an estimate. What was adopted is not estimated again.

    A parameter that does not show yet is looked for again later, unless one was adopted. Only those
    of ``free`` may be; with a mode other than "auto" it is only told.
    """
    sure = [i for i in newly_sure(estimate, FREE, config) if i in free]
    if sure:
        verdict = "found and applied" if mode == "auto" else "found, not applied"
        text = format_found(estimate, sure, verdict)
        if mode != "auto":
            return dataclasses.replace(state, text=text, settled=True)
        camera = camera_with(state.given, estimate.found, sure)
        return dataclasses.replace(state, camera=camera, text=text, settled=True)
    seen = [i for i in free if estimate.shows(i, config)]
    differs = any(estimate.differs(i, config) for i in free)
    verdict = "not sure enough to be applied" if differs else "the camera keeps it"
    text = format_found(estimate, seen, verdict) if seen else UNOBSERVABLE
    looked_for = np.count_nonzero(estimate.sigmas[list(free)])
    settled = bool(len(seen) == looked_for and not differs)
    looks = state.looks + 1
    return dataclasses.replace(state, text=text, looks=looks, settled=settled)


def newly_sure(
    estimate: Estimate, tried: Iterable[int], config: SelfCalibrationConfig
) -> list[int]:
    """Those of the parameters tried that are to be adopted."""
    sure = [i for i in tried if estimate.differs(i, config)]
    for parts in PARTS if sure else ():
        judged_by_parts = cross_validate(estimate.problem, FREE, parts)
        if judged_by_parts is None:
            break
        gain_sigmas = judged_by_parts.gain_sigmas
        logger.info(
            "calibration: better on observations kept out of the fit by %.1f standard errors "
            "(%d parts)",
            gain_sigmas,
            parts,
        )
        if gain_sigmas >= config.min_gain_sigmas:
            return _agreed(estimate, sure, judged_by_parts, config)
    return []


def _agreed(
    estimate: Estimate, sure: list[int], parts: CrossValidation, config: SelfCalibrationConfig
) -> list[int]:
    """Those that are found without each part; of the distortion of depth all or none."""
    agreed = {i for i in sure if estimate.agrees(i, parts, config)}
    if agreed & set(BENDS):  # one surface, of which no part is right alone
        possible = np.abs(estimate.found[BEND]).max() < config.max_bend
        agreed = agreed | set(BENDS) if possible else agreed - set(BENDS)
    return sorted(agreed)


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
