"""Votes of a keyframe's instances about landmarks: Algorithm 3 of the paper, made robust."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Floats, Ints, Mask, step_of
from bmask_slam.semantics.beliefs.pixel_assignment import NO_INSTANCE, PixelAssignment, are_within
from bmask_slam.semantics.beliefs.vote_config import VoteConfig


@dataclass(frozen=True, eq=False)
class PixelStack:
    """The ``PixelAssignment`` of V keyframes whose images have one size.

    Attributes:
        owner, under: (V, H, W) int16, as of one keyframe: numbers count its own instances.
        inner: (V, H, W) bool.
        depth_m: (V, h, w).
        first: (V,) number of each keyframe's first instance among all of them.
        labels: (K,) of all instances; distributions: (K, C) of classes; scores: (K,) of masks.
        depth_range_m: (K, 2).
    """

    owner: NDArray[np.int16]
    under: NDArray[np.int16]
    inner: Mask
    depth_m: Floats
    first: Ints
    labels: Ints
    distributions: Floats
    scores: Floats
    depth_range_m: Array

    @classmethod
    def of(cls, assignment: PixelAssignment, classes: int) -> PixelStack:
        """A single keyframe's, which shares its images."""
        instances = assignment.instances
        return cls(
            assignment.owner[None],
            assignment.under[None],
            assignment.inner[None],
            assignment.depth_m[None],
            np.zeros(1, np.int64),
            np.array([i.label for i in instances], np.int64),
            np.array([i.distribution for i in instances], np.float32).reshape(-1, classes),
            np.array([i.mask_score for i in instances], np.float32),
            assignment.depth_range_m,
        )

    def numbered(self, image: NDArray[np.int16], views: Ints, rows: Ints, columns: Ints) -> Ints:
        """Instances (...) among all, or NO_INSTANCE, in pixels of ``owner`` or ``under``."""
        own = image[views, rows, columns].astype(np.int64)
        return np.where(own == NO_INSTANCE, NO_INSTANCE, own + self.first[views])


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


def vote(
    assignment: PixelAssignment, pixels: Array, z_m: Array, classes: int, config: VoteConfig
) -> Votes:
    """``vote_in_views`` about landmarks (N,) in the image of a single keyframe."""
    views = np.zeros(len(z_m), np.int64)
    return vote_in_views(PixelStack.of(assignment, classes), views, pixels, z_m, config)


def vote_in_views(
    stack: PixelStack, views: Ints, pixels: Array, z_m: Array, config: VoteConfig
) -> Votes:
    """The votes of keyframes about landmarks in their images (paper, Algorithm 3).

    For each landmark, in the image of ``views`` (N,) at ``pixels`` (N, 2) and with z-depth ``z_m``
    (N,) in the camera, NaN if unknown: the instance of its pixel votes with its class
    distribution, weighted by its mask score, and the instance behind with the remaining weight; no
    vote if the landmark is not on the instance's surface. Near a border the instance is the only
    one with surface at the landmark's depth. Where there is no instance, the landmark is missed.
    """
    height, width = stack.owner.shape[1:]
    columns, rows = np.rint(pixels).astype(np.int64).reshape(-1, 2).T
    columns, rows = np.clip(columns, 0, width - 1), np.clip(rows, 0, height - 1)
    painted = stack.numbered(stack.owner, views, rows, columns)
    owners, inner = painted.copy(), stack.inner[views, rows, columns]
    sure, single = inner.copy(), inner.copy()
    edge = np.flatnonzero(~inner)
    if config.edge_px and len(edge):
        found, one = _at_edges(stack, views[edge], rows[edge], columns[edge], z_m[edge], config)
        decided = found != NO_INSTANCE
        owners[edge[decided]], single[edge] = found[decided], one & decided
        sure[edge] = decided
    covered = owners != NO_INSTANCE
    votes = np.ones(len(owners), bool)
    votes[covered] = are_within(stack.depth_range_m[owners[covered]], z_m[covered])
    votes &= sure | (config.border_weight > 0)
    chosen = np.flatnonzero(votes)
    voters = owners[chosen]
    under = stack.numbered(stack.under, views[chosen], rows[chosen], columns[chosen])
    behind = np.where(voters == painted[chosen], under, NO_INSTANCE)
    distributions, weights = _mixed(stack, voters, behind)
    missed = voters == NO_INSTANCE
    weights[missed] = 1.0
    sure = sure[chosen]
    weights[~sure] *= np.float32(config.border_weight)
    instances = np.where(single[chosen], voters, NO_INSTANCE)
    return Votes(chosen, instances, missed, sure, distributions, weights)


def _mixed(stack: PixelStack, first: Ints, second: Ints) -> tuple[Floats, Floats]:
    """Distributions (M, C) and weights (M,) of instances (M,) with others (M,) behind them."""
    table = np.pad(stack.distributions, ((0, 1), (0, 0)))  # NO_INSTANCE is the last
    scores = np.pad(stack.scores, (0, 1))
    front, back = scores[first], (1 - scores[first]) * scores[second]
    weights = front + back
    sums = front[:, None] * table[first] + back[:, None] * table[second]
    return (sums / np.maximum(weights, 1e-12)[:, None]).astype(np.float32), weights


def _at_edges(
    stack: PixelStack, views: Ints, rows: Ints, columns: Ints, z_m: Array, config: VoteConfig
) -> tuple[Ints, Mask]:
    """The instance, by depth, of landmarks (N,) at rows and columns (N,) near a border.

    Returns:
        of the instances of one class with surface at the landmark's depth, that of the lowest score
        (N,), NO_INSTANCE where classes differ or some of the surface is of none; and whether it is
        the only one (N,).
    """
    size, depth_size = stack.owner.shape[1:], stack.depth_m.shape[1:]
    step = step_of(size[0], depth_size[0])
    limits = np.minimum(depth_size, -(-np.array(size) // step)) - 1
    reach = np.arange(-(config.edge_px // step), config.edge_px // step + 1)
    shifts = np.stack(np.meshgrid(reach, reach, indexing="ij"), axis=-1).reshape(-1, 2)
    around = np.stack([rows, columns], axis=1)[:, None] // step + shifts
    rows, columns = np.moveaxis(np.clip(around, 0, limits), -1, 0)
    apart_m = np.abs(stack.depth_m[views[:, None], rows, columns] - z_m[:, None])
    near = apart_m < config.edge_depth * z_m[:, None]
    owners = stack.numbered(stack.owner, views[:, None], rows * step, columns * step)
    count = len(stack.labels)
    first = np.where(near, owners, count).min(axis=1, initial=count)
    last = np.where(near, owners, NO_INSTANCE).max(axis=1, initial=NO_INSTANCE)
    classes = np.append(stack.labels, 0)  # NO_INSTANCE is the last
    one = (~near | (classes[owners] == classes[last][:, None])).all(axis=1) & (last >= 0)
    return np.where(one, last, NO_INSTANCE), first == last
