"""Which keypoints of an image a mask covers."""

from __future__ import annotations

import cv2
import numpy as np

from bmask_slam.graph.arrays import Array, Ints, Mask


def keypoints_under(mask: Mask, image_pixels: Array, border_px: int) -> Ints:
    """Indices of the pixels (N, 2), as detected, that lie in a mask (H, W) narrowed by a border.

    A negative border widens the mask. At the edge of the image the mask is not narrowed.
    """
    side = 2 * abs(border_px) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    change = cv2.erode if border_px > 0 else cv2.dilate
    inner = change(mask.astype(np.uint8), disc)
    columns, rows = np.rint(image_pixels).astype(np.int64).T
    height, width = mask.shape
    inside = inner[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]
    return np.flatnonzero(inside)
