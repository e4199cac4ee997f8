"""Calibration while a camera runs: depth is sampled at each keyframe while its images are at hand.

A finished run reads its depth images again (`calibration.views`). A live one has them only for a
moment, so each keyframe's keypoints are sampled at once, and the images are dropped.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bmask_slam.calibration.adoption import TIMES
from bmask_slam.calibration.calibrate import (
    GAUGE_SIGMAS,
    MIN_KEYFRAMES,
)
from bmask_slam.calibration.motion import landmark_motion
from bmask_slam.calibration.priors import CalibrationPriors
from bmask_slam.calibration.views import (
    MAX_RATE_STEP_S,
    MAX_STEP_SIGMAS,
    mean_on_plane,
    smooth_value,
)
from bmask_slam.graph.arrays import Array, Floats, Ints
from bmask_slam.graph.calibration.model import (
    BEND,
    OFFSET,
    PARAMETERS,
    CalibrationViews,
    parameters_of,
)
from bmask_slam.graph.calibration.problem import CalibrationProblem
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.graph_update import Observations
from bmask_slam.run_folder.map_file import SavedRun
from bmask_slam.sequences.images import SURFACE_STEP
from bmask_slam.tracking.rolling_shutter import share_of_rows

IS_TIME = np.isin(np.arange(len(PARAMETERS)), TIMES)


@dataclass(frozen=True, eq=False)
class DepthImage:
    """A depth image (H, W) in metres, NaN where missing, and the stamp that it has."""

    depth_m: Floats
    stamp_s: float


@dataclass(frozen=True, eq=False)
class KeyframeImages:
    """A keyframe's keypoints, and the depth images of its frame and of those before and after.

    Attributes:
        id: of the keyframe.
        pixels: (N, 2) of its keypoints in the image as exposed.
        depth, before, after: three depth images in a row.
        lag_s: as of ``Frame``.
    """

    id: int
    pixels: Array
    depth: DepthImage
    before: DepthImage
    after: DepthImage
    lag_s: float


@dataclass(frozen=True, eq=False)
class DepthSamples:
    """Samples of a keyframe's depth images at N of its keypoints.

    Attributes:
        pixels: (N, 2) in the image as exposed.
        inverse_depth: (N,) 1/m, of a plane fitted around the pixel; NaN where there is none.
        rms: (N,) 1/m, distance of the pixels around from the plane.
        rate: (N,) 1/(m s), change of the inverse depth at the pixel; NaN where unknown.
        lag_s: (N,) as of ``Frame``.
        sigmas: (N,) 1/m, the sensor's standard deviation of the inverse depth.
    """

    pixels: Array
    inverse_depth: Array
    rms: Array
    rate: Array
    lag_s: Array
    sigmas: Array

    def delay_correction(self, offset_s: float) -> Array:
        """What to add to inverse depths (N,) so that they are those at the colour image's time.

        1 / z = 1 / raw - (lag + offset) rate; 0 where the rate is unknown.
        """
        return np.nan_to_num(-(self.lag_s + offset_s) * self.rate)


@dataclass(frozen=True, eq=False)
class KeyframeDepth:
    """What is kept of a keyframe's depth images: inverse depth (H, W) and its rate of change.

    Half precision is a tenth of the sensor's noise.
    """

    pixels: Array
    inverse_depth: NDArray[np.float16]
    rate: NDArray[np.float16]
    lag_s: float

    @classmethod
    def of(cls, images: KeyframeImages) -> KeyframeDepth:
        """The rate is NaN where the surface changed, and everywhere if too much time passed."""
        inverse, first, last = (
            1.0 / image.depth_m for image in (images.depth, images.before, images.after)
        )
        change, step_s = last - first, images.after.stamp_s - images.before.stamp_s
        changed = ~(np.abs(change) <= SURFACE_STEP * first)
        known = 0 < step_s < MAX_RATE_STEP_S
        rate = np.where(changed, np.nan, change / step_s) if known else np.full_like(change, np.nan)
        half = np.float16
        return cls(images.pixels, inverse.astype(half), rate.astype(half), images.lag_s)

    def sample(self, keypoints: Ints, sigmas: Array) -> DepthSamples:
        """At keypoints (N,); ``sigmas`` (N,): standard deviations of inverse depths in 1/m."""
        image, pixels = self.inverse_depth.astype(float), self.pixels[keypoints]
        limit = MAX_STEP_SIGMAS * sigmas
        planes, rms = smooth_value(image, pixels, limit)
        rate = mean_on_plane(self.rate.astype(float), image, pixels, planes, limit)
        return DepthSamples(pixels, planes[:, 0], rms, rate, np.full(len(rms), self.lag_s), sigmas)


def keyframe_problem(
    run: SavedRun, observations: Observations, samples: DepthSamples
) -> CalibrationProblem:
    """The problem for the solver, with all parameters but the camera's times held fixed.

    Args:
        observations: M that ``connected_views`` chose, and samples: of the keypoints that made
            them, in keyframes that were tracked with the run's camera.

    Raises:
        InputError: too few keyframes share landmarks.
    """
    keyframe_ids, keyframes = np.unique(observations.keyframe_ids, return_inverse=True)
    landmark_ids, landmarks = np.unique(observations.landmark_ids, return_inverse=True)
    if len(keyframe_ids) < MIN_KEYFRAMES:
        raise InputError(f"{len(keyframe_ids)} keyframes share landmarks, too few to calibrate")
    camera, pixels = run.camera, samples.pixels
    velocities = landmark_motion(observations, run).velocities
    views = CalibrationViews(
        keyframes=keyframes,
        landmarks=landmarks,
        pixels=pixels,
        places=camera.image_places(pixels),
        inverse_depth=samples.inverse_depth,
        inverse_depth_rate=samples.rate,
        lag_s=samples.lag_s,
        sigma_px=observations.sigmas_px[:, 0],
        sigma_inverse=np.hypot(samples.sigmas, samples.rms),
        shutter_velocity=share_of_rows(pixels[:, 1], camera)[:, None] * velocities,
    )
    start = parameters_of(camera, camera.depth_scale)
    start[OFFSET], start[BEND] = 0.0, 0.0  # they are in the depths already
    return CalibrationProblem(
        views,
        run.tables.keyframes.get(keyframe_ids),
        run.tables.landmarks.get(landmark_ids),
        start,
        np.where(IS_TIME, CalibrationPriors().sigmas(camera), 0.0),
        GAUGE_SIGMAS,
    )
