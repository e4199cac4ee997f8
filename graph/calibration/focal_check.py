"""By how much the motion contradicts the focal lengths of a camera."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.calibration.calibration import CalibrationConfig, calibrate
from bmask_slam.graph.calibration.cross_validation import halves_of
from bmask_slam.graph.calibration.model import BEND, LENS, NORMAL_95, PARAMETERS, SHUTTER, F
from bmask_slam.graph.calibration.problem import CalibrationProblem
from bmask_slam.graph.threads import in_threads

MIN_KEYFRAMES = 12
"""Of fewer, the largest error found with right cameras was 5 %, ten times its sigma."""
FOCAL_PRIOR, SHUTTER_PRIOR_S, BEND_PRIOR = 0.2, 0.05, 0.02
LENS_PRIORS = 0.1, 0.2
SOLVER = CalibrationConfig(rounds=2, steps=4)


@dataclass(frozen=True)
class FocalCheck:
    """What the motion says of the focal lengths.

    Attributes:
        change: share by which both focal lengths should be larger.
        sigma: its standard deviation; errors within a landmark and a stretch count as one.
        halves: the change by either half of the keyframes alone; NaN where one is too small, or
            where the change of the whole is within its 95 % bounds, so that they are not asked for.
    """

    change: float
    sigma: float
    halves: tuple[float, float]

    def surely_beyond(self, limit: float) -> bool:
        """Whether 95 % bounds, and both halves of the run by at least half, exceed a limit."""
        return self.is_beyond(limit, NORMAL_95 * self.sigma)

    def is_beyond(self, limit: float, margin: float = 0.0) -> bool:
        """Whether the change, less a margin, and both halves by at least half exceed a limit."""
        sign = np.sign(self.change)
        beyond = abs(self.change) - margin > limit
        return bool(beyond and all(sign * half > limit / 2 for half in self.halves))


def check_focal(problem: CalibrationProblem) -> FocalCheck | None:
    """The change of focal lengths that the problem's views ask for; None: they show none.

    Poses, landmarks, the readout time and the distortion of depth are estimated along: the last two
    take the part of a focal length where they are wrong. So are k1 and k2 of a lens that has no
    distortion, as it was not calibrated then.
    """
    count = len(problem.poses_world_camera)
    if count < MIN_KEYFRAMES:
        return None
    sigmas = np.zeros(len(PARAMETERS))
    sigmas[F], sigmas[SHUTTER] = FOCAL_PRIOR * problem.calibration[F], SHUTTER_PRIOR_S
    sigmas[BEND] = BEND_PRIOR
    if not problem.calibration[LENS].any():
        sigmas[LENS][:2] = LENS_PRIORS
    problem = dataclasses.replace(problem, prior_sigmas=sigmas)
    try:
        return _in_whole_and_halves(problem)
    except np.linalg.LinAlgError:  # views that determine no calibration
        return None


def _in_whole_and_halves(problem: CalibrationProblem) -> FocalCheck:
    change, sigma = _common_change(problem)
    if abs(change) <= NORMAL_95 * sigma:
        return FocalCheck(change, sigma, (math.nan, math.nan))
    first, second = in_threads(
        lambda half: _common_change(half)[0] if half else math.nan, halves_of(problem)
    )
    return FocalCheck(change, sigma, (first, second))


def _common_change(problem: CalibrationProblem) -> tuple[float, float]:
    """The mean of the changes of fx and fy by their covariance C, (1' C^-1 x) / (1' C^-1 1)."""
    result = calibrate(problem, SOLVER)
    before: Array = problem.calibration[F]
    change = result.calibration[F] / before - 1
    information = np.linalg.inv(result.covariance[F, F] / np.outer(before, before))
    weights = information.sum(axis=0)
    return float(weights @ change / weights.sum()), float(weights.sum() ** -0.5)
