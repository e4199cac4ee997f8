"""A keyframe's instances as pieces of surface in space."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Floats, Ints, Mask
from bmask_slam.semantics.beliefs.votes import NOBODY, PixelAssignment

_COARSE = 4
"""Of masks every so many pixels each way are counted."""


@dataclass(frozen=True)
class DetectionConfig:
    """Which pixels of an instance become points, and how many.

    ``border_px``: nearer to a mask's border depth belongs to this side or the other; not where
    both sides' masks have scores of ``exact_score`` or more. An instance
    with fewer than ``min_points`` is passed over, of more than ``max_points`` some are taken. So is
    one of which better ones of its class own more than ``double``: it is another outline of them,
    as one around two desks that stand side by side, and what it is left with is no thing.

    The inverse depth of a point is a mean over pixels of its instance in a window of
    ``smooth_px`` to each side, of those whose depth is within three sigmas: at 1 m
    ``depth_sigma_m``, growing with the square of the depth. Noise along the rays would else make
    thin things thick.
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
    assignment: PixelAssignment, depth_m: Floats, rays: Array, config: DetectionConfig
) -> Detections:
    """The surface points of each instance.

    ``depth_m`` (h, w) is every s-th pixel of the image both ways, ``rays`` (h, w, 3) are the
    points at depth 1 m that those pixels see.
    """
    step = assignment.owner.shape[0] // depth_m.shape[0]
    height, width = depth_m.shape
    owner = _without_border(assignment, config)[::step, ::step][:height, :width]
    rows, columns = np.nonzero((owner != NOBODY) & np.isfinite(depth_m))
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
    z_m = _smoothed((owner, depth_m), rows, columns, config.smooth_px // step, config)
    points = rays[rows, columns] * z_m[:, None]
    return Detections(instances, points, number[owners], number)


def _doubles(assignment: PixelAssignment, share: float) -> list[int]:
    """Instances of whose masks others of their class own more than a share."""
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
    images: tuple[NDArray[np.int16], Floats],
    rows: Ints,
    columns: Ints,
    reach: int,
    config: DetectionConfig,
) -> Array:
    """Depths (P,) of pixels of the images (h, w) of owners and depth, means over windows."""
    owner, depth_m = images
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
    """Owners of pixels (H, W), nobody where another is near and either may be wrong."""
    owner, reach = assignment.owner, config.border_px
    vague = np.array([*(i.mask_score < config.exact_score for i in assignment.instances), False])
    if reach == 0 or not vague.any():
        return owner
    square = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    alone = cv2.erode(owner, square) == cv2.dilate(owner, square)
    near_vague = cv2.dilate(vague[owner].astype(np.uint8), square) > 0
    return np.where(alone | ~near_vague, owner, np.int16(NOBODY))


def _evenly(groups: Ints, sizes: Ints, most: int) -> Mask:
    """Of each group (sorted, of these sizes) at most so many members, spread over it."""
    place = np.arange(len(groups)) - (np.cumsum(sizes) - sizes)[groups]
    share = np.minimum(1.0, most / np.maximum(sizes, 1))[groups]
    return np.floor((place + 1) * share) > np.floor(place * share)
