"""Offset and delay of depth images against colour images, from how their edges fit.

For every frame there is a map of scores: how well the edges of the depth image, shifted by some
pixels, fit those of the colour image. If the depth image shows the scene a time t later, its edges
lie t times the image's velocity further along, so that the best shift of frame i is

    shift_i = shift - flow_i (lag_i + delay)

with the lag that the stamps say. The shift and the delay are those at which the sum of the maps,
each moved by its own flow, is largest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, shift

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.calibration.model import NORMAL_95

MIN_FRAMES = 8
DELAYS_S = np.arange(-0.12, 0.1201, 0.008)
SMOOTH = 1.0
"""Steps by which maps are smoothed, so that the largest place is that of a peak, not of noise."""
BOOTSTRAPS, SEED = 60, 0
MAD_SIGMA = 1.4826


@dataclass(frozen=True, eq=False)
class EdgeScores:
    """Scores of n frames.

    Attributes:
        scores: (n, 2R + 1, 2R + 1) of the shifts from -R to R steps, rows first.
        step_px: pixels a step.
        flow_px_s: (n, 2) velocity of the image along u and v, as of the edges of depth.
        lags_s: (n,) time of the depth image less that of the colour image, as far as it is known.
    """

    scores: Array
    step_px: float
    flow_px_s: Array
    lags_s: Array


@dataclass(frozen=True, eq=False)
class Registration:
    """How depth lies on colour.

    Attributes:
        shift_px: (2,) by which depth has to be moved along u and v to fit colour.
        shift_sigma_px: (2,) its standard deviation.
        delay_s: time that depth images are later than their stamps and the camera say.
        delay_sigma_s: its standard deviation.
        strength: height of the peak over the other shifts, in their standard deviations.
    """

    shift_px: Array
    shift_sigma_px: Array
    delay_s: float
    delay_sigma_s: float
    strength: float

    def agrees(self, other: Registration) -> bool:
        """Whether both may show the same delay, by 95 % bounds."""
        sigma_s = np.hypot(self.delay_sigma_s, other.delay_sigma_s)
        return bool(abs(self.delay_s - other.delay_s) < NORMAL_95 * sigma_s)


def register(edges: EdgeScores) -> Registration | None:
    """Shift and delay with bounds by a bootstrap over frames; None: too few frames.

    Pixels of one frame share its motion and its scene, so frames are what is drawn.
    """
    count = len(edges.scores)
    if count < MIN_FRAMES:
        return None
    draws = np.random.default_rng(SEED).multinomial(count, np.full(count, 1 / count), BOOTSTRAPS)
    weights = np.concatenate([np.ones((1, count)), draws])
    (delay_s, *shift_steps, strength), *others = _peaks(edges, weights)
    found = np.array([peak[:3] for peak in others])
    sigmas = found.std(axis=0, ddof=1)
    step = edges.step_px
    return Registration(
        np.array(shift_steps) * step, sigmas[1:] * step, delay_s, float(sigmas[0]), strength
    )


def strength_of(scores: Array) -> float:
    """Height of the highest peak of a map (2R + 1, 2R + 1) over its median, in robust sigmas."""
    smooth = gaussian_filter(scores, SMOOTH)
    return _strength(smooth)


def _strength(smooth: Array) -> float:
    middle = np.median(smooth)
    spread = MAD_SIGMA * np.median(np.abs(smooth - middle))
    return float((smooth.max() - middle) / max(spread, 1e-12))


def _peaks(edges: EdgeScores, weights: Array) -> list[tuple[float, float, float, float]]:
    """Delay in s, shift along u and v in steps, and strength, of each weighted sum of the maps.

    ``weights`` (D, n) are of the frames, whose maps are moved by their flow for each of DELAYS_S:
    one delay after another, since the maps of all would take 100 MB.
    """
    smooth = [gaussian_filter(scores, SMOOTH) for scores in edges.scores]
    by_second = edges.flow_px_s[:, ::-1] / edges.step_px
    by_delay = np.zeros((len(DELAYS_S), len(weights)))
    best = np.zeros((len(weights), *edges.scores.shape[1:]))
    for k, delay_s in enumerate(DELAYS_S):
        moves = (edges.lags_s + delay_s)[:, None] * by_second
        pairs = zip(smooth, moves, strict=True)
        moved = np.array([shift(one, move, order=1, mode="nearest") for one, move in pairs])
        sums = np.tensordot(weights, moved, 1)
        by_delay[k] = sums.max(axis=(1, 2))
        higher = by_delay[k] > by_delay[:k].max(axis=0, initial=-np.inf)
        best[higher] = sums[higher]
    return [_peak(*each) for each in zip(by_delay.T, best, strict=True)]


def _peak(by_delay: Array, best: Array) -> tuple[float, float, float, float]:
    """The same from the highest values (T,) by delay, and the map (S, S) at the best delay."""
    t = int(by_delay.argmax())
    v, u = np.unravel_index(int(best.argmax()), best.shape)
    radius = len(best) // 2
    delay_s = float(np.interp(t + _parabola(by_delay, t), range(len(DELAYS_S)), DELAYS_S))
    at_u = u + _parabola(best[v], int(u)) - radius
    at_v = v + _parabola(best[:, u], int(v)) - radius
    return delay_s, float(at_u), float(at_v), _strength(best)


def _parabola(values: Array, i: int) -> float:
    """Offset from i of the top of the parabola through three values; 0 at an end."""
    if not 0 < i < len(values) - 1:
        return 0.0
    before, at, after = values[i - 1 : i + 2]
    curvature = before - 2 * at + after
    return float(0.5 * (before - after) / curvature) if curvature < 0 else 0.0
