"""GTSAM noise models from sigmas and covariances."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from graph.geometry import Array


def pixel_noises(sigmas_px: Array, huber_k: float | None) -> list[gtsam.noiseModel.Base]:
    """A diagonal model for each row of sigmas (M, 2 or 3), shared between equal rows.

    ``huber_k`` is the whitened error at which Huber's kernel starts; None: no kernel.
    """
    if not len(sigmas_px):
        return []
    distinct, which = np.unique(sigmas_px, axis=0, return_inverse=True)
    models: list[gtsam.noiseModel.Base] = [
        gtsam.noiseModel.Diagonal.Sigmas(row) for row in distinct
    ]
    if huber_k is not None:
        kernel = gtsam.noiseModel.mEstimator.Huber.Create(huber_k)
        models = [gtsam.noiseModel.Robust.Create(kernel, model) for model in models]
    return [models[i] for i in which.ravel().tolist()]


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
