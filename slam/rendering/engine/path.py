"""Smooth camera motion, as a person carries a camera."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import make_pose, so3_exp, so3_log

SWEEP = np.array(
    [
        *((0.20, 0.31), (0.15, 0.23), (0.50, 0.17)),
        *((0.10, 0.29), (0.10, 0.37), (0.12, 0.21)),
    ]
)
"""Amplitudes [rad, m] and frequencies [Hz] of a motion for calibration, added to the path: tilt,
pan and roll about x, y and z, then translation along them."""


@dataclass(frozen=True)
class CameraPath:
    """Way points of the camera, joined by a smooth curve.

    Attributes:
        eyes_world: (N, 3) positions in metres, z up.
        targets_world: (N, 3) points looked at.
        speed_m_s: walking speed; slower where the turn would exceed ``turn_deg_s``.
        turn_deg_s: largest turn rate.
        samples: number of equal shares of the curve for which its speed is found.
    """

    eyes_world: Array
    targets_world: Array
    speed_m_s: float = 0.42
    turn_deg_s: float = 26.0
    samples: int = 4000

    @cached_property
    def share_times_s(self) -> Array:
        """The time at which each of the equal shares of the path is reached."""
        fine = _at(self, np.linspace(0, 1, self.samples))
        step_m = np.linalg.norm(np.diff(fine[:, :3, 3], axis=0), axis=1)
        relative = np.swapaxes(fine[:-1, :3, :3], 1, 2) @ fine[1:, :3, :3]
        step_deg = np.rad2deg(np.linalg.norm(so3_log(relative), axis=1))
        slowness = np.maximum(step_m / self.speed_m_s, step_deg / self.turn_deg_s)
        slowness = np.maximum(gaussian_filter1d(slowness, 60, mode="nearest"), 0.9 * slowness)
        slowness = gaussian_filter1d(slowness, 25, mode="nearest")
        return np.r_[0.0, np.cumsum(slowness)]


def look_at(eyes: Array, targets: Array) -> Array:
    """Poses T_world_camera (N, 4, 4) with z toward the target, x right and y down; no roll."""
    forward = targets - eyes
    forward = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right, axis=-1, keepdims=True)
    return make_pose(np.stack([right, np.cross(forward, right), forward], axis=-1), eyes)


def camera_poses(path: CameraPath, fps: float, seed: int, sweeping: bool = False) -> Array:
    """The poses T_world_camera (F, 4, 4) of all frames along the path."""
    stamps = np.arange(int(path.share_times_s[-1] * fps) + 1) / fps
    return poses_at(path, stamps, seed, sweeping)


def poses_at(path: CameraPath, times_s: Array, seed: int, sweeping: bool = False) -> Array:
    """Poses T_world_camera (N, 4, 4) along the path at times (N,), with the tremor of a hand.

    ``sweeping`` adds SWEEP.
    """
    poses = steady_poses(path, times_s)
    if sweeping:
        poses = poses @ _sweep(times_s)
    return _shaken(poses, times_s, np.random.default_rng([seed, 7]))


def steady_poses(path: CameraPath, times_s: Array) -> Array:
    """Poses T_world_camera (N, 4, 4) along the path at times (N,), without tremor."""
    shares_s = path.share_times_s
    share = np.interp(_eased(times_s, shares_s[-1]), shares_s, np.linspace(0, 1, path.samples))
    return _at(path, share)


def duration_s(path: CameraPath) -> float:
    """Duration of the path, with the slow start."""
    return float(path.share_times_s[-1]) + 0.5


def _eased(stamps: Array, total_s: float) -> Array:
    """Start from rest within a second."""
    start = 0.5 * np.clip(stamps, 0.0, 1.0) ** 2 + np.maximum(stamps - 1.0, 0)
    return np.minimum(start, total_s)


def _at(path: CameraPath, share: Array) -> Array:
    """Poses (N, 4, 4) at shares (N,) in [0, 1] of the curve."""
    chord = np.linalg.norm(np.diff(path.eyes_world, axis=0), axis=1) + 0.35 * np.linalg.norm(
        np.diff(path.targets_world, axis=0), axis=1
    )
    knots = np.r_[0.0, np.cumsum(chord)] / chord.sum()
    eyes = CubicSpline(knots, path.eyes_world)(share)
    targets = CubicSpline(knots, path.targets_world)(share)
    return look_at(eyes, targets)


def _sweep(stamps: Array) -> Array:
    """Poses (N, 4, 4) in the camera's own frame: SWEEP, beginning at rest."""
    size, frequency = SWEEP[:, 0], SWEEP[:, 1]
    begun = np.clip(stamps, 0.0, 1.0)[:, None] ** 2
    motion = begun * size * np.sin(2 * np.pi * stamps[:, None] * frequency)
    return make_pose(so3_exp(motion[:, :3]), motion[:, 3:])


def _shaken(poses: Array, stamps: Array, rng: np.random.Generator) -> Array:
    """Add sums of sines between 0.3 and 2.5 Hz: some millimetres and tenths of a degree."""
    frequency = rng.uniform(0.3, 2.5, (6, 6))
    phase = rng.uniform(0, 2 * np.pi, (6, 6))
    waves = np.sin(2 * np.pi * stamps[:, None, None] * frequency + phase) / (1 + 2 * frequency)
    motion = waves.sum(-1) * np.r_[np.full(3, np.deg2rad(0.5)), np.full(3, 0.006)]
    T = poses.copy()
    T[:, :3, :3] = poses[:, :3, :3] @ so3_exp(motion[:, :3])
    T[:, :3, 3] += np.einsum("nij,nj->ni", poses[:, :3, :3], motion[:, 3:])
    return T
