"""A replica updated by deltas equals the owner's map."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from synthetic_view import CAMERA, render_plane

from bmask_slam.config.configuration import resolve
from bmask_slam.graph.arrays import Ints, digest_rows
from bmask_slam.graph.geometry import inverse, se3_exp, transform
from bmask_slam.live.replica import (
    COLUMNS,
    COUNTED,
    DeltaMaker,
    UntoldCounts,
    apply_delta,
    landmarks_ahead,
)
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.world.frame_history import FrameHistory
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.world_map import WorldMap

SETTINGS = [  # a keyframe nearly every frame, and most of them culled again
    *("keyframes.min_interval_frames=1", "keyframes.max_shared=2.0"),
    *("mapping.redundant_share=0.3", "mapping.redundant_views=2"),
]


def equal(copy: WorldMap, world: WorldMap) -> None:
    in_map = world.landmarks.in_map
    assert copy.keyframes.keys() == world.keyframes.keys()
    np.testing.assert_array_equal(copy.landmarks.in_map, in_map)
    np.testing.assert_array_equal(copy.landmarks.replaced_by, world.landmarks.replaced_by)
    for name in ("points_world", *COLUMNS):
        here, there = getattr(copy.landmarks, name)[in_map], getattr(world.landmarks, name)[in_map]
        np.testing.assert_array_equal(here, there, err_msg=name)
    for key, keyframe in world.keyframes.items():
        other = copy.keyframes[key]
        np.testing.assert_array_equal(other.T_world_camera, keyframe.T_world_camera)
        np.testing.assert_array_equal(other.landmark_ids, keyframe.landmark_ids)
        np.testing.assert_array_equal(other.masked, keyframe.masked)
        assert (other.segment, other.timestamp_s) == (keyframe.segment, keyframe.timestamp_s)


@pytest.fixture(scope="module")
def followed() -> tuple[SlamSystem, WorldMap, FrameHistory, list[int]]:
    """A system, its replica updated after every frame, and the sizes of the deltas."""
    system = SlamSystem(CAMERA, resolve(SystemConfig, None, SETTINGS))
    maker, copy, history, sizes = DeltaMaker(), WorldMap(), FrameHistory(), []
    x = np.concatenate([np.arange(12), np.arange(12)[::-1]]) * 0.03
    for index, shift in enumerate(x):
        system.process(render_plane(se3_exp(np.array([0, 0, 0, shift, 0, 0])), index))
        if index == 8:
            observed = system.mapper.world.observed(
                list(system.mapper.world.keyframes.values())[-1]
            )
            system.mapper.prune_landmarks(observed[1][:20])
        sent = pickle.dumps(maker.delta(system.mapper.world, system.mapper.history))
        sizes.append(len(sent))
        apply_delta(pickle.loads(sent), copy, history)
        equal(copy, system.mapper.world)
    return system, copy, history, sizes


def test_the_replica_covers_every_map_change(followed) -> None:
    system, copy, history, _ = followed
    assert len(copy.keyframes) >= 3
    assert (copy.landmarks.replaced_by >= 0).any(), "nothing was fused"
    assert history.parents, "no keyframe was culled"
    for culled in history.parents:
        assert history.parent(culled)[0] == system.mapper.history.parent(culled)[0]
        np.testing.assert_array_equal(
            history.parent(culled)[1], system.mapper.history.parent(culled)[1]
        )


def test_an_empty_delta_is_small(followed) -> None:
    system, *_ = followed
    maker = DeltaMaker()
    first = maker.delta(system.mapper.world, system.mapper.history)
    second = maker.delta(system.mapper.world, system.mapper.history)
    assert len(first.ids) == system.mapper.world.landmarks.in_map.sum()
    assert len(second.ids) == 0
    assert not second.rows
    assert not second.parents
    assert second.replaced_by is None
    assert len(pickle.dumps(second)) < 0.2 * len(pickle.dumps(first))


def test_a_copy_goes_on_counting_what_frames_see(followed) -> None:
    """A keyframe is made where few of the landmarks that are often found are found again."""
    system, *_ = followed
    world, copy, counts = system.mapper.world, WorldMap(), UntoldCounts(anew=False)

    def update() -> Ints:
        new = apply_delta(DeltaMaker().delta(world, system.mapper.history), copy, FrameHistory())
        counts.are_known(new, copy.landmarks)
        return new

    new = update()
    for name in COUNTED:
        here, there = (getattr(w.landmarks, name)[new] for w in (copy, world))
        np.testing.assert_array_equal(here, there)
        assert here.min() >= 1
    assert len(counts.take(copy.landmarks)[0]) == 0
    seen, before = new[:50], copy.landmarks.visible[new[:50]].copy()
    copy.landmarks.visible[seen] += 3
    copy.landmarks.found[seen] += 1
    assert len(update()) == 0
    ids, visible, found = counts.take(copy.landmarks)
    np.testing.assert_array_equal(ids, seen)
    assert set(visible) == {3} and set(found) == {1}
    assert len(counts.take(copy.landmarks)[0]) == 0
    np.testing.assert_array_equal(copy.landmarks.visible[seen], before + 3)


def test_counts_that_begin_anew_are_told_as_well(followed) -> None:
    system, *_ = followed
    copy, counts = WorldMap(), UntoldCounts(anew=True)
    history = system.mapper.history
    new = apply_delta(DeltaMaker().delta(system.mapper.world, history), copy, FrameHistory())
    counts.are_known(new, copy.landmarks)
    assert not copy.landmarks.visible.any()
    copy.landmarks.visible[new[:50]] += 3
    copy.landmarks.found[new[:50]] += 1
    ids, visible, found = counts.take(copy.landmarks)
    np.testing.assert_array_equal(ids, new[:50])
    assert set(visible) == {3} and set(found) == {1}
    assert not copy.landmarks.visible.any() and not copy.landmarks.found.any()


def test_keyframes_unknown_to_the_owner_move_with_the_others(followed) -> None:
    system, *_ = followed
    world, copy, history = system.mapper.world, WorldMap(), FrameHistory()
    apply_delta(DeltaMaker().delta(world, system.mapper.history), copy, history)
    newest = list(copy.keyframes.values())[-1]
    ahead = se3_exp(np.array([0.1, 0, 0, 0.2, 0, 0]))
    features = system.prepare(render_plane(np.eye(4)))
    none = np.full(len(features), -1)
    T_world_pending = newest.T_world_camera @ ahead
    pending = Keyframe(copy.next_keyframe_id, 99, 9.9, 0, T_world_pending, features, none)
    copy.add_keyframe(pending)
    ids, reserved = landmarks_ahead(copy, pending, CAMERA, system.config.tracking.subpixel)
    assert reserved == (len(world.landmarks), len(world.landmarks) + len(features))
    ids = ids[ids >= 0]
    assert len(ids) > 100 and (ids >= len(world.landmarks)).all()
    points_camera = transform(inverse(T_world_pending), copy.landmarks.points_world[ids])
    moved = se3_exp(np.array([0, 0.3, 0, 1.0, -2.0, 0.5]))
    for keyframe in world.keyframes.values():
        keyframe.T_world_camera = moved @ keyframe.T_world_camera
    apply_delta(DeltaMaker().delta(world, system.mapper.history), copy, history)
    expected = world.keyframes[newest.id].T_world_camera @ ahead
    np.testing.assert_allclose(copy.keyframes[pending.id].T_world_camera, expected, atol=1e-12)
    assert copy.landmarks.in_map[ids].all()
    points_world = copy.landmarks.points_world[ids]
    np.testing.assert_allclose(points_world, transform(expected, points_camera), atol=1e-9)
    equal_rows = copy.landmarks.in_map[: len(world.landmarks)] == world.landmarks.in_map
    assert equal_rows.all()
    assert copy.next_keyframe_id == pending.id + 1


def test_an_owner_restarted_from_an_older_state_is_followed() -> None:
    """It has fewer landmarks, and keyframes that had been culled; tracking's ids stay valid."""
    system = SlamSystem(CAMERA, resolve(SystemConfig, None, SETTINGS))
    world, frames = system.mapper.world, system.mapper.history
    before, after = DeltaMaker(), DeltaMaker()
    copy, history, older = WorldMap(), FrameHistory(), b""
    for index, shift in enumerate(np.concatenate([np.arange(8), np.arange(8)[::-1]]) * 0.03):
        system.process(render_plane(se3_exp(np.array([0, 0, 0, shift, 0, 0])), index))
        apply_delta(before.delta(world, frames), copy, history)
        if index == 6:
            older, known = pickle.dumps(after.delta(world, frames)), set(world.keyframes)
    size, culled = len(copy.landmarks), known - copy.keyframes.keys()
    assert culled and len(pickle.loads(older).in_map) * 8 < size
    table, first = copy.landmarks, pickle.loads(older).size
    again = table.in_map & (table.host >= pickle.loads(older).next_keyframe_id)
    again[:first] = False
    table.spare = np.flatnonzero(again)[:3]  # as if the owner had made these itself
    again[table.spare] = False
    assert again.sum() > 10 and table.in_map[first:].sum() > again.sum()
    apply_delta(pickle.loads(older), copy, history)
    assert len(table) == size
    np.testing.assert_array_equal(table.in_map[first:], again[first:])
    assert culled < copy.keyframes.keys()
    assert all(history.parent(keyframe_id)[0] == keyframe_id for keyframe_id in culled)
    apply_delta(after.delta(world, frames), copy, history)
    equal(copy, world)
    assert all(history.parent(k)[0] == frames.parent(k)[0] for k in culled)


def test_digests_tell_rows_apart() -> None:
    rng = np.random.default_rng(3)
    columns = [rng.normal(size=(50, 4, 3)), np.arange(50, dtype=np.int32), rng.normal(size=(50, 3))]
    columns[0][7, 2] = np.nan  # a patch that is not there
    digests = digest_rows(columns)
    assert len(np.unique(digests)) == 50
    np.testing.assert_array_equal(digest_rows([c.copy() for c in columns]), digests)
    for column in columns:
        changed = [c.copy() if c is column else c for c in columns]
        altered = next(c for c, old in zip(changed, columns, strict=True) if c is not old)
        altered[20:22] = -altered[20:22]  # two signs: they must not cancel
        assert np.flatnonzero(digest_rows(changed) != digests).tolist() == [20, 21]
    assert len(digest_rows([c[:0] for c in columns])) == 0


def test_only_what_changed_is_sent(followed) -> None:
    """A second reader does not hide changes from the first."""
    system, *_ = followed
    world, history = system.mapper.world, system.mapper.history
    first, second = DeltaMaker(), DeltaMaker()
    first.delta(world, history)
    second.delta(world, history)
    moved, seen, coloured = np.flatnonzero(world.landmarks.in_map)[[3, 5, 7]]
    world.landmarks.points_world[moved] += 1e-9
    world.landmarks.observations[seen] += 1
    world.landmarks.colours[coloured] = 7
    keyframe = list(world.keyframes.values())[-1]
    world.unmask(keyframe, np.arange(1))
    for maker in (first, second):
        delta = maker.delta(world, history)
        assert delta.moved.tolist() == [moved]
        assert delta.ids.tolist() == sorted([seen, coloured])
        assert list(delta.rows) == [keyframe.id]
    world.landmarks.observations[seen] -= 1
