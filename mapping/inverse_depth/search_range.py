"""Step 1: the range of inverse depth in which a keyframe's surfaces lie."""

from __future__ import annotations

import numpy as np

from bmask_slam.graph.arrays import Array

MIN_LANDMARKS = 5


def search_range(
    depths_m: Array, share: float = 0.98, margin: float = 0.25
) -> tuple[float, float] | None:
    """Least and largest inverse depth in 1/m from the depths (N,) of a keyframe's landmarks.

    Algorithm 1 uses min and max, which one outlier spoils. Here it is the middle ``share`` of the
    inverse depths, widened at both ends by ``margin`` of its length because surfaces extend beyond
    their landmarks, but at most to half the least and twice the largest of them. None where fewer
    than MIN_LANDMARKS are in front of the camera.
    """
    depths_m = np.asarray(depths_m, float)
    rho = 1 / depths_m[np.isfinite(depths_m) & (depths_m > 0)]
    if len(rho) < MIN_LANDMARKS:
        return None
    low, high = np.quantile(rho, [(1 - share) / 2, (1 + share) / 2])
    widened = margin * (high - low)
    return float(max(low - widened, low / 2)), float(min(high + widened, 2 * high))
