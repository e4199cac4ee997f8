"""A calibration as text: values, 95 % bounds, and which parameters were observable."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.calibration.calibration import CalibrationResult
from bmask_slam.graph.calibration.model import BEND, FACTOR, NORMAL_95, OFFSET, PARAMETERS
from bmask_slam.graph.camera import Camera

UNOBSERVED, WEAK = 0.8, 0.4
"""Ratios of posterior and prior sigma above which a parameter is not, or weakly, observable."""
UNITS = {
    "depth_offset_m": ("depth offset", "mm", 1e3),
    "time_offset_s": ("time offset", "ms", 1e3),
    "rolling_shutter_s": ("rolling shutter", "ms", 1e3),
    **{name: (f"depth bend {name[6:]}", "mm at 1 m", 1e3) for name in PARAMETERS[BEND]},
}
CURES = {
    **dict.fromkeys(("fx", "fy"), "turn the camera, over things near and far"),
    **dict.fromkeys(
        ("cx", "cy", "p1", "p2"), "roll the camera about its optical axis, and tilt it"
    ),
    **dict.fromkeys(("k1", "k2", "k3"), "let things pass from the image's middle to its corners"),
    "depth_factor": "move farther, so that the reference or the distance tells more",
    "depth_offset_m": "look at the same things from near and far",
    "time_offset_s": "move faster, and toward and away from things",
    "rolling_shutter_s": "turn the camera faster",
    **dict.fromkeys(PARAMETERS[BEND], "let flat things fill the image, and turn the camera"),
}


ALSO = {
    "depth_factor": ("depth scale",),
    "time_offset_s": ("depth time offset", "colour-depth delay"),
    **dict.fromkeys(PARAMETERS[BEND], ("depth distortion",)),
}
"""Further names, of the table and of camera.yaml."""


def parameters_named(name: str) -> list[str]:
    """Those of PARAMETERS that a name of the table or of camera.yaml stands for, [] if none.

    Units, and whether words are joined by spaces, hyphens or underscores, do not matter.
    """
    return [parameter for parameter in PARAMETERS if _plain(name) in _names_of(parameter)]


def _names_of(parameter: str) -> set[str]:
    label, unit, _ = UNITS.get(parameter, (parameter, "", 1.0))
    names = parameter, label, f"{label} {unit}", *ALSO.get(parameter, ())
    return {_plain(name) for name in names}


def _plain(name: str) -> str:
    return " ".join(name.lower().replace("-", " ").replace("_", " ").split())


@dataclass(frozen=True)
class Calibrated:
    """A calibration and its circumstances.

    Attributes:
        path: the camera.yaml; camera: the camera in it; before: the run's camera.
        result: of the solver; prior_sigmas: (18,), 0 for a fixed parameter.
        has_anchor: whether a reference or a distance was given.
        keyframes, landmarks, observations: numbers of those used.
        noise_before: (2,) ratio of residuals to nominal sigmas, of pixels and of depths, when poses
            and points are fitted with the run's camera.
        sigma_px: the nominal sigma of a pixel, the median of those used.
    """

    path: Path
    camera: Camera
    before: Camera
    result: CalibrationResult
    prior_sigmas: Array
    has_anchor: bool
    keyframes: int
    landmarks: int
    observations: int
    noise_before: Array
    sigma_px: float

    def agrees_with(self, earlier: Calibrated) -> bool:
        """Whether no parameter differs from an earlier calibration by more than 95 % bounds.

        Both are of the same frames, in runs with different cameras.
        """
        start = self.before.depth_scale / earlier.before.depth_scale
        found = earlier.result.calibration * np.where(
            np.arange(len(PARAMETERS)) == FACTOR, start, 1
        )
        bounds = NORMAL_95 * np.hypot(self.sigmas, earlier.sigmas)
        return bool((np.abs(self.result.calibration - found) <= bounds).all())

    @property
    def sigmas(self) -> Array:
        """Standard deviations (18,) of PARAMETERS."""
        return np.sqrt(np.diag(self.result.covariance))


def format_calibration(done: Calibrated) -> str:
    """A table of values before and after with 95 % bounds, and remarks on what was observable."""
    result = done.result
    rows: list[tuple[str, ...]] = [("", "before", "after", "95 %", "prior 95 %", "")]
    rows += [_row(done, i) for i in range(len(PARAMETERS))]
    widths = [max(len(row[c]) for row in rows) for c in range(5)]
    table = ["  ".join(_pad(row, widths)).rstrip() for row in rows]
    noise_px, noise_depth = result.noise_scales
    lines = [
        f"{done.keyframes} keyframes, {done.landmarks} landmarks, {done.observations} observations",
        _residual(done),
        f"noise: pixels {noise_px:.2f} and depths {noise_depth:.2f} times their nominal sigmas; "
        f"{100 * result.inlier_share:.1f} % within 3 sigma",
        *_of_reduced(done.camera),
        "",
        *table,
        "",
        *_statements(done),
    ]
    return "\n".join(lines)


def _of_reduced(camera: Camera) -> list[str]:
    """What the table is of, where the file is not of the same images."""
    if camera.reduced_by == 1:
        return []
    used, own = (f"{c.width}x{c.height}" for c in (camera, camera.recorded()))
    return [f"the table is of images reduced to {used}, the file of the recorded ones, {own}"]


def plain_calibration(done: Calibrated) -> dict[str, Any]:
    """Values before and after by parameter, with one sigma, as plain values; SI units and pixels.

    The depth scale stands in place of its factor, as in the table.
    """
    before, after, sigmas = _of(done.before), _of(done.camera), done.sigmas.copy()
    sigmas[FACTOR] *= after[FACTOR]
    parameters = {
        "depth_scale" if i == FACTOR else name: {
            "before": before[i],
            "after": after[i],
            "sigma": sigmas[i] if done.prior_sigmas[i] else None,
            "verdict": _verdict(done, i),
        }
        for i, name in enumerate(PARAMETERS)
    }
    names = ("keyframes", "landmarks", "observations")
    counts = {name: getattr(done, name) for name in names}
    return {"camera": done.path, "parameters": parameters, **counts}


def _residual(done: Calibrated) -> str:
    """What the new camera does to the residuals, poses and points being fitted with each."""
    (before, depth_before), (after, depth_after) = done.noise_before, done.result.noise_scales
    change = 100 * (depth_after / depth_before - 1)
    return (
        f"reprojection error: {done.sigma_px * before:.3f} px with the camera before, "
        f"{done.sigma_px * after:.3f} px with this one; depth residuals {change:+.0f} %"
    )


def _pad(row: tuple[str, ...], widths: list[int]) -> list[str]:
    return [row[0].ljust(widths[0]), *(row[c].rjust(widths[c]) for c in range(1, 5)), row[5]]


def _row(done: Calibrated, i: int) -> tuple[str, ...]:
    """Name, before, after, bounds, prior bounds and verdict of one parameter."""
    name = PARAMETERS[i]
    label, unit, factor = UNITS.get(name, (name, "", 1.0))
    shown = np.array([_of(done.before)[i], _of(done.camera)[i]]) * factor
    sigma, prior = done.sigmas[i] * factor, done.prior_sigmas[i] * factor
    if i == FACTOR:  # shown as the depth scale, which has the same relative error
        label, sigma, prior = "depth scale", sigma * shown[1], prior * shown[1]
    digits = 1 if i == FACTOR else 5 if name[0] in "kp" else 2
    texts = [f"{x:.{digits}f}" for x in shown]
    bounds = [f"+-{NORMAL_95 * x:.{digits}f}" if prior else "" for x in (sigma, prior)]
    return f"{label} {unit}".strip(), *texts, *bounds, _verdict(done, i)


def _of(camera: Camera) -> Array:
    """The vector (18,) of PARAMETERS as shown: the depth scale in place of the factor."""
    return np.array(
        [
            *(camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion),
            *(camera.depth_scale, camera.depth_offset_m),
            *(camera.depth_time_offset_s, camera.rolling_shutter_s),
            *camera.depth_distortion,
        ]
    )


def posterior_share(result: CalibrationResult, prior_sigmas: Array, i: int) -> float:
    """The posterior's sigma of a parameter over the prior's; 0 for a fixed one."""
    prior = prior_sigmas[i]
    return float(np.sqrt(result.covariance[i, i]) / prior) if prior else 0.0


def _share(done: Calibrated, i: int) -> float:
    return posterior_share(done.result, done.prior_sigmas, i)


def _verdict(done: Calibrated, i: int) -> str:
    if not done.prior_sigmas[i]:
        return "held fixed"
    share = _share(done, i)
    return "not observable" if share > UNOBSERVED else "weakly observable" if share > WEAK else ""


def _statements(done: Calibrated) -> list[str]:
    """One line for everything that a user must know before using the numbers."""
    lines = []
    if not done.has_anchor:
        lines.append(
            "The depth scale is not observable: images and depths fit a world of any size equally "
            "well. It and the depth offset keep their values; with --reference or --known-distance "
            "they are estimated."
        )
    elif _share(done, FACTOR) > WEAK and not done.prior_sigmas[OFFSET]:
        lines.append(
            "The depth offset keeps its value: it and a depth scale that is not well known take "
            "each other's part."
        )
    if done.result.body_arm_m.any():
        x, y, z = 1e3 * done.result.body_arm_m
        lines.append(
            f"The reference is of a point ({x:.0f}, {y:.0f}, {z:.0f}) mm in the camera's frame."
        )
    for i, name in enumerate(PARAMETERS):
        share = _share(done, i)
        if share <= WEAK or (i == FACTOR and not done.has_anchor):
            continue
        how = "not" if share > UNOBSERVED else "only weakly"
        label = "depth scale" if i == FACTOR else UNITS.get(name, (name,))[0]
        lines.append(
            f"{label}: {how} observable in this run: posterior sigma is {share:.2f} of the "
            f"prior's; to observe it, {CURES[name]}."
        )
    if not done.result.converged:
        lines.append("The solver did not converge: run again with this camera, calibrate again.")
    if not lines:
        lines.append("Everything was observable in this run.")
    return lines
