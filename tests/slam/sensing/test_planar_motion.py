"""Planar motion in a map: noisy keyframes of a camera on wheels come back to their plane."""

from __future__ import annotations

import numpy as np
from synthetic_view import CAMERA, add_keyframe, make_features, points_before, random_descriptors

from bmask_slam.back_end.config import BackEndConfig
from bmask_slam.back_end.landmark_management import MappingConfig
from bmask_slam.back_end.mapper import Mapper
from bmask_slam.graph.factors.graph_update import PLANAR, plane_id
from bmask_slam.graph.geometry import inverse, se3_exp
from bmask_slam.graph.sensors.config import SensorsConfig
from bmask_slam.graph.sensors.mounting import T_of
from bmask_slam.graph.sensors.planar import PlanarConfig
from bmask_slam.tracking.config import TrackingConfig
from bmask_slam.tracking.tracker import Tracker

MOUNTING = (0.2, 0.1, 0.6, 0.5, -0.5, 0.5, -0.5)


def offs(enabled: bool) -> tuple[Mapper, float]:
    """A map of eight keyframes with noisy points, and how far they are from a plane."""
    planar = PlanarConfig(enabled, MOUNTING, 1e-4, 1e-4)
    rules = BackEndConfig(MappingConfig(redundant_share=2.0), sensors=SensorsConfig(planar=planar))
    mapper, rng = Mapper(CAMERA, Tracker(CAMERA, TrackingConfig()), rules), np.random.default_rng(3)
    points, looks = points_before(np.eye(4), 60, rng), random_descriptors(60, rng)
    T_camera_base, ids = inverse(T_of(MOUNTING)), None
    for k in range(8):
        T_base = se3_exp(np.array([0, 0, 0.02 * k, 0.02 * k, 0.01 * k, 0]))
        T = T_camera_base @ T_base @ inverse(T_camera_base)
        noise = rng.normal(0, [2.0, 2.0, 0.3], (60, 3))
        keyframe = add_keyframe(mapper.world, T, make_features(T, points, looks, noise), 0)
        if ids is None:
            ids = mapper.world.make_landmarks(keyframe, np.arange(60), points)
        else:
            mapper.world.attach(keyframe, np.arange(60), ids)
        mapper.optimise(keyframe)
    mapper.finish()
    poses = np.array([k.T_world_camera for k in mapper.world.keyframes.values()])
    T_world_plane = poses[0] @ T_camera_base
    if enabled:
        (T_world_plane,) = mapper.smoother.tables.keyframes.get(np.array([plane_id(0)]))
    T_plane_base = inverse(T_world_plane) @ poses @ T_camera_base
    return mapper, float(np.abs(T_plane_base[:, 2, 3]).max())


def test_keyframes_keep_their_height_where_motion_is_planar() -> None:
    (free, free_m), (held, held_m) = offs(False), offs(True)
    assert held_m < 0.002 < free_m
    assert not free.smoother.relative_poses(PLANAR)
    assert [f.name for f in held.smoother.relative_poses(PLANAR)] == [
        (plane_id(0), k, PLANAR) for k in range(8)
    ]
