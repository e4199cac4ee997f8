"""Arrays to GTSAM factors, noise models and values, and values back to arrays.

GTSAM's stereo measurement is (u_left, u_right, v); ours is (u_left, v, u_right), as in
``Camera.project_stereo``. The order is changed here and nowhere else.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import gtsam
import numpy as np

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.graph_update import Observations, PosePrior, RelativePose
from bmask_slam.graph.factors.keys import keyframe_keys, landmark_keys
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.geometry import make_pose

_GTSAM_STEREO_ORDER = [0, 2, 1]


class FactorMaker:
    """Makes factors for one camera and one configuration."""

    def __init__(self, camera: Camera, config: SmootherConfig) -> None:
        self._config = config
        intrinsics = (camera.fx, camera.fy, 0.0, camera.cx, camera.cy)
        self._K_stereo = gtsam.Cal3_S2Stereo(*intrinsics, camera.baseline_m)
        self._K_mono = gtsam.Cal3_S2(*intrinsics)

    def observations(self, observations: Observations) -> list[gtsam.NonlinearFactor]:
        """One stereo or projection factor for each observation, in their order."""
        stereo = np.isfinite(observations.measurements[:, 2])
        factors: dict[int, gtsam.NonlinearFactor] = {}
        for rows, make in ((stereo, self._stereo), (~stereo, self._mono)):
            made = make(observations.select(rows))
            factors.update(zip(np.flatnonzero(rows).tolist(), made, strict=True))
        return [factors[row] for row in range(len(observations))]

    def _stereo(self, observations: Observations) -> list[gtsam.NonlinearFactor]:
        huber_k = self._config.huber_stereo if self._config.robust else None
        noises = pixel_noises(observations.sigmas_px, huber_k)
        K = self._K_stereo
        columns = zip(
            observations.measurements[:, _GTSAM_STEREO_ORDER].tolist(),
            noises,
            keyframe_keys(observations.keyframe_ids),
            landmark_keys(observations.landmark_ids),
            strict=True,
        )
        return [
            gtsam.GenericStereoFactor3D(gtsam.StereoPoint2(*z), noise, x, landmark, K)
            for z, noise, x, landmark in columns
        ]

    def _mono(self, observations: Observations) -> list[gtsam.NonlinearFactor]:
        huber_k = self._config.huber_mono if self._config.robust else None
        columns = zip(
            observations.measurements[:, :2],
            pixel_noises(observations.sigmas_px[:, :2], huber_k),
            keyframe_keys(observations.keyframe_ids),
            landmark_keys(observations.landmark_ids),
            strict=True,
        )
        return [
            gtsam.GenericProjectionFactorCal3_S2(z, noise, x, landmark, self._K_mono)
            for z, noise, x, landmark in columns
        ]

    def pose_factor(self, factor: RelativePose | PosePrior) -> gtsam.NonlinearFactor:
        """A prior, or ``T_world_a^-1 T_world_b = T_a_b``; covariance (6, 6) ``[rad, m]``."""
        if isinstance(factor, PosePrior):
            (key,) = keyframe_keys(np.array([factor.keyframe_id]))
            noise = pose_noise(factor.covariance, None, 1.0)
            return gtsam.PriorFactorPose3(key, gtsam.Pose3(factor.T_world_camera), noise)
        a, b = keyframe_keys(np.array([factor.keyframe_a, factor.keyframe_b]))
        noise = pose_noise(factor.covariance, factor.robust, self._config.robust_pose_k)
        return gtsam.BetweenFactorPose3(a, b, gtsam.Pose3(factor.T_a_b), noise)


def make_graph(factors: Iterable[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    """A graph of these factors, in their order."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    return graph


def make_values(
    keyframe_ids: Ints, poses_world_camera: Array, landmark_ids: Ints, points_world: Array
) -> gtsam.Values:
    """Values of keyframes (K, 4, 4) and landmarks (L, 3) in metres."""
    values = gtsam.Values()
    for key, T in zip(keyframe_keys(keyframe_ids), poses_world_camera, strict=True):
        values.insert(key, gtsam.Pose3(T))
    for key, p in zip(landmark_keys(landmark_ids), points_world, strict=True):
        values.insertPoint3(key, p)
    return values


def read_values(values: gtsam.Values) -> tuple[Array, Array]:
    """All poses (K, 4, 4) and all points (L, 3), each in the order of ascending ids.

    Velocities follow the landmarks: they are vectors, too. GTSAM's bulk read takes a third of the
    time of one call a variable.
    """
    rows = np.asarray(gtsam.utilities.extractPose3(values)).reshape(-1, 12)
    poses = make_pose(rows[:, :9].reshape(-1, 3, 3), rows[:, 9:])
    points = np.ascontiguousarray(gtsam.utilities.extractPoint3(values))
    return poses, points.reshape(-1, 3)


def pixel_noises(sigmas_px: Array, huber_k: float | None) -> list[gtsam.noiseModel.Base]:
    """A model for each row of sigmas, shared between equal rows.

    Rows are (u, v) for a monocular factor, or (u_left, v, disparity) for a stereo factor, whose
    error is (u_left, u_right, v). The errors of disparity and keypoint are independent, so that
    u_right = u_left - disparity has both:
    cov(u_left, u_right) = [[s_u^2, s_u^2], [s_u^2, s_u^2 + s_d^2]].
    ``huber_k`` is the whitened error at which Huber's kernel starts; None: no kernel.
    """
    if not len(sigmas_px):
        return []
    distinct, which = np.unique(sigmas_px, axis=0, return_inverse=True)
    models: list[gtsam.noiseModel.Base] = [_pixel_noise(*row) for row in distinct.tolist()]
    if huber_k is not None:
        kernel = gtsam.noiseModel.mEstimator.Huber.Create(huber_k)
        models = [gtsam.noiseModel.Robust.Create(kernel, model) for model in models]
    return [models[i] for i in which.ravel().tolist()]


def _pixel_noise(u: float, v: float, disparity: float | None = None) -> gtsam.noiseModel.Base:
    if disparity is None:
        return gtsam.noiseModel.Diagonal.Sigmas(np.array([u, v]))
    covariance = np.array([[u**2, u**2, 0], [u**2, u**2 + disparity**2, 0], [0, 0, v**2]])
    return gtsam.noiseModel.Gaussian.Covariance(covariance)


def pose_noise(covariance: Array, robust: str | None, k: float) -> gtsam.noiseModel.Base:
    """A full (6, 6) model of the tangent ``[rad, m]``, with or without a robust kernel.

    ``robust`` is None, "huber", "cauchy" or "dcs"; ``k`` the whitened error above which the
    kernel takes effect. DCS (dynamic covariance scaling) compares its constant with the SQUARED
    error, so it is given k^2.
    """
    model = gtsam.noiseModel.Gaussian.Covariance(covariance)
    estimators = gtsam.noiseModel.mEstimator
    kernels: dict[str, Any] = {
        "huber": lambda: estimators.Huber.Create(k),
        "cauchy": lambda: estimators.Cauchy.Create(k),
        "dcs": lambda: estimators.DCS.Create(k * k),
    }
    return model if robust is None else gtsam.noiseModel.Robust.Create(kernels[robust](), model)
