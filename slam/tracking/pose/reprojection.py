"""Reprojection errors of one camera's matches, and their normal equations, made for speed.

Tracking evaluates them a dozen times a frame. The formulas are those of `residuals` and `jacobian`
in `tracking.pose.pose_optimisation`, with which the tests compare them. Here points are columns, so
that operations run along contiguous memory; residual and Jacobian share intermediate results.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from bmask_slam.graph.arrays import Array, Mask
from bmask_slam.graph.camera import Camera

MIN_DEPTH_M = 1e-3  # points with smaller z are projected as if at this z


@dataclass(frozen=True, eq=False)
class Reprojection:
    """N matches of landmarks with measurements.

    Attributes:
        points_world: (3, N).
        offset: (3, N) px: what is added to (f x/z, f y/z, bf/z) to give predicted - measured.
        weight: (3, N) inverse variances of u, v, disparity; 0 where there is none.
        focal: (3, 1) fx, fy, bf in px, px, px m.
    """

    points_world: Array
    offset: Array
    weight: Array
    focal: Array

    @classmethod
    def of(
        cls, points_world: Array, measurements: Array, weight: Array, camera: Camera
    ) -> Reprojection:
        """From points (N, 3), measurements (N, 3) px without NaN, weights (N, 3)."""
        centre = np.array([[camera.cx], [camera.cy], [0.0]])
        focal = np.array([[camera.fx], [camera.fy], [camera.stereo_bf_px_m]])
        rows = np.ascontiguousarray
        return cls(rows(points_world.T), centre - measurements.T, rows(weight.T), focal)

    def __len__(self) -> int:
        return self.points_world.shape[1]

    def __getitem__(self, keep: Mask) -> Reprojection:
        return Reprojection(
            self.points_world[:, keep], self.offset[:, keep], self.weight[:, keep], self.focal
        )

    def weighted(self, factors: Array) -> Reprojection:
        """A copy with the weights of u, v, disparity multiplied by three factors."""
        weight = self.weight * factors[:, None]
        return Reprojection(self.points_world, self.offset, weight, self.focal)

    def residuals(self, T_world_camera: Array) -> tuple[Array, Array, Array]:
        """Predicted - measured (3, N) px; (x/z, y/z, 1/z) (3, N); z (N,) m."""
        R, t = T_world_camera[:3, :3], T_world_camera[:3, 3:]
        points = R.T @ self.points_world
        points -= R.T @ t
        z = points[2].copy()
        np.divide(1.0, np.maximum(z, MIN_DEPTH_M), out=points[2])
        points[:2] *= points[2]
        return self.focal * points + self.offset, points, z

    def squares(self, T_world_camera: Array) -> tuple[Array, Array]:
        """Squares (3, N) of the residuals in px^2, not weighted, and z (N,) m."""
        r, _, z = self.residuals(T_world_camera)
        return r * r, z

    def normal_equations(
        self, T_world_camera: Array, kernel: Array | None = None
    ) -> tuple[Array, Array]:
        """H (6, 6) and gradient (6,) in the camera's tangent; with a kernel (N,), Cauchy weights.

        With n = (x/z, y/z) and i = 1/z, d(x/z, y/z)/d(xi) is
        [[nx ny, -1 - nx^2, ny, -i, 0, nx i], [1 + ny^2, -nx ny, -nx, 0, -i, ny i]] and
        d(i)/d(xi) = i [ny, -nx, 0, 0, 0, i].
        """
        r, image, _ = self.residuals(T_world_camera)
        (nx, ny, i), weight = image, self.weight
        if kernel is not None:
            chi2 = np.einsum("ij,ij,ij->j", r, r, weight)
            weight = weight * (kernel / (kernel + chi2))
        root = np.sqrt(weight)
        scaled = root * self.focal
        (su, sv, _), scaled_i, (su_nx, sv_ny, sd_i) = scaled, scaled * i, scaled * image
        J, minus_nx = np.zeros((7, 3, len(self))), -nx
        np.multiply(su_nx, ny, out=J[0, 0])
        np.add(sv, sv_ny * ny, out=J[0, 1])
        np.multiply(sd_i, ny, out=J[0, 2])
        np.subtract(-su, su_nx * nx, out=J[1, 0])
        np.multiply(sv_ny, minus_nx, out=J[1, 1])
        np.multiply(sd_i, minus_nx, out=J[1, 2])
        np.multiply(su, ny, out=J[2, 0])
        np.multiply(sv, minus_nx, out=J[2, 1])
        np.negative(scaled_i[0], out=J[3, 0])
        np.negative(scaled_i[1], out=J[4, 1])
        np.multiply(scaled_i, image, out=J[5])
        np.multiply(root, r, out=J[6])
        rows = J.reshape(7, -1)
        products = rows @ rows.T
        return products[:6, :6], products[:6, 6]


def moved(T_world_camera: Array, step: Array) -> Array:
    """The pose after a step (6,) ``[rotation rad, translation m]`` in the camera's frame.

    A cheaper first-order approximation of ``T_world_camera @ se3_exp(step)``.
    """
    R = T_world_camera[:3, :3]
    T = T_world_camera.copy()
    T[:3, :3] = R @ cv2.Rodrigues(step[:3])[0]
    T[:3, 3] += R @ step[3:]
    return T
