"""Messages of tracking to the map's process."""

from __future__ import annotations

from typing import Any

import numpy as np
from synthetic_view import CAMERA, render_plane

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.live.messages import (
    LostKeyframe,
    MapChanged,
    NewKeyframe,
    PruneMask,
    RestoreObservations,
    VisibilityCounts,
)
from bmask_slam.live.processes.map_process import MapServer
from bmask_slam.semantics.instances.instances import PackedMask
from bmask_slam.system import SlamSystem
from bmask_slam.tracking.results import untracked
from bmask_slam.world.frame_history import ENTRY, NO_KEYFRAME

NO_IDS = np.zeros(0, np.int64)


def keyframe(
    system: SlamSystem,
    number: int,
    reference: tuple[int, Array] | None,
    visibility: VisibilityCounts | None = None,
) -> NewKeyframe:
    T_world_camera = se3_exp(np.array([0, 0, 0, 0.02 * number, 0, 0]))
    frame = render_plane(T_world_camera, number)
    entries = np.array([(number / 30, number, np.eye(4))], ENTRY)
    return NewKeyframe(
        number,
        frame.index,
        frame.timestamp_s,
        untracked(T_world_camera, system.prepare(frame)),
        0,
        reference,
        NO_IDS,
        visibility or VisibilityCounts(NO_IDS, NO_IDS, NO_IDS),
        entries,
        frame.depth_m[::2, ::2],
    )


def test_a_segment_restarts_after_losing_its_first_keyframe() -> None:
    answers: list[Any] = []
    system = SlamSystem(CAMERA)
    server = MapServer(system, answers.append)
    nothing = np.zeros(0, ENTRY)
    server.handle(1, LostKeyframe(0, NO_KEYFRAME, np.eye(4), nothing, 500))
    server.handle(2, keyframe(system, 1, (0, np.eye(4))))  # made while the first was being lost
    counts = VisibilityCounts(np.arange(500), np.ones(500, int), np.ones(500, int))
    server.handle(3, keyframe(system, 2, None, counts))
    world = system.mapper.world
    assert list(world.keyframes) == [2]
    assert not world.landmarks.in_map[:500].any()
    assert world.landmarks.in_map.sum() > 100
    deltas = [answer.delta for answer in answers if isinstance(answer, MapChanged)]
    parents = {k: parent for delta in deltas for k, (parent, _) in delta.parents.items()}
    assert parents == {0: NO_KEYFRAME, 1: NO_KEYFRAME}
    trajectory = system.trajectory()
    assert trajectory.timestamps_s.tolist() == [2 / 30]  # those of the lost ones have no pose


def test_observations_removed_under_a_mask_are_restored() -> None:
    answers: list[Any] = []
    system = SlamSystem(CAMERA)
    server = MapServer(system, answers.append)
    server.handle(1, keyframe(system, 0, None))
    server.handle(2, keyframe(system, 1, (0, np.eye(4))))
    one, landmarks = system.mapper.world.keyframes[1], system.mapper.world.landmarks
    mask = np.zeros((CAMERA.height, CAMERA.width), bool)
    mask[100:300, 200:400] = True
    all_patches, next_id = landmarks.patches_of(one.landmark_ids), len(landmarks)
    server.handle(3, PruneMask(1, PackedMask.of(mask), 0))
    under = np.flatnonzero(one.masked)
    assert len(under) > 20
    server.handle(4, RestoreObservations(1, under, all_patches[under]))
    assert not one.masked.any()
    back = one.landmark_ids[under]
    with_depth = np.isfinite(one.features.depth_m[under])
    assert (back[with_depth] >= 0).all()
    assert landmarks.in_map[back[back >= 0]].all()
    made = back >= next_id
    assert made.any()
    np.testing.assert_array_equal(landmarks.patches[back[made]], all_patches.images[under[made]])
    assert np.isfinite(landmarks.patch_views[back[made]][:, 0]).all()
    delta = [answer for answer in answers if isinstance(answer, MapChanged)][-1].delta
    assert np.isin(back[back >= 0], delta.ids).all()
    server.handle(5, RestoreObservations(7, under, all_patches[under]))  # culled meanwhile
    server.handle(6, keyframe(system, 2, (1, one.T_world_camera)))
    assert list(system.mapper.world.keyframes) == [0, 1, 2]
