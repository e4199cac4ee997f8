"""The instance of each pixel of a keyframe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Bytes, Floats, Ints, Mask, step_of
from bmask_slam.semantics.beliefs.vote_config import VoteConfig
from bmask_slam.semantics.instances.instances import Instance, mask_box, painting_order

NO_INSTANCE = -1
_MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True, eq=False)
class PixelAssignment:
    """The instance of each pixel of a keyframe.

    Attributes:
        instances: sorted by mask score, the best first.
        owner: (H, W) int16, the index of a pixel's instance, -1 for none.
        under: (H, W) int16, the instance behind the owner, -1 for none.
        inner: (H, W) bool, whether a pixel is away from borders between owners and from borders of
            masks.
        depth_m: (h, w) every s-th pixel of the depth image in both directions, NaN where missing.
        depth_range_m: (K, 2) least and largest depth of each instance's surface; NaN for one
            without depth.
    """

    instances: tuple[Instance, ...]
    owner: NDArray[np.int16]
    under: NDArray[np.int16]
    inner: Mask
    depth_m: Floats
    depth_range_m: Array

    def on_surface(self, owners: Ints, z_m: Array) -> Mask:
        """Whether depths (N,) are on the surfaces of instances (N,); True for unknown depths."""
        return are_within(self.depth_range_m[owners], z_m)


def assign_pixels(
    instances: Sequence[Instance],
    depth_m: Floats,
    size: tuple[int, int],
    config: VoteConfig,
    in_boxes: bool = False,
) -> PixelAssignment:
    """Assign each pixel to the frontmost instance that covers it, usually that of best mask score.

    ``size`` is the image's (H, W); ``depth_m`` (H / s, W / s) may be every s-th pixel of the
    depth image in both directions. With ``in_boxes`` a mask is in front of another if it lies
    within the box around that: a bookcase's mask may exclude the books.
    """
    ranked = tuple(sorted(instances, key=lambda i: -i.mask_score))
    owner, under = np.full((2, *size), NO_INSTANCE, np.int16)
    for k in painting_order(ranked, config.nested, in_boxes).tolist():
        x1, y1, x2, y2 = mask_box(ranked[k].mask).astype(int)
        here = ranked[k].mask[y1:y2, x1:x2]
        under[y1:y2, x1:x2][here] = owner[y1:y2, x1:x2][here]
        owner[y1:y2, x1:x2][here] = k
    inner = np.ones(size, bool)
    if ranked:
        disc = _disc(config.border_px)
        inner = cv2.erode(owner, disc) == cv2.dilate(owner, disc)
        covered = (owner != NO_INSTANCE).astype(np.uint8)
        near = cv2.dilate(covered, _disc(config.background_border_px)) > covered
        inner &= ~near
    surfaces = _surfaces(owner, inner, depth_m, len(ranked), config)
    return PixelAssignment(ranked, owner, under, inner, depth_m, surfaces)


def are_within(ranges_m: Array, z_m: Array) -> Mask:
    """Whether depths (N,) are in ranges (N, 2); True for unknown ones."""
    near, far = ranges_m.T
    return ~((z_m < near) | (z_m > far))


def _disc(radius_px: int) -> Bytes:
    side = 2 * radius_px + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)


def _surfaces(
    owner: NDArray[np.int16], inner: Mask, depth_m: Floats, count: int, config: VoteConfig
) -> Array:
    """Depth range (K, 2) of each instance's surface: median and MAD of its inner pixels."""
    step = step_of(owner.shape[0], depth_m.shape[0])
    coarse = owner[::step, ::step][: depth_m.shape[0], : depth_m.shape[1]]
    usable = inner[::step, ::step][: depth_m.shape[0], : depth_m.shape[1]] & (coarse != NO_INSTANCE)
    usable &= np.isfinite(depth_m[: coarse.shape[0], : coarse.shape[1]])
    owners, depths = coarse[usable].astype(np.int64), depth_m[usable].astype(float)
    middle = grouped_median(depths, owners, count)
    spread = grouped_median(np.abs(depths - middle[owners]), owners, count)
    reach = config.depth_sigmas * _MAD_TO_SIGMA * spread + config.depth_margin_m * middle**2
    return np.stack([middle - reach, middle + reach], axis=1)


def grouped_median(values: Array, groups: Ints, count: int) -> Array:
    """The upper median (count,) of the values (N,) of each group (N,); NaN for an empty one."""
    order = np.argsort(groups.astype(np.int16), kind="stable")  # radix sort
    sizes, found = np.bincount(groups, minlength=count), np.full(count, np.nan)
    parts = np.split(values[order], np.cumsum(sizes)[:-1])
    for k in np.flatnonzero(sizes).tolist():
        found[k] = np.partition(parts[k], sizes[k] // 2)[sizes[k] // 2]
    return found
