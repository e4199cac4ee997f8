"""Calibration while a camera runs: depth is sampled at each keyframe while its images are at hand.

A finished run reads its depth images again (`calibration.views`). A live one has them only for a
moment, so each keyframe's keypoints are sampled at once, and the images are dropped.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bmask_slam.calibration.views import Depths, inverse_depth_change, measured_at
from bmask_slam.graph.arrays import Array, Floats, Image, Ints
from bmask_slam.graph.camera import Camera


@dataclass(frozen=True, eq=False)
class DepthImage:
    """A depth image (H, W) in metres, NaN where missing, and the stamp that it has."""

    depth_m: Floats
    stamp_s: float


@dataclass(frozen=True, eq=False)
class KeyframeImages:
    """A keyframe's images and keypoints, and the depth images of the frames before and after.

    Attributes:
        id: of the keyframe.
        rgb: (H, W, 3) its colour image; (0, W, 3) where nobody looks at its edges.
        pixels: (N, 2) of its keypoints in the image as exposed.
        depth, before, after: three depth images in a row.
        lag_s: as of ``Frame``.
    """

    id: int
    rgb: Image
    pixels: Array
    depth: DepthImage
    before: DepthImage
    after: DepthImage
    lag_s: float


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
        step_s = images.after.stamp_s - images.before.stamp_s
        rate = inverse_depth_change(first, last, step_s) / step_s
        half = np.float16
        return cls(images.pixels, inverse.astype(half), rate.astype(half), images.lag_s)

    def sample(self, pixels: Array, sigmas: Array) -> Depths:
        """At pixels (m, 2) as exposed, whose inverse depths have these sigmas (m,) in 1/m."""
        images = self.inverse_depth.astype(float), self.rate.astype(float)
        return measured_at(pixels, *images, self.lag_s, sigmas)

    def delay_correction(self, keypoints: Ints, sigmas: Array, offset_s: float) -> Array:
        """What to add to inverse depths (N,) so that they are those at the colour image's time.

        1 / z = 1 / raw - (lag + offset) rate; 0 where the rate is unknown.
        """
        seen = self.sample(self.pixels[keypoints], sigmas)
        return np.nan_to_num(-(seen.lag_s + offset_s) * seen.rate)


class KeptDepths:
    """Depth images of keyframes of a run that goes on, by id; what its camera did is undone."""

    def __init__(self, kept: dict[int, KeyframeDepth], camera: Camera) -> None:
        self._kept, self._camera = kept, camera

    @property
    def keyframe_ids(self) -> Ints:
        """(K,) ascending."""
        return np.array(sorted(self._kept), np.int64)

    def measure(self, keyframe_id: int, pixels: Array, sigmas: Array) -> Depths:
        """As `DepthReader.measure`."""
        seen = self._kept[keyframe_id].sample(pixels, sigmas)
        bent = seen.inverse_depth + self._camera.depth_bend(pixels)
        share = 1 / (1 - self._camera.depth_offset_m * bent)
        return replace(seen, inverse_depth=share * bent, rate=share**2 * seen.rate)
