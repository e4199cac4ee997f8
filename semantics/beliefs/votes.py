"""Votes of a keyframe's instances about landmarks: Algorithm 3 of the paper, made robust."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Bytes, Floats, Ints, Mask
from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.instances.instances import Instance, mask_box, painting_order
from bmask_slam.semantics.labels import LabelSet

NO_INSTANCE = -1
_MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True)
class VoteConfig:
    """Which pixels of a mask count.

    Within ``border_px`` of another mask or of the mask's edge the owner of a pixel is uncertain,
    unless the depth decides: where all surface within ``edge_px`` at the landmark's depth, to the
    relative tolerance ``edge_depth``, belongs to instances of one class. A depth belongs to the
    mask's surface if it differs from the median depth in the mask by at most ``depth_sigmas``
    robust standard deviations plus ``depth_margin_m`` at 1 m, which grows with the square of the
    depth. Landmarks farther than ``background_border_px`` from any mask are missed. Where neither
    distance nor depth decides, a pixel votes for its owner, or as missed, with ``border_weight``
    times the usual weight.

    A mask of which the share ``nested`` lies in another of at least twice its area and of another
    class is in front of it, whatever the scores: a book in a bookcase.
    """

    border_px: int = 1
    depth_sigmas: float = 3.5
    depth_margin_m: float = 0.03
    edge_px: int = 4
    edge_depth: float = 0.03
    background_border_px: int = 8
    border_weight: float = 0.6
    nested: float = 0.8

    def __post_init__(self) -> None:
        if (
            min(self.border_px, self.edge_px, self.background_border_px) < 0
            or self.depth_sigmas <= 0
            or min(self.depth_margin_m, self.edge_depth) < 0
        ):
            raise ValueError("borders and depth tolerances must not be negative")
        if not 0 <= self.border_weight <= 1 or self.nested <= 0:
            raise ValueError("border_weight must be in [0, 1], nested above 0")


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
        near, far = self.depth_range_m[owners].T
        return ~((z_m < near) | (z_m > far))


@dataclass(frozen=True, eq=False)
class Votes:
    """Votes of a keyframe's masks about landmarks.

    Attributes:
        rows: (M,) index of each vote's landmark.
        instances: (M,) the instance that it is certainly on, -1 for none.
        missed: (M,) whether no instance covers it.
        sure: (M,) whether distance or depth decides on which surface it is.
        distributions: (M, C) of classes; zeros where missed.
        weights: (M,) probability that the distribution, or the miss, applies to this landmark.
    """

    rows: Ints
    instances: Ints
    missed: Mask
    sure: Mask
    distributions: Floats
    weights: Floats


def check_instances(
    instances: Sequence[Instance], size: tuple[int, int], labels: LabelSet, name: str
) -> None:
    """Refuse instances of another image size than (height, width) or another label set.

    Raises:
        InputError: a mask of another size, a label or distribution outside the set.
    """
    for instance in instances:
        if instance.mask.shape != size or instance.mask.dtype != bool:
            raise InputError(
                f"{name}: a mask of shape {instance.mask.shape}, {instance.mask.dtype}, but the "
                f"images have {size}; give masks of these images"
            )
        if not 0 < instance.label < len(labels) or len(instance.distribution) != len(labels):
            raise InputError(
                f"{name}: label {instance.label} of {len(instance.distribution)}, but the label "
                f"set has {len(labels)}; give the label set of these masks"
            )
        finite = np.isfinite(instance.distribution).all()
        if not finite or not 0 <= instance.mask_score <= 1:
            raise InputError(
                f"{name}: mask score {instance.mask_score} or a class probability is not between "
                "0 and 1; make the masks again"
            )


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


def vote(
    assignment: PixelAssignment, pixels: Array, z_m: Array, classes: int, config: VoteConfig
) -> Votes:
    """The votes of a keyframe about landmarks in its image (paper, Algorithm 3).

    For each landmark, at ``pixels`` (N, 2) in the image and with z-depth ``z_m`` (N,) in the
    camera, NaN if unknown: the instance of its pixel votes with its class distribution, weighted
    by its mask score, and the instance behind with the remaining weight; no vote if the landmark is
    not on the instance's surface. Near a border the instance is the only one with surface at the
    landmark's depth. Where there is no instance, the landmark is missed.
    """
    height, width = assignment.owner.shape
    columns, rows = np.rint(pixels).astype(np.int64).reshape(-1, 2).T
    columns, rows = np.clip(columns, 0, width - 1), np.clip(rows, 0, height - 1)
    owners = assignment.owner[rows, columns].astype(np.int64)
    inner = assignment.inner[rows, columns]
    sure, single = inner.copy(), inner.copy()
    edge = np.flatnonzero(~inner)
    if assignment.instances and config.edge_px and len(edge):
        found, one = _at_edges(assignment, rows[edge], columns[edge], z_m[edge], config)
        decided = found != NO_INSTANCE
        owners[edge[decided]], single[edge] = found[decided], one & decided
        sure[edge] = decided
    covered = owners != NO_INSTANCE
    votes = np.ones(len(owners), bool)
    votes[covered] = assignment.on_surface(owners[covered], z_m[covered])
    votes &= sure | (config.border_weight > 0)
    chosen = np.flatnonzero(votes)
    voters = owners[chosen]
    same = voters == assignment.owner[rows[chosen], columns[chosen]]
    behind = np.where(same, assignment.under[rows[chosen], columns[chosen]], NO_INSTANCE)
    distributions, weights = _mixed(assignment.instances, voters, behind, classes)
    missed = voters == NO_INSTANCE
    weights[missed] = 1.0
    sure = sure[chosen]
    weights[~sure] *= np.float32(config.border_weight)
    instances = np.where(single[chosen], voters, NO_INSTANCE)
    return Votes(chosen, instances, missed, sure, distributions, weights)


def _mixed(
    instances: Sequence[Instance], first: Ints, second: Ints, classes: int
) -> tuple[Floats, Floats]:
    """Distributions (M, C) and weights (M,) of instances (M,) with others (M,) behind them."""
    nothing = np.zeros(classes)
    table: Floats = np.array([*(i.distribution for i in instances), nothing], np.float32)
    scores: Floats = np.array([*(i.mask_score for i in instances), 0.0], np.float32)
    front, back = scores[first], (1 - scores[first]) * scores[second]
    weights = front + back
    sums = front[:, None] * table[first] + back[:, None] * table[second]
    return (sums / np.maximum(weights, 1e-12)[:, None]).astype(np.float32), weights


def _at_edges(
    assignment: PixelAssignment, rows: Ints, columns: Ints, z_m: Array, config: VoteConfig
) -> tuple[Ints, Mask]:
    """The instance, by depth, of landmarks (N,) at rows and columns (N,) near a border.

    Returns:
        of the instances of one class with surface at the landmark's depth, that of the lowest score
        (N,), NO_INSTANCE where classes differ or some of the surface is of none; and whether it is
        the only one (N,).
    """
    step = max(assignment.owner.shape[0] // max(assignment.depth_m.shape[0], 1), 1)
    limits = np.minimum(assignment.depth_m.shape, np.array(assignment.owner.shape) // step) - 1
    reach = np.arange(-(config.edge_px // step), config.edge_px // step + 1)
    shifts = np.stack(np.meshgrid(reach, reach, indexing="ij"), axis=-1).reshape(-1, 2)
    around = np.stack([rows, columns], axis=1)[:, None] // step + shifts
    rows, columns = np.moveaxis(np.clip(around, 0, limits), -1, 0)
    apart_m = np.abs(assignment.depth_m[rows, columns] - z_m[:, None])
    near = apart_m < config.edge_depth * z_m[:, None]
    owners = assignment.owner[rows * step, columns * step].astype(np.int64)
    count = len(assignment.instances)
    first = np.where(near, owners, count).min(axis=1, initial=count)
    last = np.where(near, owners, NO_INSTANCE).max(axis=1, initial=NO_INSTANCE)
    classes = np.array([i.label for i in assignment.instances])
    of_class = np.where(owners == NO_INSTANCE, 0, classes[owners])
    one = (~near | (of_class == classes[last][:, None])).all(axis=1) & near.any(axis=1)
    return np.where(one, last, NO_INSTANCE), first == last


def _disc(radius_px: int) -> Bytes:
    side = 2 * radius_px + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)


def _surfaces(
    owner: NDArray[np.int16], inner: Mask, depth_m: Floats, count: int, config: VoteConfig
) -> Array:
    """Depth range (K, 2) of each instance's surface: median and MAD of its inner pixels."""
    step = owner.shape[0] // max(depth_m.shape[0], 1)
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
    order = np.lexsort((values, groups))
    sizes = np.bincount(groups, minlength=count)
    middle = np.cumsum(sizes) - sizes + sizes // 2
    found = np.full(count, np.nan)
    some = sizes > 0
    found[some] = values[order][middle[some]]
    return found
