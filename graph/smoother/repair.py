"""What to remove from the graph after ISAM2 failed.

GTSAM names a variable near the place where elimination broke down, which need not be the
cause: a new pose that observes one point is reported as that point. So recognisable causes are
searched first, and the named variable is removed only if there is none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bmask_slam.graph.arrays import Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.checks import observation_errors, reprojection
from bmask_slam.graph.factors.factor_tables import FactorTables, ids_array
from bmask_slam.graph.factors.graph_update import ANCHOR, GraphUpdate
from bmask_slam.graph.factors.observability import constrained_landmarks
from bmask_slam.graph.factors.own_factors import Variable, suspects
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.smoother.anchoring import (
    anchor_components,
    keyframes_anchored_by,
    loose_in,
    weak_between,
)
from bmask_slam.graph.smoother.isam2 import SolverError
from bmask_slam.graph.smoother.removal import remove


@dataclass(frozen=True)
class Repair:
    """What a repair removed from the factor tables, and which keyframes it anchored."""

    dropped_landmarks: Ints
    dropped_keyframes: Ints
    anchored_keyframes: Ints

    @property
    def changed(self) -> bool:
        """Whether it did anything; if not, another attempt would fail too."""
        return bool(
            len(self.dropped_landmarks)
            or len(self.dropped_keyframes)
            or len(self.anchored_keyframes)
        )


def solve_without_own(
    failure: SolverError,
    new: Sequence[int],
    tables: FactorTables,
    solve: Callable[[FactorTables], None],
) -> tuple[list[int], SolverError | None]:
    """Remove users' factors that may be the cause until it works, first the ``new`` ones.

    Returns their numbers, and the failure that is left, if any.
    """
    removed: list[int] = []
    while found := suspects(failure.variable, new, tables):
        removed += found
        for number in found:
            del tables.own_factors[number]
        try:
            solve(tables)
            return removed, None
        except SolverError as again:
            failure = again
    return removed, failure


def repair(
    named: Variable | None,
    new_keyframes: Ints,
    tables: FactorTables,
    camera: Camera,
    config: SmootherConfig,
) -> Repair:
    """Remove what makes the system singular; ``new_keyframes`` are removed, not anchored."""
    config = replace(config, min_left_observations=config.min_shared_observations)
    constrained = keyframes_anchored_by(anchor_components(tables, config), tables)
    pairs = _broken_observations(tables, camera)
    broken = remove(GraphUpdate(remove_observations=pairs), tables, config)
    landmarks = _loose_landmarks(tables, camera, config)
    keyframes = loose_in(tables, config)
    if named is not None and not (len(constrained) or broken or len(landmarks) or len(keyframes)):
        one = ids_array([named[1]])
        if named[0] == "landmark":
            landmarks = np.intersect1d(one, tables.landmarks.ids)
        else:
            keyframes = np.intersect1d(one, tables.keyframes.ids)
    leaving = ids_array(
        k for k in keyframes.tolist() if k in new_keyframes or _is_anchored(k, tables)
    )
    update = GraphUpdate(remove_landmarks=landmarks, remove_keyframes=leaving)
    removal = remove(update, tables, config)
    tied = _anchor(np.setdiff1d(keyframes, leaving), tables, config)
    anchored = (constrained, broken.anchored_keyframes, removal.anchored_keyframes, tied)
    dropped = (landmarks, broken.dropped_landmarks, removal.dropped_landmarks)
    return Repair(
        np.unique(np.concatenate(dropped)),
        leaving,
        np.intersect1d(np.concatenate(anchored), tables.keyframes.ids),
    )


def _is_anchored(keyframe: int, tables: FactorTables) -> bool:
    factors = (tables.pose_factors[n].factor for n in tables.numbers_of_keyframes([keyframe]))
    return any(factor.kind == ANCHOR for factor in factors)


def _broken_observations(tables: FactorTables, camera: Camera) -> Ints:
    """Pairs (N, 2) of observations without a finite error; a NaN makes every value NaN."""
    errors = observation_errors(tables, camera)
    bad = ~np.isfinite(errors.chi2)
    return np.stack([errors.keyframe_ids[bad], errors.landmark_ids[bad]], axis=1)


def _loose_landmarks(tables: FactorTables, camera: Camera, config: SmootherConfig) -> Ints:
    """Landmarks that observations from in front of the camera do not constrain."""
    observations = tables.observations.all()
    poses, points = tables.values_of(observations)
    depth_m, _ = reprojection(observations, poses, points, camera)
    useful = depth_m >= config.min_depth_m
    constrained = constrained_landmarks(
        observations.select(useful), poses[useful], points[useful], config.min_parallax_deg
    )
    return np.setdiff1d(tables.landmarks.ids, constrained)


def _anchor(loose: Ints, tables: FactorTables, config: SmootherConfig) -> Ints:
    """Anchor loose keyframes to firm ones one by one, since one may hold a whole component."""
    anchored: list[int] = []
    while len(loose):
        firm = np.setdiff1d(tables.keyframes.ids, loose)
        if not len(firm):
            break
        k = int(loose[0])
        nearest = int(firm[np.argmin(np.abs(firm - k))])
        tables.add_pose_factors([weak_between(nearest, k, tables, config)])
        anchored.append(k)
        loose = np.intersect1d(loose[1:], loose_in(tables, config))
    return ids_array(anchored)
