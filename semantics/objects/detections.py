"""Surface points of a keyframe's instances."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Floats, Ints, Mask, step_of
from bmask_slam.semantics.beliefs.pixel_assignment import NO_INSTANCE, PixelAssignment

_COARSE = 4
"""Overlaps of masks are counted on every fourth pixel in both directions."""


@dataclass(frozen=True)
class DetectionConfig:
    """Which pixels of an instance become points, and how many.

    Pixels within ``border_px`` of a mask's border are not used, since their depth may belong to
    either side, unless both masks have scores of at least ``exact_score``. An instance with fewer
    than ``min_points`` is ignored; of more than ``max_points``, some are chosen. An instance is
    also ignored if better ones of its class own more than the share ``double`` of it: it is a
    second outline of them, such as one around two desks side by side.

    The inverse depth of a point is a mean over the pixels of its instance in a window of
    ``smooth_px`` to each side whose depth is within three sigmas (``depth_sigma_m`` at 1 m, growing
    with the square of the depth). Otherwise noise along the rays would make thin objects thick.
    """

    border_px: int = 1
    exact_score: float = 0.99
    min_points: int = 12
    double: float = 0.5
    max_points: int = 300
    smooth_px: int = 4
    depth_sigma_m: float = 0.002


@dataclass(frozen=True, eq=False)
class Detections:
    """Instances (D,) with depth.

    Attributes:
        instances: (D,) their indices in the pixel assignment.
        points_camera: (P, 3) metres.
        owners: (P,) the detection of each point, ascending.
        number: (K + 1,) the detection of each instance, -1 for none; the last row stands for
            pixels without an instance.
    """

    instances: Ints
    points_camera: Array
    owners: Ints
    number: Ints

    def __len__(self) -> int:
        return len(self.instances)


def detect(
    assignment: PixelAssignment, depth_m: Floats, rays: Array, config: DetectionConfig
) -> Detections:
    """The surface points of each instance.

    ``depth_m`` (h, w) is every s-th pixel of the image in both directions, ``rays`` (h, w, 3) the
    camera-frame points of these pixels at a depth of 1 m.
    """
    step = step_of(assignment.owner.shape[0], depth_m.shape[0])
    height, width = depth_m.shape
    owner = _without_border(assignment, config)[::step, ::step][:height, :width]
    rows, columns = np.nonzero((owner != NO_INSTANCE) & np.isfinite(depth_m))
    owners, z_m = owner[rows, columns].astype(np.int64), depth_m[rows, columns].astype(float)
    good = assignment.on_surface(owners, z_m)
    order = np.argsort(owners[good], kind="stable")
    rows, columns, owners = (a[good][order] for a in (rows, columns, owners))
    sizes = np.bincount(owners, minlength=len(assignment.instances))
    sizes[_doubles(assignment, config.double)] = 0
    kept = _evenly(owners, sizes, config.max_points) & (sizes >= config.min_points)[owners]
    rows, columns, owners = rows[kept], columns[kept], owners[kept]
    instances = np.flatnonzero(sizes >= config.min_points)
    number = np.full(len(assignment.instances) + 1, -1)
    number[instances] = np.arange(len(instances))
    z_m = _smoothed(owner, depth_m, rows, columns, config.smooth_px // step, config)
    points = rays[rows, columns] * z_m[:, None]
    return Detections(instances, points, number[owners], number)


def _doubles(assignment: PixelAssignment, share: float) -> list[int]:
    """Instances of which others of their class own more than a share."""
    labels = np.array([*(i.label for i in assignment.instances), 0])
    owned = labels[assignment.owner[::_COARSE, ::_COARSE]]
    found = []
    for k, instance in enumerate(assignment.instances):
        mask = instance.mask[::_COARSE, ::_COARSE]
        others = (owned[mask] == labels[k]) & (assignment.owner[::_COARSE, ::_COARSE][mask] != k)
        if np.count_nonzero(others) > share * np.count_nonzero(mask):
            found.append(k)
    return found


def _smoothed(
    owner: NDArray[np.int16],
    depth_m: Floats,
    rows: Ints,
    columns: Ints,
    reach: int,
    config: DetectionConfig,
) -> Array:
    """Depths (P,) at pixels of ``depth_m`` (h, w): means over windows within one owner (h, w)."""
    shifts = np.arange(-reach, reach + 1)
    v = np.clip(rows[:, None, None] + shifts[:, None], 0, depth_m.shape[0] - 1)
    u = np.clip(columns[:, None, None] + shifts, 0, depth_m.shape[1] - 1)
    z_m = depth_m[rows, columns].astype(float)[:, None, None]
    near = depth_m[v, u]
    with np.errstate(invalid="ignore"):
        alike = np.abs(near - z_m) < 3 * config.depth_sigma_m * z_m**2
    alike &= owner[v, u] == owner[rows, columns][:, None, None]
    alike[:, reach, reach] = True
    inverse = np.where(alike, 1 / near, 0.0)
    return np.asarray(alike.sum(axis=(1, 2)) / inverse.sum(axis=(1, 2)))


def _without_border(assignment: PixelAssignment, config: DetectionConfig) -> NDArray[np.int16]:
    """Owners of pixels (H, W); none near a border where either mask may be inexact."""
    owner, reach = assignment.owner, config.border_px
    vague = np.array([*(i.mask_score < config.exact_score for i in assignment.instances), False])
    if reach == 0 or not vague.any():
        return owner
    square = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    interior = cv2.erode(owner, square) == cv2.dilate(owner, square)
    near_vague = cv2.dilate(vague[owner].astype(np.uint8), square) > 0
    return np.where(interior | ~near_vague, owner, np.int16(NO_INSTANCE))


def _evenly(groups: Ints, sizes: Ints, most: int) -> Mask:
    """Choose at most so many members of each group (sorted, of these sizes), evenly spread."""
    place = np.arange(len(groups)) - (np.cumsum(sizes) - sizes)[groups]
    share = np.minimum(1.0, most / np.maximum(sizes, 1))[groups]
    return np.floor((place + 1) * share) > np.floor(place * share)
