"""Poses of ordinary frames smoothed by the inertia of the camera.

A frame is measured against the map by some hundred landmarks, or, where little is seen, by twenty,
and keyframes apart nothing ties one frame to the next. But a camera has inertia: between two frames
its velocity changes little. With white noise on the acceleration, as in Barfoot, State Estimation
for Robotics (2017), chapter 11, poses and velocities of all frames are one linear problem whose
matrix is block tridiagonal. How much the camera accelerates, and by how much the covariances of
tracking are too small, is found from the same frames by maximum likelihood.

Where tracking was nearly lost a frame is off by much more than its covariance says, and a bump
moves a camera by more than it usually moves. So the errors of both are taken to be of Student's t
distribution, by iteratively reweighted least squares: what does not fit counts for less (Lange,
Little and Taylor, Robust statistical modeling using the t distribution, 1989).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded

from bmask_slam.graph.arrays import Array, Mask
from bmask_slam.graph.geometry import make_pose, so3_exp, so3_log
from bmask_slam.graph.trajectory import Trajectory

logger = logging.getLogger(__name__)

STATE = 12
"""Per frame: turn in its own frame [rad], position in the world [m], and the rates of both."""
MIN_FRAMES = 30
LIKELIHOOD_FRAMES = 600
"""Longest stretch, in the middle, from which the noise is found."""
EVALUATIONS = 150
ITERATIONS = 6
DEGREES_OF_FREEDOM = 4
"""Of Student's t distribution; with 8 the poses are the same within 1 %."""
LEAST_KNOWN = 1e-9
"""A frame that says so little of a direction, as a share of what it says of another, is unknown:
rounding makes its covariance indefinite."""
STRETCH, OVERLAP = 3000, 100
"""Frames that are smoothed at once, and further ones on each side, so that memory is bounded."""


@dataclass(frozen=True)
class MotionNoise:
    """What smoothing assumes of a camera and its tracking.

    Attributes:
        share: factor of the measured covariances.
        turn: power spectral density of the angular acceleration, rad^2/s^3.
        shift: of the acceleration, m^2/s^3.
        least_rad, least_m: standard deviations of what all frames are off by, independently.
    """

    share: float = 4.0
    turn: float = 1.0
    shift: float = 0.02
    least_rad: float = 3e-4
    least_m: float = 1e-3

    @classmethod
    def of(cls, logarithms: Array) -> MotionNoise:
        """From the logarithms of the attributes."""
        return cls(*np.exp(logarithms).tolist())

    def logarithms(self) -> Array:
        """The logarithms (5,) of the attributes."""
        return np.log([self.share, self.turn, self.shift, self.least_rad, self.least_m])

    def covariances(self, measured: Array) -> Array:
        """Covariances (N, 6, 6) of measured poses."""
        least = np.repeat([self.least_rad, self.least_m], 3) ** 2
        return self.share * measured + np.diag(least)


def smooth(measured: Trajectory, information: Array) -> Trajectory:
    """The most probable poses of a camera whose acceleration is white noise.

    Args:
        measured: N poses T_world_camera, with increasing stamps.
        information: (N, 6, 6) inverse covariances of these, ``[rad, m]`` on the right side; NaN or
            singular where unknown, which counts as the median of the others.

    Returns:
        As many poses; those of fewer than ``MIN_FRAMES`` frames, or of frames without information,
        are returned unchanged.
    """
    known = np.flatnonzero(are_known(information))
    if len(measured) < MIN_FRAMES or not len(known):
        return measured
    found = np.linalg.inv(information[known])
    covariances = np.tile(np.median(found, axis=0), (len(measured), 1, 1))
    covariances[known] = found
    frames = Frames(measured.timestamps_s, measured.poses_world_camera, covariances)
    try:
        return Trajectory(measured.timestamps_s, _in_stretches(frames))
    except (LinAlgError, ValueError) as error:  # not a reason to lose the poses
        logger.warning("the trajectory is not smoothed: %s", error)
        return measured


def are_known(information: Array) -> Mask:
    """Which (N,) of inverse covariances (N, 6, 6) can be inverted: they are finite and definite."""
    finite = np.isfinite(information).all(axis=(1, 2), keepdims=True)
    sizes = np.linalg.eigvalsh(np.where(finite, information, 0.0))
    return np.asarray(sizes[:, 0] > LEAST_KNOWN * sizes[:, -1])


def _in_stretches(frames: Frames) -> Array:
    """Smoothed poses (N, 4, 4)."""
    count = len(frames.poses)
    noise = frames.part(*_middle(count, LIKELIHOOD_FRAMES)).noise()
    poses = np.empty_like(frames.poses)
    for first in range(0, count, STRETCH):
        begin, end = max(0, first - OVERLAP), min(first + STRETCH + OVERLAP, count)
        found = frames.part(begin, end).smoothed(noise)[first - begin :][:STRETCH]
        poses[first : first + len(found)] = found
    return poses


def _middle(count: int, most: int) -> tuple[int, int]:
    first = max(0, (count - most) // 2)
    return first, min(first + most, count)


@dataclass(frozen=True, eq=False)
class Frames:
    """Measured poses of N frames.

    Attributes:
        stamps_s: (N,) that increase.
        poses: (N, 4, 4) T_world_camera.
        covariances: (N, 6, 6) ``[rad, m]`` on the right side.
    """

    stamps_s: Array
    poses: Array
    covariances: Array

    def part(self, begin: int, end: int) -> Frames:
        """The frames from ``begin`` until before ``end``."""
        rows = slice(begin, end)
        return Frames(self.stamps_s[rows], self.poses[rows], self.covariances[rows])

    def noise(self) -> MotionNoise:
        """The noise under which the measured poses are the most probable."""

        def cost(logarithms: Array) -> float:
            try:
                return self._solve(self.poses[:, :3, :3], MotionNoise.of(logarithms))[1]
            except LinAlgError:
                return float("inf")

        start = MotionNoise().logarithms()
        simplex = np.vstack([start, start + np.eye(len(start)) * np.log(3.0)])
        ends = {"maxfev": EVALUATIONS, "xatol": 0.05, "fatol": 0.5}
        options = {**ends, "initial_simplex": simplex}
        from scipy.optimize import minimize  # noqa: PLC0415 - loads slowly

        found = minimize(cost, start, method="Nelder-Mead", options=options)
        return MotionNoise.of(found.x)

    def smoothed(self, noise: MotionNoise) -> Array:
        """The most probable poses (N, 4, 4)."""
        turns, state = self.poses[:, :3, :3], np.zeros((len(self.poses), STATE))
        L, weights = self._whitening(noise), (np.ones(len(turns)), np.ones(len(turns) - 1))
        for _ in range(ITERATIONS):
            equations = self._equations(turns, noise, L)
            state = equations.weighted(*weights).solve()[0]
            weights = equations.weights(state)
            turns = turns @ so3_exp(state[:, :3])
        return make_pose(turns, state[:, 3:6])

    def _solve(self, turns: Array, noise: MotionNoise) -> tuple[Array, float]:
        """The most probable state (N, 12), relative to turns (N, 3, 3), and -2 log likelihood."""
        L = self._whitening(noise)
        state, cost = self._equations(turns, noise, L).solve()
        spectral = 3 * (np.log(noise.turn) + np.log(noise.shift))
        logs = 2 * np.log(np.diagonal(L, axis1=1, axis2=2)).sum()
        return state, float(cost - logs + 2 * spectral * (len(turns) - 1))

    def _whitening(self, noise: MotionNoise) -> Array:
        """Cholesky factors (N, 6, 6) of the inverse covariances of the measured poses."""
        return np.linalg.cholesky(np.linalg.inv(noise.covariances(self.covariances)))

    def _equations(self, turns: Array, noise: MotionNoise, L: Array) -> Equations:
        """What is measured, and how the camera moves, relative to turns (N, 3, 3)."""
        measured = self._measurements(turns, L.transpose(0, 2, 1))
        return Equations(*measured, *self._motion(turns, noise))

    def _measurements(self, turns: Array, W: Array) -> tuple[Array, Array]:
        """Equations A x = b (N, 6) of the measured poses, multiplied by W (N, 6, 6)."""
        R_camera_world = self.poses[:, :3, :3].transpose(0, 2, 1)
        A = np.zeros((len(turns), 6, STATE))
        A[:, :3, :3] = np.eye(3)
        A[:, 3:, 3:6] = R_camera_world
        place = (R_camera_world @ self.poses[:, :3, 3:])[..., 0]
        b = np.hstack([-so3_log(R_camera_world @ turns), place])
        return W @ A, (W @ b[..., None])[..., 0]

    def _motion(self, turns: Array, noise: MotionNoise) -> tuple[Array, Array, Array]:
        """Whitened equations B x_k + C x_k+1 = d (N - 1, 12) of constant velocity."""
        step = np.diff(self.stamps_s)
        E = turns[:-1].transpose(0, 2, 1) @ turns[1:]
        B, C = np.zeros((2, len(step), STATE, STATE))
        d = np.zeros((len(step), STATE))
        B[:, :3, :3] = -E.transpose(0, 2, 1)
        B[:, 3:6, 3:6] = -np.eye(3)
        B[:, :6, 6:] = -step[:, None, None] * np.eye(6)
        B[:, 6:, 6:] = -np.eye(6)
        C[:] = np.eye(STATE)
        d[:, :3] = -so3_log(E)
        scale = np.repeat([noise.turn, noise.shift], 3) ** -0.5
        # the inverse of the Cholesky factor of [[t^3/3, t^2/2], [t^2/2, t]]
        place, rate = np.sqrt(3 / step**3), 2 / np.sqrt(step)
        W = np.zeros((len(step), STATE, STATE))
        at = np.arange(6)
        W[:, at, at] = place[:, None] * scale
        W[:, at + 6, at + 6] = rate[:, None] * scale
        W[:, at + 6, at] = (-1.5 / step * rate)[:, None] * scale
        return W @ B, W @ C, np.einsum("nij,nj->ni", W, d)


@dataclass(frozen=True, eq=False)
class Equations:
    """Whitened equations of the states x (N, 12): ``A x_k = b`` and ``B x_k + C x_k+1 = d``.

    Attributes:
        A, b: (N, 6, 12) and (N, 6), of the measured poses.
        B, C, d: (N - 1, 12, 12), the same, and (N - 1, 12), of the motion between frames.
    """

    A: Array
    b: Array
    B: Array
    C: Array
    d: Array

    def weighted(self, frames: Array, steps: Array) -> Equations:
        """The equations with weights (N,) of their squares, and (N - 1,) of those of the motion."""
        pose, motion = np.sqrt(frames)[:, None], np.sqrt(steps)[:, None]
        A, B, C = pose[..., None] * self.A, motion[..., None] * self.B, motion[..., None] * self.C
        return Equations(A, pose * self.b, B, C, motion * self.d)

    def weights(self, state: Array) -> tuple[Array, Array]:
        """Weights of Student's t distribution for the frames (N,) and steps (N - 1,) of a state."""
        pose = np.einsum("nij,nj->ni", self.A, state) - self.b
        motion = (self.B @ state[:-1, :, None] + self.C @ state[1:, :, None])[..., 0] - self.d
        of_frames, of_steps = (
            (DEGREES_OF_FREEDOM + e.shape[1]) / (DEGREES_OF_FREEDOM + (e**2).sum(axis=1))
            for e in (pose, motion)
        )
        return of_frames, of_steps

    def solve(self) -> tuple[Array, float]:
        """The state (N, 12) of least squares, and these and the log determinant of its matrix."""
        A, B, C = self.A, self.B, self.C
        D = A.transpose(0, 2, 1) @ A
        D[:-1] += B.transpose(0, 2, 1) @ B
        D[1:] += C.transpose(0, 2, 1) @ C
        U = B.transpose(0, 2, 1) @ C
        g = np.einsum("nij,ni->nj", A, self.b)
        g[:-1] += np.einsum("nij,ni->nj", B, self.d)
        g[1:] += np.einsum("nij,ni->nj", C, self.d)
        factor = cholesky_banded(_banded(D, U), lower=True, overwrite_ab=True)
        state = cho_solve_banded((factor, True), g.ravel()).reshape(-1, STATE)
        squares = (self.b**2).sum() + (self.d**2).sum() - (g * state).sum()
        return state, float(squares + 2 * np.log(factor[0]).sum())


def _banded(D: Array, U: Array) -> Array:
    """Lower bands of a block tridiagonal matrix: blocks D (N, b, b) and above U (N - 1, b, b)."""
    count, size = D.shape[:2]
    banded = np.zeros((2 * size, count * size))
    columns = np.arange(count) * size
    for j in range(size):
        banded[: size - j, columns + j] = D[:, j:, j].T
        banded[size - j : 2 * size - j, columns[:-1] + j] = U[:, j, :].T
    return banded
