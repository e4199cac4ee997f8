"""A camera on wheels: its base keeps its height above a plane, and its tilt.

The plane is a pose of the graph, one for each map segment. It begins under the segment's first
keyframe and is optimised with everything else, so that the floor need not be level. Nothing is
measured: ``sensors.planar.enabled`` says that it is so.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_update import PLANAR, PosePrior, RelativePose, plane_id
from bmask_slam.graph.geometry import inverse
from bmask_slam.graph.sensors.mounting import T_of
from bmask_slam.graph.sensors.planar import PlanarConfig, planar_factor
from bmask_slam.sensing.reference_frame import Made, SensorChanges
from bmask_slam.world.keyframe import Keyframe

PRIOR_SIGMAS = np.array([1.0, 1.0, 1e-3, 1e-2, 1e-2, 10.0])
"""Of the prior on the plane, rad and m: tilt and height are free, the rest says only where on the
plane its origin is."""


def planar_changes(
    keyframes: Sequence[Keyframe], tables: FactorTables, made: Made, config: PlanarConfig
) -> SensorChanges:
    """The factors of a segment's keyframes that have none yet; ``made`` is extended.

    The plane begins with them where the graph has none for the segment.
    """
    if not config.enabled or not keyframes:
        return SensorChanges()
    plane = plane_id(keyframes[0].segment)
    if tables.keyframes.contains(np.array([plane])).all():
        (T,) = tables.keyframes.get(np.array([plane]))
        return SensorChanges(relative_poses=tuple(_factors(plane, T, keyframes, made, config)))
    for name in [name for name in made if name[0] == plane]:
        del made[name]
    T = keyframes[0].T_world_camera @ inverse(T_of(config.camera_in_base))
    return SensorChanges(
        np.array([plane]),
        T[None],
        (PosePrior(plane, T, np.diag(PRIOR_SIGMAS**2)),),
        tuple(_factors(plane, T, keyframes, made, config)),
    )


def _factors(
    plane: int,
    T_world_plane: Array,
    keyframes: Sequence[Keyframe],
    made: Made,
    config: PlanarConfig,
) -> Iterator[RelativePose]:
    """Those of the keyframes that have none, at the present estimates."""
    T_plane_world = inverse(T_world_plane)
    for keyframe in keyframes:
        name = (plane, keyframe.id, PLANAR)
        if name not in made:
            made[name] = np.nan
            yield planar_factor(name[:2], T_plane_world @ keyframe.T_world_camera, config)
