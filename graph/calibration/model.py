"""What an RGB-D camera measures of a point, as a function of its calibration, with derivatives.

The measurements of a landmark are its raw (distorted) pixel in the colour image, and the inverse of
the raw depth at that pixel of the depth image:

    pixel          (u, v) = (fx, fy) * distort_normalised(x / z, y / z) + (cx, cy)
    metric depth   z_sensor = factor * raw + offset,   1 / z_sensor = 1 / z + distortion(u, v)

The depth image may have been taken tau = lag + time_offset later than the colour image, when
another point of the surface is at the pixel. To first order

    1 / raw = factor / (z_sensor - offset) + tau * rate

with the rate of change of 1 / raw at the fixed pixel, which is measured from the depth images
before and after. (The alternative, rate = -(z' + slope . flow) / z^2 from the camera's velocity and
the surface's slope, needs the slope from one noisy image, whose error biases tau toward zero.)

The rows of a rolling shutter are exposed one after the other: a point with the velocity p' in the
camera's frame is observed at p + (row / rows - 1/2) rolling_shutter p'. The depth image is assumed
to have the same rolling shutter.

The distortion of depth is a quadratic of the pixel's place in the image. Where it is not estimated
it passes for wrong focal lengths: turned by an angle a, a camera shows a shift fx a of the pixels
and a change u a / fx of 1 / z relative to it, whose product tells fx.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array, Ints, Mask
from bmask_slam.graph.camera import Camera, depth_distortion_terms
from bmask_slam.graph.geometry import inverse, skew
from bmask_slam.graph.lens import distort_normalised, distortion_terms

PARAMETERS = (
    *("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"),
    *("depth_factor", "depth_offset_m", "time_offset_s", "rolling_shutter_s"),
    *("depth_u", "depth_v", "depth_uu", "depth_uv", "depth_vv"),
)
"""The calibration as a vector (18,): pixels, OpenCV's distortion, metres a raw depth unit,
metres, seconds, seconds, and the distortion of depth in 1/m."""
F, C, LENS = slice(0, 2), slice(2, 4), slice(4, 9)
FACTOR, OFFSET, TIME, SHUTTER = 9, 10, 11, 12
BEND = slice(13, 18)
NORMAL_95 = 1.96
"""Standard deviations of a 95 % bound."""
MIN_DEPTH_M = 0.05
MIN_INVERSE_DEPTH = 0.01


@dataclass(frozen=True)
class CalibrationViews:
    """M views of L landmarks in K keyframes, as columns.

    Attributes:
        keyframes, landmarks: (M,) rows in the tables of poses and points, from 0.
        pixels: (M, 2) raw pixels, distorted as the image is.
        places: (M, 2) the same as ``Camera.image_places``.
        inverse_depth: (M,) of the raw depth, NaN without one.
        inverse_depth_rate: (M,) its rate of change at that pixel, in 1/s; NaN where unknown.
        lag_s: (M,) stamp of the depth image less that of the colour image.
        sigma_px: (M,) standard deviation of u and of v.
        sigma_inverse: (M,) standard deviation of ``inverse_depth``.
        shutter_velocity: (M, 3) the point's velocity in the camera's frame in m/s, times the share
            of the image, from -1/2 to 1/2, by which its row lies below the middle.
    """

    keyframes: Ints
    landmarks: Ints
    pixels: Array
    places: Array
    inverse_depth: Array
    inverse_depth_rate: Array
    lag_s: Array
    sigma_px: Array
    sigma_inverse: Array
    shutter_velocity: Array


@dataclass(frozen=True)
class Linearised:
    """Residuals (M, 3), predicted - measured over sigma, and their derivatives.

    ``pose`` (M, 3, 6) is by the tangent of T_world_camera, ``point`` (M, 3, 3) by the point in
    the world, ``calibration`` (M, 3, 18) by the vector of PARAMETERS. Rows are u, v and inverse
    depth; ``valid`` (M, 3) is False, and the row zero, for a missing depth or one whose rate is not
    known, and for a point behind the camera.
    """

    residuals: Array
    pose: Array
    point: Array
    calibration: Array
    valid: Mask


def parameters_of(camera: Camera, raw_scale: float) -> Array:
    """The vector (18,) of a camera whose raw depth is stored values over ``raw_scale``."""
    k1, k2, p1, p2, k3 = camera.distortion
    return np.array(
        [
            *(camera.fx, camera.fy, camera.cx, camera.cy, k1, k2, p1, p2, k3),
            *(raw_scale / camera.depth_scale, camera.depth_offset_m),
            *(camera.depth_time_offset_s, camera.rolling_shutter_s),
            *camera.depth_distortion,
        ]
    )


@dataclass(frozen=True)
class _Compared:
    """Predictions beside measurements: points (M, 3) in the camera when the frame and when their
    row was taken, R_camera_world (M, 3, 3), weighted residuals (M, 3), weights, and which count.
    """

    p: Array
    p_row: Array
    R: Array
    residuals: Array
    weight: Array
    valid: Mask


def residuals_of(
    views: CalibrationViews, poses: Array, points_world: Array, calibration: Array
) -> Array:
    """Residuals (M, 3) as those of ``linearise``, without derivatives: a tenth of its time."""
    return _compared(views, poses, points_world, calibration).residuals


def linearise(
    views: CalibrationViews, poses: Array, points_world: Array, calibration: Array
) -> Linearised:
    """Residuals and derivatives at poses (K, 4, 4), points (L, 3) and a calibration (18,)."""
    at = _compared(views, poses, points_world, calibration)
    by_point, by_calibration = _pixel_derivatives(at.p_row, calibration)
    depth_by_point, depth_by_calibration = _depth_derivatives(views, at.p_row, calibration)
    by_point = np.concatenate([by_point, depth_by_point[:, None]], axis=1)
    by_calibration = np.concatenate([by_calibration, depth_by_calibration[:, None]], axis=1)
    by_calibration[..., SHUTTER] = (by_point @ views.shutter_velocity[..., None])[..., 0]
    by_point *= at.weight[..., None]
    count = len(at.p)
    p_by_tangent = np.concatenate([skew(at.p), np.broadcast_to(-np.eye(3), (count, 3, 3))], axis=2)
    return Linearised(
        at.residuals,
        by_point @ p_by_tangent,
        by_point @ at.R,
        by_calibration * at.weight[..., None],
        at.valid,
    )


def _compared(
    views: CalibrationViews, poses: Array, points_world: Array, calibration: Array
) -> _Compared:
    T_camera_world = inverse(poses)[views.keyframes]
    R = T_camera_world[:, :3, :3]
    p = np.einsum("mij,mj->mi", R, points_world[views.landmarks]) + T_camera_world[:, :3, 3]
    in_front = p[:, 2] > MIN_DEPTH_M
    p = np.where(in_front[:, None], p, [0.0, 0.0, 1.0])
    p_row = p + calibration[SHUTTER] * views.shutter_velocity
    predicted = np.column_stack(
        [_pixel(p_row, calibration), _inverse_depth(views, p_row, calibration)]
    )
    measured = np.column_stack([views.pixels, views.inverse_depth])
    weight = 1 / np.column_stack([views.sigma_px, views.sigma_px, views.sigma_inverse])
    valid = np.isfinite((predicted - measured) * weight) & in_front[:, None]
    weight = np.where(valid, weight, 0.0)
    residuals = np.where(valid, predicted - measured, 0.0) * weight
    return _Compared(p, p_row, R, residuals, weight, valid)


def _pixel(p: Array, calibration: Array) -> Array:
    """Pixels (M, 2) of points p (M, 3)."""
    normalised = p[:, :2] * (1 / p[:, 2])[:, None]
    distorted = distort_normalised(normalised, calibration[LENS])
    pixels: Array = calibration[F] * distorted + calibration[C]
    return pixels


def _pixel_derivatives(p: Array, calibration: Array) -> tuple[Array, Array]:
    """Derivatives of ``_pixel``, (M, 2, 3) by p and (M, 2, 18)."""
    inv_z = 1 / p[:, 2]
    normalised = p[:, :2] * inv_z[:, None]
    x, y = normalised.T
    focal, (k1, k2, p1, p2, k3) = calibration[F], calibration[LENS]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))  # d(radial)/d(r2), twice
    cross = x * y * slope + 2 * (p1 * x + p2 * y)
    by_normalised = np.empty((len(p), 2, 2))
    by_normalised[:, 0, 0] = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    by_normalised[:, 0, 1] = by_normalised[:, 1, 0] = cross
    by_normalised[:, 1, 1] = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    normalised_by_p = np.zeros((len(p), 2, 3))
    normalised_by_p[:, 0, 0] = normalised_by_p[:, 1, 1] = inv_z
    normalised_by_p[:, :, 2] = -normalised * inv_z[:, None]
    by_calibration = np.zeros((len(p), 2, len(PARAMETERS)))
    by_calibration[:, [0, 1], [0, 1]] = distort_normalised(normalised, calibration[LENS])
    by_calibration[:, [0, 1], [2, 3]] = 1.0
    by_calibration[:, :, LENS] = focal[:, None] * distortion_terms(normalised)
    return focal[:, None] * (by_normalised @ normalised_by_p), by_calibration


def _sensor_depth(views: CalibrationViews, p: Array, calibration: Array) -> tuple[Array, Array]:
    """Depth (M,) in m as the sensor sees it, and the same without the offset."""
    terms = depth_distortion_terms(views.places)
    z_sensor = 1 / np.maximum(1 / p[:, 2] + terms @ calibration[BEND], MIN_INVERSE_DEPTH)
    return z_sensor, np.maximum(z_sensor - calibration[OFFSET], MIN_DEPTH_M)


def _inverse_depth(views: CalibrationViews, p: Array, calibration: Array) -> Array:
    """Raw inverse depth (M,) in the depth image."""
    tau_s = views.lag_s + calibration[TIME]
    _, z = _sensor_depth(views, p, calibration)
    raw: Array = calibration[FACTOR] / z + tau_s * views.inverse_depth_rate
    return raw


def _depth_derivatives(
    views: CalibrationViews, p: Array, calibration: Array
) -> tuple[Array, Array]:
    """Derivatives of ``_inverse_depth``, (M, 3) by p and (M, 18)."""
    factor, (z_sensor, z) = calibration[FACTOR], _sensor_depth(views, p, calibration)
    by_p = np.zeros_like(p)
    by_p[:, 2] = -factor / z**2 * (z_sensor / p[:, 2]) ** 2
    by_calibration = np.zeros((len(p), len(PARAMETERS)))
    by_calibration[:, FACTOR] = 1 / z
    by_calibration[:, OFFSET] = factor / z**2
    terms = depth_distortion_terms(views.places)
    by_calibration[:, BEND] = (factor / z**2 * z_sensor**2)[:, None] * terms
    by_calibration[:, TIME] = np.nan_to_num(views.inverse_depth_rate)
    return by_p, by_calibration
