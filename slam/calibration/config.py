"""How far a camera's parameters may be from its values, and when a run uses what it finds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.calibration.model import BEND, LENS, PARAMETERS, SHUTTER, TIME, F
from bmask_slam.graph.camera import Camera

TIMES = (SHUTTER, TIME)
BENDS = tuple(range(len(PARAMETERS))[BEND])
FREE = (*TIMES, *BENDS)  # what is estimated, by places in PARAMETERS
CALIBRATE = ("auto", "report", "off")
"""Whether what is found is used, only told, or not looked for."""
LIMITS_S = {SHUTTER: 0.035, TIME: 0.1}
FOCAL_SHARE = 0.01
"""Standard deviation of the focal lengths, which are estimated along but not adopted: published
ones are up to 2 % from what the motion shows, which would pass for a readout time."""


@dataclass(frozen=True)
class CalibrationPriors:
    """Standard deviations of the parameters around the run's own camera.

    Attributes:
        focal_share: of the focal lengths, as a share of them.
        centre_share: of the principal point, as a share of the image's width.
        k1, k2, p1, p2, k3: of the distortion, a tenth of that where the camera has one, as it was
            calibrated then; 0 fixes a parameter.
        depth_share: of the depth scale, as a share of it.
        depth_offset_m, depth_time_offset_s: of the offsets.
        rolling_shutter_s: of the time from the first to the last row.
        depth_distortion: of each of its coefficients, in 1/m.
    """

    focal_share: float = 0.05
    centre_share: float = 0.016
    k1: float = 0.1
    k2: float = 0.2
    p1: float = 0.002
    p2: float = 0.002
    k3: float = 0.0
    depth_share: float = 0.05
    depth_offset_m: float = 0.02
    depth_time_offset_s: float = 0.02
    rolling_shutter_s: float = 0.02
    depth_distortion: float = 0.02

    def sigmas(self, camera: Camera) -> Array:
        """The vector (18,) of PARAMETERS."""
        known = 0.1 if any(camera.distortion) else 1.0
        lens = (known * sigma for sigma in (self.k1, self.k2, self.p1, self.p2, self.k3))
        return np.array(
            [
                *(self.focal_share * camera.fx, self.focal_share * camera.fy),
                *(self.centre_share * camera.width,) * 2,
                *lens,
                *(self.depth_share, self.depth_offset_m, self.depth_time_offset_s),
                self.rolling_shutter_s,
                *(self.depth_distortion,) * 5,
            ]
        )


def estimated_priors(camera: Camera, free: tuple[int, ...]) -> Array:
    """Standard deviations (18,) of what a run estimates, the parameters ``free`` and others along.

    0 is held.

    A readout time that the camera has is the sensor's, and kept: landmarks matched in a slow
    stretch have shown up to 42 ms of a Kinect's 26 ms. A lens without distortion was not
    calibrated: what it has is estimated along, but not adopted, else depth would seem bent.
    """
    usual, sigmas = CalibrationPriors().sigmas(camera), np.zeros(len(PARAMETERS))
    sigmas[list(free)] = usual[list(free)]
    sigmas[F] = FOCAL_SHARE * np.array([camera.fx, camera.fy])
    if camera.rolling_shutter_s:
        sigmas[SHUTTER] = 0.0
    if not any(camera.distortion):
        sigmas[LENS][:2] = usual[LENS][:2]
    return sigmas


@dataclass(frozen=True)
class SelfCalibrationConfig:
    """How much is tracked, and when something is adopted.

    Attributes:
        frames: after which a run is looked at first; then after twice as many, and again, as long
            as the motion does not show the parameters.
        min_frames: fewer are not looked at, at the end of a sequence.
        stretches: how often it is looked at in vain at most; live how often at all.
        max_sigma_s, max_sigma_share: a time is observable if its standard deviation is below the
            first, or below this share of the time.
        min_change_sigmas, min_change_s: a time is adopted if it differs from the one in use by
            both, in standard deviations and seconds.
        min_gain_sigmas: and if observations kept out of the fit gain by so many standard errors.
        max_readout_s: a readout time surely longer than a frame's interval is an error and refused;
            of one that may be shorter so much is adopted.
        max_delay_s: the same of the delay of depth; drivers may stamp images as they arrive.
        max_bend_sigma, min_bend, max_bend: the same limits of the distortion of depth, in 1/m.
        surer: a new distortion of depth replaces the adopted one if its standard deviation is
            below this share of that one's.
    """

    frames: int = 105
    min_frames: int = 90
    stretches: int = 4
    max_sigma_s: float = 0.004
    max_sigma_share: float = 0.1
    min_change_sigmas: float = 3.0
    min_change_s: float = 0.002
    min_gain_sigmas: float = 2.0
    max_readout_s: float = LIMITS_S[SHUTTER]
    max_delay_s: float = LIMITS_S[TIME]
    max_bend_sigma: float = 0.004
    min_bend: float = 0.003
    max_bend: float = 0.1
    surer: float = 0.75

    def limits(self, i: int) -> tuple[float, float]:
        """Smallest change and largest value of a parameter."""
        if i in BENDS:
            return self.min_bend, self.max_bend
        return self.min_change_s, self.max_readout_s if i == SHUTTER else self.max_delay_s
