"""The pinhole RGB-D camera and its pseudo-stereo model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array


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
        x, y, z = np.moveaxis(points_camera, -1, 0)
        return np.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], axis=-1)

    def project_stereo(self, points_camera: Array) -> Array:
        """Stereo measurements (..., 3) ``(u_left, v, u_right)`` of camera points (..., 3)."""
        uv = self.project(points_camera)
        u_right = uv[..., 0] - self.stereo_bf_px_m / points_camera[..., 2]
        return np.concatenate([uv, u_right[..., None]], axis=-1)

    def backproject(self, pixels: Array, depth_m: Array) -> Array:
        """Camera-frame points (..., 3) of undistorted pixels (..., 2) at z-depth (...) in m."""
        x = (pixels[..., 0] - self.cx) / self.fx * depth_m
        y = (pixels[..., 1] - self.cy) / self.fy * depth_m
        return np.stack([x, y, np.broadcast_to(depth_m, x.shape)], axis=-1)
