"""A keyframe's instances as pieces of surface in space."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from graph.geometry import Array
from semantics.votes import NOBODY, Claims, Ints


@dataclass(frozen=True)
class DetectionConfig:
    """Which pixels of an instance become points, and how many.

    ``border_px``: nearer to a mask's border depth belongs to this side or the other. An instance
    with fewer than ``min_points`` is passed over, of more than ``max_points`` some are taken.
    """

    border_px: int = 1
    min_points: int = 12
    max_points: int = 300


@dataclass(frozen=True, eq=False)
class Detections:
    """Instances (D,) with depth.

    Attributes:
        instances: (D,) their numbers among the claims.
        points_camera: (P, 3) metres.
        owners: (P,) the detection that each point is of, rising.
        number: (K + 1,) the detection of each instance, -1 for none; the last for "no instance".
    """

    instances: Ints
    points_camera: Array
    owners: Ints
    number: Ints

    def __len__(self) -> int:
        return len(self.instances)


def detect(
    claims: Claims, depth_m: NDArray[np.float32], rays: Array, config: DetectionConfig
) -> Detections:
    """The surface points of each instance.

    ``depth_m`` (h, w) is every s-th pixel of the image both ways, ``rays`` (h, w, 3) are the
    points at depth 1 m that those pixels see.
    """
    step = claims.owner.shape[0] // depth_m.shape[0]
    height, width = depth_m.shape
    owner = _without_border(claims.owner, config.border_px)[::step, ::step][:height, :width]
    rows, columns = np.nonzero((owner != NOBODY) & np.isfinite(depth_m))
    owners, z_m = owner[rows, columns].astype(np.int64), depth_m[rows, columns].astype(float)
    good = claims.on_surface(owners, z_m)
    order = np.argsort(owners[good], kind="stable")
    rows, columns, owners = (a[good][order] for a in (rows, columns, owners))
    sizes = np.bincount(owners, minlength=len(claims.instances))
    kept = _evenly(owners, sizes, config.max_points) & (sizes >= config.min_points)[owners]
    rows, columns, owners = rows[kept], columns[kept], owners[kept]
    instances = np.flatnonzero(sizes >= config.min_points)
    number = np.full(len(claims.instances) + 1, -1)
    number[instances] = np.arange(len(instances))
    points = rays[rows, columns] * depth_m[rows, columns, None]
    return Detections(instances, points, number[owners], number)


def _without_border(owner: NDArray[np.int16], border_px: int) -> NDArray[np.int16]:
    """Owners of pixels (H, W), nobody where another is within so many pixels."""
    if border_px == 0:
        return owner
    square = np.ones((2 * border_px + 1, 2 * border_px + 1), np.uint8)
    alone = cv2.erode(owner, square) == cv2.dilate(owner, square)
    return np.where(alone, owner, np.int16(NOBODY))


def _evenly(groups: Ints, sizes: Ints, most: int) -> NDArray[np.bool_]:
    """Of each group (sorted, of these sizes) at most so many members, spread over it."""
    place = np.arange(len(groups)) - (np.cumsum(sizes) - sizes)[groups]
    share = np.minimum(1.0, most / np.maximum(sizes, 1))[groups]
    return np.floor((place + 1) * share) > np.floor(place * share)
