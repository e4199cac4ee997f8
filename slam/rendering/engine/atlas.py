"""All textures of a scene, with their mip levels, packed in one picture."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Floats, Image

_WIDTH = 16384
_LEVELS = 9
_LANE = 1024


@dataclass(frozen=True)
class Atlas:
    """K textures of at most L mip levels in one picture.

    Attributes:
        image: (H, W, 3) uint8.
        slots: (K * L, 4) float32 column, row of a level's first texel and its width, height.
        sizes: (K, 2) float32 width and height of the finest level in texels.
    """

    image: Image
    slots: Floats
    sizes: Floats


def build_atlas(textures: list[Image]) -> Atlas:
    """Pack textures and their halvings on shelves, each with a border of its own edge texels."""
    levels = [level for texture in textures for level in _mip_levels(texture)]
    order = sorted(range(len(levels)), key=lambda i: -levels[i].shape[0])
    places, x, y, shelf = {}, 0, 0, 0
    for i in order:
        rows, columns = levels[i].shape[0] + 4, levels[i].shape[1] + 4
        if x + columns > _WIDTH:
            x, y, shelf = 0, y + shelf, 0
        shelf = max(shelf, rows)
        places[i] = (x, y)
        x += columns
    image = np.zeros((y + shelf, _WIDTH, 3), np.uint8)
    slots = np.zeros((len(levels), 4), np.float32)
    for i, (column, row) in places.items():
        h, w = levels[i].shape[:2]
        framed = cv2.copyMakeBorder(levels[i], 2, 2, 2, 2, cv2.BORDER_REPLICATE)
        image[row : row + h + 4, column : column + w + 4] = framed
        slots[i] = column + 2, row + 2, w, h
    sizes = np.array([[t.shape[1], t.shape[0]] for t in textures], np.float32)
    return Atlas(image, slots, sizes)


def _mip_levels(texture: Image) -> list[Image]:
    levels = [texture]
    for _ in range(_LEVELS - 1):
        h, w = ((n + 1) // 2 for n in levels[-1].shape[:2])
        smaller = cv2.resize(levels[-1], (w, h), interpolation=cv2.INTER_AREA)
        levels.append(np.asarray(smaller, np.uint8))
    return levels


def sample(atlas: Atlas, texture: NDArray[np.integer], uv: list[Floats], level: Floats) -> Image:
    """Bilinear look-up: colours (N, 3) at u and v (N,) in [0, 1] of mip ``floor(level)``."""
    slot = texture * _LEVELS + np.clip(level, 0, _LEVELS - 1).astype(np.int32)
    place = np.ascontiguousarray(atlas.slots.take(slot, axis=0).T)
    n = len(slot)
    lanes = np.zeros((2, -(-n // _LANE), _LANE), np.float32)
    for lane, along, first, size in zip(lanes, uv, place[:2], place[2:], strict=True):
        where = np.minimum(np.maximum(along, 0), 1)
        where *= size
        where += first
        where -= np.float32(0.5)
        lane.reshape(-1)[:n] = where
    colours: Image = cv2.remap(atlas.image, *lanes, cv2.INTER_LINEAR)
    return colours.reshape(-1, 3)[:n]
