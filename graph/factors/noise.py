"""GTSAM noise models from sigmas and covariances."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from bmask_slam.graph.arrays import Array


def pixel_noises(sigmas_px: Array, huber_k: float | None) -> list[gtsam.noiseModel.Base]:
    """A model for each row of sigmas, shared between equal rows.

    Rows are (u, v) for a monocular factor, or (u_left, v, disparity) for a stereo factor, whose
    error is (u_left, u_right, v). Depth sensor and keypoint err independently, so that
    u_right = u_left - disparity carries both errors:
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
    """A full (6, 6) model of the tangent ``[rad, m]``, with a kernel or none.

    ``robust`` is None, "huber", "cauchy" or "dcs"; ``k`` the whitened error up to which it
    trusts the measurement. DCS (dynamic covariance scaling) compares its constant with the
    SQUARED error, so it is given k^2.
    """
    model = gtsam.noiseModel.Gaussian.Covariance(covariance)
    estimators = gtsam.noiseModel.mEstimator
    kernels: dict[str, Any] = {
        "huber": lambda: estimators.Huber.Create(k),
        "cauchy": lambda: estimators.Cauchy.Create(k),
        "dcs": lambda: estimators.DCS.Create(k * k),
    }
    return model if robust is None else gtsam.noiseModel.Robust.Create(kernels[robust](), model)
