"""Hand-eye calibration: the pose, in the camera's frame, of the body that a reference follows.

Motion capture measures markers, EuRoC's reference an IMU: a body that is fixed to the camera, with
an offset, so that rotations of the camera move it differently.
"""

from __future__ import annotations

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse, make_pose, se3_exp, so3_log
from bmask_slam.graph.metrics import time_pairs
from bmask_slam.graph.trajectory import Trajectory

MIN_TURN_RAD = 0.05
ARM_M = 1.0
"""An error of 1 rad has the weight of an error of so many metres."""
REGULARISATION = 1e-3
"""Weight that keeps unobservable translation at zero."""


def hand_eye(estimate: Trajectory, reference: Trajectory) -> Array:
    """T_camera_body (4, 4) that fits the motions of camera and body best.

    Poses of the same index belong together. Over all pairs a second apart, with the motions A of
    the camera and B of the body, ``A X = X B`` (Tsai and Lenz, T-RA 1989) is solved for X: the
    rotation first, from the rotation vectors, which X rotates (Park and Martin, T-RA 1994), then X
    by least squares over ``B^-1 X^-1 A X``, the relative pose error. If all rotations are about one
    axis, the translation along it is unobservable and stays zero.

    Raises:
        InputError: the camera hardly turns in any second.
    """
    i, j = time_pairs(estimate.timestamps_s)
    P, Q = estimate.poses_world_camera, reference.poses_world_camera
    A, B = inverse(P[i]) @ P[j], inverse(Q[i]) @ Q[j]
    turns_a, turns_b = so3_log(A[:, :3, :3]), so3_log(B[:, :3, :3])
    most_rad = np.linalg.norm(turns_a, axis=1).max(initial=0.0)
    if most_rad < MIN_TURN_RAD:
        raise InputError(
            f"in {len(i)} pairs of poses a second apart the camera turns by at most "
            f"{np.rad2deg(most_rad):.2f} degrees: where the reference's body sits cannot be seen; "
            "evaluate without --hand-eye"
        )
    from scipy.optimize import least_squares  # noqa: PLC0415 - 15 MB that a run does not need

    U, _, Vt = np.linalg.svd(turns_a.T @ turns_b)
    no_reflection = np.array([1.0, 1.0, np.linalg.det(U @ Vt)])
    start = make_pose((U * no_reflection) @ Vt, np.zeros(3))

    def residuals(xi: Array) -> Array:
        X = start @ se3_exp(xi)
        E = inverse(B) @ inverse(X) @ A @ X
        e = np.concatenate([E[:, :3, 3], ARM_M * so3_log(E[:, :3, :3])])
        return np.concatenate([e.ravel(), REGULARISATION * xi[3:]])

    return start @ se3_exp(least_squares(residuals, np.zeros(6)).x)


def body_trajectory(camera: Trajectory, T_camera_body: Array) -> Trajectory:
    """The trajectory of a body that is fixed to the camera, in the same world frame."""
    return Trajectory(camera.timestamps_s, camera.poses_world_camera @ T_camera_body)
