"""Checks of a smoother against its own factor tables and against a graph made from scratch."""

from __future__ import annotations

import numpy as np
from synthetic_room import CAMERA, Room

from bmask_slam.graph.factors.graph_estimate import GraphEstimate
from bmask_slam.graph.factors.graph_update import GraphUpdate, PosePrior, RelativePose
from bmask_slam.graph.factors.keys import (
    ROOT_BASE,
    VELOCITY_BASE,
    keyframe_keys,
    landmark_keys,
)
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.geometry import inverse, se3_log
from bmask_slam.graph.smoother.smoother import Smoother

EXACT = SmootherConfig(least_decrease=1e-7)
"""So that optima can be compared."""


def filled(room: Room, config: SmootherConfig | None = None) -> Smoother:
    smoother = Smoother(CAMERA, config or EXACT)
    for update in room.updates():
        smoother.update(update)
    return smoother


def from_scratch(smoother: Smoother, room: Room) -> GraphEstimate:
    """The optimum of a new graph with the same factors, initialised at the room's truth."""
    tables = smoother._tables
    observations = tables.observations.all()
    factors = [f.factor for f in tables.pose_factors.values()]
    fresh = Smoother(CAMERA, EXACT)
    fresh.update(
        GraphUpdate(
            tables.keyframes.ids,
            room.poses_world_camera[tables.keyframes.ids],
            tables.landmarks.ids,
            room.points_world[tables.landmarks.ids],
            observations,
            priors=tuple(f for f in factors if isinstance(f, PosePrior)),
            relative_poses=tuple(f for f in factors if isinstance(f, RelativePose)),
        )
    )
    return fresh.optimise_batch()


def assert_isam_matches_tables(smoother: Smoother) -> None:
    """Check that every slot holds exactly the factor of the tables."""
    tables, isam = smoother._tables, smoother._solver._isam
    graph = isam.getFactorsUnsafe()
    rows = tables.observations.all_rows()
    observations = tables.observations.select(rows)
    expected = dict(
        zip(
            tables.observations.slots(rows).tolist(),
            zip(
                keyframe_keys(observations.keyframe_ids),
                landmark_keys(observations.landmark_ids),
                strict=True,
            ),
            strict=True,
        )
    )
    for factor in tables.pose_factors.values():
        expected[factor.slot] = tuple(keyframe_keys(np.array(factor.keyframes)))
    keys_in_graph = {i: tuple(graph.at(i).keys()) for i in range(graph.size()) if graph.exists(i)}
    keys_in_graph = {
        i: keys for i, keys in keys_in_graph.items() if not ROOT_BASE <= keys[-1] < VELOCITY_BASE
    }
    assert keys_in_graph == expected
    assert len(expected) == len(rows) + len(tables.pose_factors)


def assert_same_optimum(smoother: Smoother, room: Room) -> None:
    expected, found = from_scratch(smoother, room), smoother.optimise_batch()
    difference = se3_log(inverse(found.poses_world_camera) @ expected.poses_world_camera)
    assert np.abs(difference).max() < 1e-5
    np.testing.assert_allclose(found.points_world, expected.points_world, atol=1e-4)


def pairs_of(smoother: Smoother) -> set[tuple[int, int]]:
    """(keyframe, landmark) of every observation in the graph."""
    return set(map(tuple, smoother._tables.observations.all().pairs.tolist()))
