"""The pinhole RGB-D camera: the pseudo-stereo model, the noise of its depth, its mounting."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Mask
from bmask_slam.graph.errors import MAX_NUMBER, InputError
from bmask_slam.graph.lens import columns, distort_normalised, five_terms, undistort_normalised

NO_DEPTH_DISTORTION = (0.0, 0.0, 0.0, 0.0, 0.0)
MAX_SIDE_PX, MAX_REDUCTION = 65_535, 4
LEAST = 1e-9  # smaller focal lengths, scales and rates overflow where they are divided by
NOISE_DISTANCES_M = np.linspace(0.3, 8.0, 78)
KINECT_DISPARITY_SIGMA_PX, MAX_NOISE_SHARE, MAX_GRAPH_FACTOR = 0.08, 0.2, 10.0
SIDES = ("top", "right", "bottom", "left")
"""Of an image; the number of right angles that it is turned anticlockwise to have that side up."""
_QUARTER = np.array([[0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0, 0, 1, 0], [0, 0, 0, 1]])
_DIRECTIONS = ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0))


@dataclass(frozen=True)
class DepthNoise:
    """The standard deviation a + b z + c z^2 of a depth z in metres: one pixel, a frontal surface.

    Structured light and stereo have a constant error of the disparity, which is c alone (Khoshelham
    and Elberink, Sensors 12, 2012, eq. 7); time of flight has mostly a and b.

    Attributes:
        a_m, b, c_per_m: the coefficients in metres, without unit and in 1/m.
        in_graph: factor of the standard deviation in the graph, whose factors count as independent.
            The errors of a sensor's own calibration are alike in all keyframes that see a point.
    """

    a_m: float = 0.0
    b: float = 0.0
    c_per_m: float = 0.0
    in_graph: float = 1.0

    @classmethod
    def of_disparity(cls, sigma_px: float, bf_px_m: float) -> DepthNoise:
        """That of a disparity bf / z with a constant standard deviation: z^2 / bf sigma."""
        return cls(c_per_m=sigma_px / bf_px_m)

    def times(self, k: float) -> DepthNoise:
        """All standard deviations multiplied by ``k``."""
        return replace(self, a_m=k * self.a_m, b=k * self.b, c_per_m=k * self.c_per_m)

    def fault(self) -> str:
        """What no depth sensor has, in words after the coefficients; "" for a possible noise."""
        sigmas_m = self.depth_sigma_m(NOISE_DISTANCES_M)
        for wrong, said in (
            (sigmas_m <= 0, "it must be positive"),
            (sigmas_m > MAX_NOISE_SHARE * NOISE_DISTANCES_M, "more than a fifth of the depth"),
        ):
            if wrong.any():
                at = int(np.argmax(wrong))
                return f", {sigmas_m[at]:.3g} m at {NOISE_DISTANCES_M[at]:.1f} m; {said}"
        limit, factor = MAX_GRAPH_FACTOR, self.in_graph
        out = f"; its factor in the graph, {factor:g}, must be from 1 to {limit:g}"
        return "" if 1 <= factor <= limit else out

    def depth_sigma_m(self, depth_m: NDArray[Any]) -> NDArray[Any]:
        """Standard deviation in metres of depths (...) in metres."""
        return self.a_m + self.b * depth_m + self.c_per_m * depth_m**2

    def inverse_depth_sigma(self, inverse_depth: Array) -> Array:
        """Standard deviation in 1/m of inverse depths (...) in 1/m, to first order: sigma_z / z^2.

        Times bf it is that of the disparity in pixels.
        """
        return self.c_per_m + self.b * inverse_depth + self.a_m * inverse_depth**2


@dataclass(frozen=True)
class Camera:
    """Intrinsics of the colour camera to which depth is registered.

    Pixels are (column, row) with centres at integers. ``distortion`` is OpenCV's
    (k1, k2, p1, p2, k3). A stored depth value ``d`` means ``d / depth_scale + depth_offset_m``
    metres (paper eq. 9, and an offset), taken at the depth image's stamp plus
    ``depth_time_offset_s``. Images are exposed row by row from the top, the last row
    ``rolling_shutter_s`` after the first, and their stamps are those of the middle row.
    ``stereo_bf_px_m`` is the product of focal length and baseline of the pseudo-stereo pair that
    stands for the depth sensor: u_right = u_left - bf / z (ORB-SLAM2 eq. 1); for a Kinect
    about 40 px m (baseline 7.5 cm), so that one pixel of disparity noise is z^2/bf of depth noise.
    ``depth_noise`` is the depth sensor's; None: not known, see ``noise_of_depth``.
    ``depth_distortion`` is what the sensor adds to the inverse depth, in 1/m: coefficients of
    ``depth_distortion_terms``. Structured light bends its depth images so, by an error of the
    disparity that varies smoothly over the image (Herrera et al., PAMI 34, 2012).
    ``up`` is the side of the image, one of SIDES, that is up in the world; "": not said.
    ``covered`` are parts of the image that do not show the room: the robot itself, an overlay, dirt
    on the lens. Rectangles (left, top, right, bottom) in pixels, the last column and row excluded.
    ``reduced_by``: images are recorded so many times as wide and high; all else is of reduced ones.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    depth_scale: float = 5000.0
    fps: float = 30.0
    stereo_bf_px_m: float = 40.0
    depth_offset_m: float = 0.0
    depth_time_offset_s: float = 0.0
    rolling_shutter_s: float = 0.0
    depth_noise: DepthNoise | None = None
    depth_distortion: tuple[float, float, float, float, float] = NO_DEPTH_DISTORTION
    up: str = ""
    covered: tuple[tuple[int, int, int, int], ...] = ()
    reduced_by: int = 1

    def __post_init__(self) -> None:
        """Raise InputError for what no camera can be; of four terms of distortion k3 is 0."""
        object.__setattr__(self, "distortion", five_terms(self.distortion))
        names = {f.name for f in fields(self)} - {"depth_noise", "up", "covered"}
        flat: Array = np.concatenate([np.ravel(getattr(self, n)) for n in names]).astype(float)
        if not (np.abs(flat) <= MAX_NUMBER).all():
            raise InputError("a camera with a number that is not finite; correct it")
        if not (1 <= self.width <= MAX_SIDE_PX and 1 <= self.height <= MAX_SIDE_PX):
            raise InputError(f"an image of {self.width} x {self.height} pixels; correct its size")
        if (low := min(self.fx, self.fy, self.depth_scale, self.fps, self.stereo_bf_px_m)) < LEAST:
            what = f"a focal length, depth scale, rate or stereo_bf of {low:g}"
            raise InputError(f"{what}, which is not positive, or below {LEAST:g}; correct it")

    def fault(self) -> str:
        """What no camera can be beside its numbers, in words; "" for a possible camera."""
        if not 1 <= self.reduced_by <= MAX_REDUCTION:
            return f"images reduced by {self.reduced_by}"
        if self.up not in ("", *SIDES):
            return f"up {self.up!r}, which is no side of an image"
        bad = self.not_in_image()
        return f"covered {bad}, which is no part of the image" if bad else ""

    def not_in_image(self) -> str:
        """The first part of ``covered`` that is empty or outside the image; "" if there is none."""
        for left, top, right, bottom in self.covered:
            if not (0 <= left < right <= self.width and 0 <= top < bottom <= self.height):
                return str([left, top, right, bottom])
        return ""

    def visible(self, margin_px: int = 0) -> Mask:
        """(H, W) the pixels that are not covered, nor nearer than ``margin_px`` to such."""
        mask = np.ones((self.height, self.width), bool)
        for left, top, right, bottom in self.covered:
            rows = slice(max(top - margin_px, 0), bottom + margin_px)
            mask[rows, max(left - margin_px, 0) : right + margin_px] = False
        return mask

    def noise_of_depth(self, disparity_sigma_px: float | None = None) -> DepthNoise:
        """The noise by a constant error of the disparity, if given; else the sensor's own.

        Where that is not known it is a Kinect's: 0.08 px of disparity at bf = 40 px m.
        """
        if disparity_sigma_px is None and self.depth_noise is not None:
            return self.depth_noise
        sigma_px = KINECT_DISPARITY_SIGMA_PX if disparity_sigma_px is None else disparity_sigma_px
        return DepthNoise.of_disparity(sigma_px, self.stereo_bf_px_m)

    def reduced(self, k: int) -> Camera:
        """The camera of images of a k-th of the width and height, which it must divide."""
        size = self.width // k, self.height // k
        return replace(self.of_size(*size), reduced_by=k * self.reduced_by)

    def recorded(self) -> Camera:
        """The camera of the images as they are recorded."""
        if (k := self.reduced_by) == 1:
            return self
        return replace(self.of_size(k * self.width, k * self.height), reduced_by=1)

    def of_size(self, width: int, height: int) -> Camera:
        """The camera of the same view in another size. The noise of depth in metres stays."""
        x, y = width / self.width, height / self.height
        parts = np.array(self.covered, float).reshape(-1, 4) * [x, y, x, y]
        parts[:, 2:] = np.ceil(parts[:, 2:])  # and the upper left corner is rounded down
        return replace(
            self, width=width, height=height, fx=x * self.fx, fy=y * self.fy,
            cx=(self.cx + 0.5) * x - 0.5, cy=(self.cy + 0.5) * y - 0.5,
            covered=tuple(map(tuple, parts.astype(int).tolist())),
        )  # fmt: skip

    def turned(self, turns: int) -> tuple[Camera, Array]:
        """The camera of images turned anticlockwise by right angles, and T_self_turned (4, 4).

        What goes by rows and columns of the sensor, readout and distortion of depth, it has not.
        """
        camera, T_self_turned = self, np.eye(4)
        for _ in range(turns % len(SIDES)):
            k1, k2, p1, p2, k3 = camera.distortion
            camera = replace(
                camera, width=camera.height, height=camera.width, fx=camera.fy, fy=camera.fx,
                cx=camera.cy, cy=camera.width - 1 - camera.cx, distortion=(k1, k2, -p2, p1, k3),
            )  # fmt: skip
            T_self_turned = T_self_turned @ _QUARTER
        bend = NO_DEPTH_DISTORTION
        plain = replace(camera, rolling_shutter_s=0.0, depth_distortion=bend, up="", covered=())
        return plain, T_self_turned

    @property
    def graph_depth_factor(self) -> float:
        """Factor of the depth's standard deviation in the graph, see ``DepthNoise``."""
        return 1.0 if self.depth_noise is None else self.depth_noise.in_graph

    @property
    def K(self) -> Array:
        """The calibration matrix (3, 3) in pixels."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    @property
    def baseline_m(self) -> float:
        """Baseline of the pseudo-stereo pair in metres."""
        return self.stereo_bf_px_m / self.fx

    def project(self, points_camera: Array) -> Array:
        """Undistorted pixels (..., 2) of camera-frame points (..., 3); z must be positive."""
        z = points_camera[..., 2]
        u = self.fx * points_camera[..., 0] / z + self.cx
        return columns(u, self.fy * points_camera[..., 1] / z + self.cy)

    def project_distorted(self, points_camera: Array) -> Array:
        """Pixels (N, 2) in the image as recorded of camera-frame points (N, 3) with z > 0."""
        if not any(self.distortion):
            return self.project(points_camera)
        normalised = points_camera[:, :2] * (1 / points_camera[:, 2])[:, None]
        return self._focal * distort_normalised(normalised, self.distortion) + self._centre

    def image_places(self, pixels: Array) -> Array:
        """Pixels (..., 2) from the middle of the image, in units of half its width."""
        return (pixels - np.array([self.width - 1, self.height - 1]) / 2) * (2 / self.width)

    def share_of_rows(self, rows: Array) -> Array:
        """Offsets (N,) of rows (N,) below the image's middle, as shares of its height, +-1/2."""
        return (rows + 0.5) / self.height - 0.5

    def exposed_after_s(self, rows: Array) -> Array:
        """Seconds (N,) from the exposure of the image's middle row to that of rows (N,)."""
        return self.rolling_shutter_s * self.share_of_rows(rows)

    def distort(self, pixels: Array) -> Array:
        """Pixels (..., 2) in the image as recorded of undistorted ones."""
        normalised = (pixels - self._centre) / self._focal
        return self._focal * distort_normalised(normalised, self.distortion) + self._centre

    def undistort(self, pixels: Array) -> Array:
        """Undistorted pixels (..., 2), of the same type, of pixels in the image as recorded."""
        if not any(self.distortion):
            return pixels.copy()
        normalised = (pixels.astype(float) - self._centre) * (1 / self._focal)
        straight = undistort_normalised(normalised, self.distortion)
        return (self._focal * straight + self._centre).astype(pixels.dtype)

    @property
    def _focal(self) -> Array:
        return np.array([self.fx, self.fy])

    @property
    def _centre(self) -> Array:
        return np.array([self.cx, self.cy])

    def depth_bend(self, pixels: Array) -> Array:
        """What the sensor adds to the inverse depth (...) at raw pixels (..., 2), in 1/m."""
        return np.asarray(depth_distortion_terms(self.image_places(pixels)) @ self.depth_distortion)

    def project_stereo(self, points_camera: Array) -> Array:
        """Stereo measurements (..., 3) ``(u_left, v, u_right)`` of camera points (..., 3)."""
        uv = self.project(points_camera)
        u_right = uv[..., 0] - self.stereo_bf_px_m / points_camera[..., 2]
        return np.concatenate([uv, u_right[..., None]], axis=-1)

    def backproject(self, pixels: Array, depth_m: Array) -> Array:
        """Camera-frame points (..., 3) of undistorted pixels (..., 2) at z-depth (...) in m."""
        x = (pixels[..., 0] - self.cx) / self.fx * depth_m
        return columns(x, (pixels[..., 1] - self.cy) / self.fy * depth_m, depth_m)


def depth_distortion_terms(places: Array) -> Array:
    """The terms (..., 5) x, y, x^2, xy, y^2 of ``Camera.depth_distortion``.

    ``places`` (..., 2) are those of ``Camera.image_places``. A constant is missing: it is hardly
    told from the depth's scale and offset.
    """
    x, y = np.moveaxis(places, -1, 0)
    return np.stack([x, y, x * x, x * y, y * y], axis=-1)


def side_towards(direction_camera: Array) -> str:
    """The side of the image that a direction (3,) in the camera's frame points to most."""
    return SIDES[int(np.argmax(np.array(_DIRECTIONS) @ direction_camera))]


def direction_of(side: str) -> Array:
    """The direction (3,) of a side in the camera's frame; of the top for "". Raises ValueError."""
    return np.array(_DIRECTIONS[SIDES.index(side or SIDES[0])])
