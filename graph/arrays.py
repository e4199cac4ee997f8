"""Type aliases of the numpy arrays that the packages exchange, and empty ones."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]  # poses, points, pixels, covariances
Floats = NDArray[np.float32]  # depth images, textures, beliefs
Ints = NDArray[np.int64]  # ids and rows
Mask = NDArray[np.bool_]
Image = NDArray[np.uint8]  # colour (H, W, 3) or grey (H, W)
Bytes = NDArray[np.uint8]  # colours of points, image patches, packed bits
Bits = NDArray[np.uint64]  # binary descriptors, 64 bits a word
Arrays = dict[str, NDArray[Any]]  # arrays by name, as a file holds them


def no_ids() -> Ints:
    """No ids (0,)."""
    return np.zeros(0, np.int64)


def no_pairs() -> Ints:
    """No pairs of ids (0, 2)."""
    return np.zeros((0, 2), np.int64)


def step_of(whole: int, kept: int) -> int:
    """The step s of ``image[::s]``, which keeps ceil(whole / s) of an image's rows or columns."""
    return -(-whole // max(kept, 1))
