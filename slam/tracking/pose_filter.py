"""The camera's present pose and velocity, filtered by its inertia.

Each frame is measured against the map by itself, so that tracked poses jitter by millimetres. What
is known of a moving camera at its present frame is found from the frames before it by an extended
Kalman filter, with the model of `graph.trajectory_smoothing`: the acceleration is white noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import carried_along, make_pose, so3_exp, so3_log
from bmask_slam.graph.trajectory_smoothing import MotionNoise, are_known
from bmask_slam.tracking.results import FrameResult, Velocity

NOISE = MotionNoise(turn=4.0, shift=0.2)
"""So much acceleration that a camera that is swung to and fro by 3 m/s^2 is not late by more than
the filter gains. Less of it would be smoother for one that is carried."""
SURPRISE = 22.5
"""Chi-squared with six degrees of freedom that chance exceeds once in a thousand frames."""
LONGEST_STEP_S = 0.5
"""After a longer time without a pose nothing is known of the velocity."""
FIRST_RATES = np.repeat([2.0, 1.0], 3)
"""Standard deviations of a velocity of which nothing is known, rad/s and m/s."""


class PoseFilter:
    """Takes the results of frames in turn, and replaces their poses by the most probable ones.

    It begins anew with a new segment, after a loss and where a pose's accuracy is not known. A pose
    that is far from what was expected is followed (Zhou and Frank's strong tracking, 1996): it may
    be the camera that was bumped as well as an error, which jumps as it would without the filter.
    """

    def __init__(self, noise: MotionNoise = NOISE) -> None:
        self._noise = noise
        self._segment, self._stamp_s = -1, np.nan
        self._T = np.eye(4)
        self._rates = np.zeros(6)  # turn in the camera's frame, shift in the world
        self._P = np.zeros((12, 12))  # of turn in the camera's frame, place in the world, rates

    def filtered(self, result: FrameResult) -> FrameResult:
        """A frame's result with its filtered pose and velocity, where that is known."""
        T, known = result.T_world_camera, result.information
        by_image = result.status.by_image
        if T is None or known is None or not by_image or not are_known(known[None])[0]:
            self._stamp_s = np.nan
            return result
        measured = self._noise.covariances(np.asarray(np.linalg.inv(known), float))
        step_s = result.timestamp_s - self._stamp_s
        goes_on = result.segment == self._segment and 0 < step_s < LONGEST_STEP_S  # False for NaN
        self._segment, self._stamp_s = result.segment, result.timestamp_s
        if not goes_on:
            self._begin(T, measured)
            return result
        self._predict(step_s)
        self._update(T, measured)
        return replace(result, T_world_camera=self._T.copy(), velocity=self._velocity())

    def follow_map(self, T_old: Array, T_new: Array) -> None:
        """The map was moved, as a keyframe from T_old to T_new (4, 4)."""
        self._T = carried_along(self._T, T_old, T_new)
        R = T_new[:3, :3] @ T_old[:3, :3].T
        G = _blocks(R)
        self._rates, self._P = G[6:, 6:] @ self._rates, G @ self._P @ G.T

    def _begin(self, T: Array, measured: Array) -> None:
        G = _blocks(T[:3, :3])
        self._T, self._rates = T, np.zeros(6)
        self._P = np.diag(np.r_[np.zeros(6), FIRST_RATES**2])
        self._P[:6, :6] = G[:6, :6] @ measured @ G[:6, :6].T

    def _predict(self, t: float) -> None:
        """The state t seconds later."""
        turned = so3_exp(t * self._rates[:3])
        R, p = self._T[:3, :3] @ turned, self._T[:3, 3] + t * self._rates[3:]
        self._T = make_pose(R, p)
        F, q = np.eye(12), np.repeat([self._noise.turn, self._noise.shift], 3)
        F[:3, :3], F[:6, 6:] = turned.T, t * np.eye(6)
        Q = np.block([[np.diag(t**3 / 3 * q), np.diag(t**2 / 2 * q)],
                      [np.diag(t**2 / 2 * q), np.diag(t * q)]])  # fmt: skip
        self._P = F @ self._P @ F.T + Q

    def _update(self, T: Array, measured: Array) -> None:
        """The state after a measured pose (4, 4), whose covariance is (6, 6) on the right side."""
        R = self._T[:3, :3]
        H = np.zeros((6, 12))
        H[:3, :3], H[3:, 3:6] = np.eye(3), R.T
        apart = np.r_[so3_log(R.T @ T[:3, :3]), R.T @ (T[:3, 3] - self._T[:3, 3])]
        chi2 = apart @ np.linalg.solve(H @ self._P @ H.T + measured, apart)
        if chi2 > SURPRISE:  # bumped: less is known of it than the model says
            self._P *= chi2 / SURPRISE
        K = np.linalg.solve(H @ self._P @ H.T + measured, H @ self._P).T
        step, left = K @ apart, np.eye(12) - K @ H
        self._P = left @ self._P @ left.T + K @ measured @ K.T
        self._T = make_pose(R @ so3_exp(step[:3]), self._T[:3, 3] + step[3:6])
        self._rates = self._rates + step[6:]

    def _velocity(self) -> Velocity:
        """In the camera's frame."""
        G = _blocks(self._T[:3, :3].T)[6:, 6:]
        return Velocity(G @ self._rates, G @ self._P[6:, 6:] @ G.T)


def _blocks(R: Array) -> Array:
    """The change (12, 12) of the state where the world is turned by R; turns stay as they are."""
    G = np.eye(12)
    G[3:6, 3:6] = G[9:, 9:] = R
    return G
