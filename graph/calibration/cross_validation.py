"""Whether a calibration fits observations that it was not estimated from, and agrees in halves.

The keyframes are split into two halves. The calibration is estimated from each; then poses and
points of the other half are fitted with it and, for comparison, with the one that was there before.
Nothing of a half is in the calibration that it judges.

Halves in the order of time share no landmark, but either may leave some of a calibration
undetermined, which the other then refuses. If every second keyframe is in the other half, both have
seen and turned as the camera did; but neighbours are farther apart, and share fewer landmarks.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from bmask_slam.graph.arrays import Array, Ints, Mask
from bmask_slam.graph.calibration.calibration import (
    CalibrationConfig,
    CalibrationResult,
    calibrate,
)
from bmask_slam.graph.calibration.equations import CAUCHY, squared
from bmask_slam.graph.calibration.model import PARAMETERS, CalibrationViews, residuals_of
from bmask_slam.graph.calibration.problem import CalibrationProblem, CalibrationState
from bmask_slam.graph.threads import in_threads

MIN_KEYFRAMES = 5
ALL = range(len(PARAMETERS))
QUICK = CalibrationConfig(rounds=2, steps=4, tolerance=1e-3)


@dataclass(frozen=True)
class CrossValidation:
    """Calibrations from two halves of the keyframes, each judged by the other half.

    Attributes:
        calibrations, sigmas: (2, 18) from each half.
        gains: (K,) of every judged keyframe, the drop of its robust cost, in units of the
            estimated noise, from the calibration before to that of the other half.
    """

    calibrations: Array
    sigmas: Array
    gains: Array

    @property
    def gain_sigmas(self) -> float:
        """The mean gain over its standard error; above 2 the calibrations are really better."""
        error = self.gains.std(ddof=1) / np.sqrt(len(self.gains))
        return float(self.gains.mean() / max(error, 1e-12))


def cross_validate(
    problem: CalibrationProblem, judged: Sequence[int] = ALL, alternately: bool = False
) -> CrossValidation | None:
    """Calibrate from each half of the keyframes, and judge by the other; None: too few views.

    Parameters that are free but not among those ``judged``, by their places in PARAMETERS, are
    fitted to the half that judges, with what was there before and with what was found.
    """
    first, second = halves_of(problem, alternately)
    if first is None or second is None:
        return None
    found = in_threads(partial(calibrate, config=QUICK), (first, second))
    judges = (second, found[0]), (first, found[1])
    gains = in_threads(lambda judge: _gains(*judge, list(judged)), judges)
    return CrossValidation(
        np.array([result.calibration for result in found]),
        np.array([np.sqrt(np.diag(result.covariance)) for result in found]),
        np.concatenate(gains),
    )


def halves_of(
    problem: CalibrationProblem, alternately: bool = False
) -> tuple[CalibrationProblem | None, CalibrationProblem | None]:
    """The problems of the first and the last half of the keyframes; None for too few views.

    Or of every second keyframe, ``alternately``.
    """
    count = len(problem.poses_world_camera)
    second = np.arange(count) % 2 == 1 if alternately else np.arange(count) >= count // 2
    return _part_of(problem, ~second), _part_of(problem, second)


def _part_of(problem: CalibrationProblem, keyframes: Mask) -> CalibrationProblem | None:
    """The problem of some keyframes (K,), with landmarks that two of them see."""
    views = problem.views
    keep = keyframes[views.keyframes]
    seen = np.bincount(views.landmarks[keep], minlength=len(problem.points_world))
    keep &= seen[views.landmarks] >= 2
    kept_keyframes, rows = np.unique(views.keyframes[keep], return_inverse=True)
    kept_landmarks, points = np.unique(views.landmarks[keep], return_inverse=True)
    if len(kept_keyframes) < MIN_KEYFRAMES:
        return None
    return dataclasses.replace(
        problem,
        views=_select(views, keep, rows, points),
        poses_world_camera=problem.poses_world_camera[kept_keyframes],
        points_world=problem.points_world[kept_landmarks],
        anchors=None,
    )


def _select(
    views: CalibrationViews, keep: Mask, keyframes: Ints, landmarks: Ints
) -> CalibrationViews:
    columns = {f.name: getattr(views, f.name)[keep] for f in dataclasses.fields(views)}
    return CalibrationViews(**{**columns, "keyframes": keyframes, "landmarks": landmarks})


def _gains(problem: CalibrationProblem, result: CalibrationResult, judged: list[int]) -> Array:
    """Of each keyframe (K,), the drop of its cost from the problem's calibration to another's.

    Poses and points are fitted with each. Both times the noise is that of the other result, so that
    both are the smallest costs of the same kind.
    """
    scales, costs, sigmas = result.noise_scales, [], problem.prior_sigmas.copy()
    sigmas[judged] = 0.0
    for calibration in (problem.calibration, result.calibration):
        start = problem.calibration.copy()
        start[judged] = calibration[judged]
        fixed = dataclasses.replace(problem, calibration=start, prior_sigmas=sigmas)
        costs.append(_costs(fixed, calibrate(fixed, QUICK, scales), scales))
    drop = np.zeros(len(problem.poses_world_camera))
    np.add.at(drop, problem.views.keyframes, costs[0] - costs[1])
    return drop


def _costs(problem: CalibrationProblem, result: CalibrationResult, scales: Array) -> Array:
    """The robust cost (M,) of every view."""
    state = CalibrationState(result.poses_world_camera, result.points_world, result.calibration)
    e2 = squared(residuals_of(problem.views, *state.values), scales)
    cost: Array = (0.5 * CAUCHY**2 * np.log1p(e2 / CAUCHY**2)).sum(axis=1)
    return cost
