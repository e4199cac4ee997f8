"""Whether a run should use what was found of its camera: by one estimate and the next.

Of a camera's parameters the readout time, the delay of depth and the distortion of depth may be
adopted; the last, five coefficients, as a whole. What was found is adopted if it is observable,
differs from what the camera given for the run has, is found by either half of the keyframes, and
fits the half that it was not estimated from better by two standard errors; where halves in the
order of time do not prove it, the half of every second keyframe. The last look decides anew.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np

from bmask_slam.calibration.calibrate import camera_from, with_rate_error
from bmask_slam.calibration.config import BENDS, FREE, LIMITS_S, TIMES, SelfCalibrationConfig
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.calibration.calibration import CalibrationResult
from bmask_slam.graph.calibration.cross_validation import CrossValidation, cross_validate
from bmask_slam.graph.calibration.model import BEND, SHUTTER, TIME, parameters_of
from bmask_slam.graph.calibration.problem import CalibrationProblem
from bmask_slam.graph.camera import Camera, depth_distortion_terms

logger = logging.getLogger(__name__)

NAMES = {SHUTTER: "rolling shutter", TIME: "colour-depth delay"}
UPWARDS = "rows are read from the bottom up, as in images turned by 180 degrees"
DOWNWARDS = "rows are read from the top down"
UNOBSERVABLE = "readout, delay and bend of depth not observable in the motion"
PLACES = np.stack(np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-0.75, 0.75, 7)), axis=-1)
BEND_TERMS = depth_distortion_terms(PLACES).reshape(-1, len(BENDS))
"""Those of the distortion of depth at places all over an image of 4:3."""


@dataclass(frozen=True)
class SelfCalibration:
    """What was found of a camera, and whether a run should use it.

    Attributes:
        given: the camera before.
        camera: to run with, that one if nothing is adopted.
        text: one line for the summary and the log; "" if nothing could be said.
        looks: how often the run was looked at in vain; as often as allowed: not before its end.
        settled: whether it needs no other look.
        bend_sigma: standard deviation of the distortion of depth that was adopted, in 1/m.
        covered: the same of ``Camera.covered``.
        rows: the same of the order of rows, where ``given`` has another than the camera before.
    """

    given: Camera
    camera: Camera
    text: str = ""
    looks: int = 0
    settled: bool = False
    bend_sigma: float = 0.0
    covered: str = ""
    rows: str = ""

    @property
    def adopted(self) -> bool:
        """Whether the camera is another one."""
        return self.camera != self.given

    @property
    def texts(self) -> tuple[str, ...]:
        """What was found, in lines."""
        return tuple(filter(None, (self.rows, self.text, self.covered)))


@dataclass(frozen=True, eq=False)
class Estimate:
    """Of one stretch: the vector (18,) before and after, standard deviations, and the problem.

    ``in_other_order``: rows are read in the order opposite to that of the camera's readout time.
    """

    before: Array
    found: Array
    sigmas: Array
    problem: CalibrationProblem
    in_other_order: bool = False

    def differs(self, i: int, config: SelfCalibrationConfig) -> bool:
        """Whether a parameter is observable, possible, and not that of the camera given."""
        min_change, largest = config.limits(i)
        change = abs(self.found[i] - self.before[i])
        return bool(
            self.shows(i, config)
            and change > max(config.min_change_sigmas * self.sigmas[i], min_change)
            and abs(self.found[i]) - 1.96 * self.sigmas[i] < largest
        )

    def contradicts(self, camera: Camera, config: SelfCalibrationConfig) -> bool:
        """Whether a camera found before has another time, or depth bent otherwise over the image.

        By the limits of ``differs``.
        """
        change = self.found - parameters_of(camera, camera.depth_scale)
        steps = {i: (abs(change[i]), self.sigmas[i]) for i in TIMES}
        steps[BENDS[0]] = _rms(change[BEND]), _rms_sigma(self.sigmas[BEND])
        return any(
            self.shows(i, config)
            and step > max(config.min_change_sigmas * sigma, config.limits(i)[0])
            for i, (step, sigma) in steps.items()
        )

    def is_surer(self, state: SelfCalibration, config: SelfCalibrationConfig) -> bool:
        """Whether it knows the distortion of depth much better than the estimate adopted before."""
        sigma = _rms_sigma(self.sigmas[BEND])
        return self.shows(BENDS[0], config) and sigma < config.surer * state.bend_sigma

    def shows(self, i: int, config: SelfCalibrationConfig) -> bool:
        """Whether a parameter is observable; the distortion of depth is so over the whole image."""
        if i in BENDS:
            return bool(0 < _rms_sigma(self.sigmas[BEND]) < config.max_bend_sigma)
        share = config.max_sigma_share * abs(self.found[i])
        return bool(0 < self.sigmas[i] < max(config.max_sigma_s, share))

    def agrees(self, i: int, halves: CrossValidation, config: SelfCalibrationConfig) -> bool:
        """Whether either half finds a parameter: within its bounds, or nearer to what was found
        than to what the camera has. The distortion of depth is compared over the image.
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
    """The state after an estimate, which is of the camera given.

    A parameter that does not show yet is looked for again later, unless one was adopted; after the
    last frame only, if the camera has it from a run before and is right in what does show. Only
    those of ``free`` may be adopted; with a mode other than "auto" it is only told. What was
    adopted before stays unless this estimate contradicts the camera in use or is much surer of the
    distortion of depth.
    """
    better = estimate.contradicts(state.camera, config) or estimate.is_surer(state, config)
    if state.adopted and not better:
        return state
    sure = {i for i in surely_other(estimate, config) if i in free}
    if sure:
        before = {i for i in adopted_parameters(state) if estimate.shows(i, config)}
        chosen = sorted(sure | before)
        verdict = "found and applied" if mode == "auto" else "found, not applied"
        text = format_found(estimate, chosen, verdict)
        if mode != "auto":
            return replace(state, text=text, settled=True)
        camera = camera_with(state.camera, estimate.found, chosen)
        sigma = _rms_sigma(estimate.sigmas[BEND]) if BENDS[0] in chosen else state.bend_sigma
        return replace(state, camera=camera, text=text, settled=True, bend_sigma=sigma)
    if state.adopted:
        return state
    seen = [i for i in free if estimate.shows(i, config)]
    differs = any(estimate.differs(i, config) for i in free)
    verdict = "not sure enough to be applied" if differs else "the camera keeps it"
    text = format_found(estimate, seen, verdict) if seen else UNOBSERVABLE
    unseen = [i for i in free if estimate.sigmas[i] > 0 and i not in seen]
    settled = not unseen and not differs
    known = mode == "auto" and bool(seen) and not differs and estimate.before[unseen].all()
    looks = config.stretches if known else state.looks + 1
    return replace(state, text=text, looks=looks, settled=settled)


def in_other_order(camera: Camera) -> Camera:
    """The camera with rows that are read in the opposite order."""
    return replace(camera, rolling_shutter_s=-camera.rolling_shutter_s)


def with_other_order(state: SelfCalibration, mode: str) -> SelfCalibration:
    """The state after an estimate that surely shows the other order of rows.

    It becomes that of the camera given, so that all else is looked for anew. With a mode other than
    "auto" it is only told; what such an estimate says of other parameters means nothing.
    """
    order = UPWARDS if state.given.rolling_shutter_s > 0 else DOWNWARDS
    if mode != "auto":
        return replace(state, text=f"{order}: found, not applied", settled=True)
    return replace(
        state,
        given=in_other_order(state.given),
        camera=in_other_order(state.camera),
        rows=f"{order}: found and applied",
    )


def adopted_parameters(state: SelfCalibration) -> set[int]:
    """Those that were adopted, the distortion of depth as a whole."""
    given, used = (parameters_of(c, c.depth_scale) for c in (state.given, state.camera))
    changed = set(np.flatnonzero(given != used).tolist())
    return changed | set(BENDS) if changed & set(BENDS) else changed


def surely_other(estimate: Estimate, config: SelfCalibrationConfig) -> list[int]:
    """The parameters that are surely not those of the camera given."""
    differing = [i for i in FREE if estimate.differs(i, config)]
    for alternately in (False, True) if differing else ():
        halves = cross_validate(estimate.problem, FREE, alternately)
        if halves is None:
            break
        logger.info(
            "calibration: better on observations kept out of the fit by %.1f standard errors%s",
            halves.gain_sigmas,
            " (every second keyframe)" if alternately else "",
        )
        if halves.gain_sigmas >= config.min_gain_sigmas:
            return _agreed(estimate, differing, halves, config)
    return []


def _agreed(
    estimate: Estimate, differing: list[int], halves: CrossValidation, config: SelfCalibrationConfig
) -> list[int]:
    """Those that both halves find; of the distortion of depth all or none."""
    agreed = {i for i in differing if estimate.agrees(i, halves, config)}
    if agreed & set(BENDS):  # one surface, of which no part is right alone
        possible = np.abs(estimate.found[BEND]).max() < config.max_bend
        agreed = agreed | set(BENDS) if possible else agreed - set(BENDS)
    return sorted(agreed)


def camera_with(camera: Camera, values: Array, chosen: list[int]) -> Camera:
    """The camera with some of the parameters of a vector (18,), rounded as in camera.yaml."""
    calibration = parameters_of(camera, camera.depth_scale)
    calibration[chosen] = values[chosen]
    for i, most_s in LIMITS_S.items():
        calibration[i] = np.clip(calibration[i], -most_s, most_s)
    found = camera_from(camera, calibration)
    return replace(
        camera,
        rolling_shutter_s=found.rolling_shutter_s,
        depth_time_offset_s=found.depth_time_offset_s,
        depth_distortion=found.depth_distortion,
    )


def format_found(estimate: Estimate, parameters: tuple[int, ...] | list[int], verdict: str) -> str:
    """Parameters in milliseconds and millimetres with 95 % bounds, and what became of them."""
    found = estimate.found
    parts = [
        f"{NAMES[i]} {1e3 * found[i]:.1f} ± {1.96e3 * estimate.sigmas[i]:.1f} ms"
        + (f" (at most {1e3 * LIMITS_S[i]:.0f} are used)" if abs(found[i]) > LIMITS_S[i] else "")
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
