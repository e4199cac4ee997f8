"""Weights drawn from a seed with numpy only, so that this network and torchvision get equal ones.

Plain random weights find nothing: every score is about 1 / classes. These keep the activations'
variance through the layers and widen the last ones, so that there are many detections, of many
classes, sizes and scores.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Arrays, Floats

GAINS = {
    "rpn.head.cls_logits.weight": 2.0,
    "rpn.head.bbox_pred.weight": 0.1,
    "roi_heads.box_predictor.cls_score.weight": 1.5,
    "roi_heads.box_predictor.bbox_pred.weight": 0.25,
    "roi_heads.mask_predictor.mask_fcn_logits.weight": 2.0,
    "roi_heads.maskiou_head.maskiou.weight": 0.3,
}
"""Factors on the variance-keeping standard deviation."""
RESIDUAL_GAIN = 0.2
PYRAMID_GAIN = 0.1
"""Brings the pyramid's levels, sums of many terms, back to about unit variance."""


def random_state(shapes: Mapping[str, tuple[int, ...]], seed: int) -> Arrays:
    """A state_dict as arrays; each depends on the seed and its own name alone."""
    return {name: _random(name, shape, seed) for name, shape in shapes.items()}


def _random(name: str, shape: tuple[int, ...], seed: int) -> NDArray:
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    if name.endswith("num_batches_tracked"):
        return np.array(7, np.int64)
    if name.endswith("running_var"):
        return rng.uniform(0.5, 1.5, shape).astype(np.float32)
    normal = rng.standard_normal(shape, np.float32)
    if len(shape) == 1:
        scale = 1.0 if name.endswith("weight") else 0.0
        if name.endswith("bn3.weight"):
            scale = RESIDUAL_GAIN
        return np.asarray(scale + 0.1 * normal, np.float32)
    gain = PYRAMID_GAIN if "fpn.layer_blocks" in name else GAINS.get(name, 1.0)
    fan_in = int(np.prod(shape[1:]))
    return np.asarray(normal * gain * np.sqrt(2.0 / fan_in), np.float32)


def picture(height: int, width: int, seed: int) -> Floats:
    """A smooth colourful picture (3, height, width) in 0..1."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:height, :width] / 16.0
    waves = rng.uniform(-1, 1, (3, 6, 3, 1, 1))
    image = np.sin(waves[:, :, 0] * u + waves[:, :, 1] * v + 3 * waves[:, :, 2]).mean(axis=1)
    return np.asarray(np.clip(0.5 + image, 0, 1), np.float32)


def random_boxes(rng: np.random.Generator, count: int, size: tuple[int, int]) -> Floats:
    """Boxes (count, 4) float32 of all sizes inside an image of (height, width)."""
    height, width = size
    sides = np.exp(rng.uniform(np.log(2), np.log([width, height]), (count, 2)))
    corner = rng.uniform(0, 1, (count, 2)) * (np.array([width, height]) - sides)
    return np.concatenate([corner, corner + sides], axis=1).astype(np.float32)
