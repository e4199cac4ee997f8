"""Frames move with their keyframes, also those of culled keyframes."""

import numpy as np
from synthetic_view import add_keyframe, make_features

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import inverse, se3_exp
from bmask_slam.world.frame_history import FrameHistory
from bmask_slam.world.world_map import WorldMap

RNG = np.random.default_rng(6)
NO_FEATURES = make_features(np.eye(4), np.zeros((0, 3)), np.zeros((0, 8), np.uint64))


def random_poses(count: int) -> Array:
    return se3_exp(RNG.normal(size=(count, 6)))


def world_of(poses: Array, segments: tuple[int, ...] = (0, 0, 0)) -> WorldMap:
    world = WorldMap()
    for T, segment in zip(poses, segments, strict=True):
        add_keyframe(world, T, NO_FEATURES, segment)
    return world


def test_frames_move_rigidly_with_their_keyframe() -> None:
    keyframe_poses, frames = random_poses(3), random_poses(6)
    world, history = world_of(keyframe_poses), FrameHistory()
    for i, T in enumerate(frames):
        history.append(i / 30, i // 2, keyframe_poses[i // 2], T)
    np.testing.assert_allclose(
        history.trajectories(world)[0].poses_world_camera, frames, atol=1e-12
    )
    corrections = random_poses(3)
    for keyframe, T_correction in zip(world.keyframes.values(), corrections, strict=True):
        keyframe.T_world_camera = T_correction @ keyframe.T_world_camera
    moved = history.trajectories(world)[0]
    expected = corrections[np.arange(6) // 2] @ frames
    np.testing.assert_allclose(moved.poses_world_camera, expected, atol=1e-12)
    np.testing.assert_allclose(moved.timestamps_s, np.arange(6) / 30)


def test_a_frame_is_relative_to_the_pose_its_keyframe_had_then() -> None:
    """The keyframe moved before the frame: its pose at the time of the frame is used."""
    (T_old, T_now, frame) = random_poses(3)
    world, history = world_of(T_old[None], (0,)), FrameHistory()
    world.keyframes[0].T_world_camera = T_now
    history.append(0.0, 0, T_now, frame)
    np.testing.assert_allclose(
        history.trajectories(world)[0].poses_world_camera[0], frame, atol=1e-12
    )


def test_a_chain_of_culled_keyframes_composes() -> None:
    """Keyframe 1 is culled for 2, later 2 for 0: no frame moves then; later all move with 0."""
    keyframe_poses, frames = random_poses(3), random_poses(9)
    world, history = world_of(keyframe_poses), FrameHistory()
    for i, T in enumerate(frames):
        history.append(i / 30, i % 3, keyframe_poses[i % 3], T)
    for culled, parent in ((1, 2), (2, 0)):
        T_parent_culled = inverse(keyframe_poses[parent]) @ keyframe_poses[culled]
        history.hand_over(culled, parent, T_parent_culled)
        del world.keyframes[culled]
        kept = history.trajectories(world)[0].poses_world_camera
        np.testing.assert_allclose(kept, frames, atol=1e-11)
    T_correction = random_poses(1)[0]
    world.keyframes[0].T_world_camera = T_correction @ world.keyframes[0].T_world_camera
    moved = history.trajectories(world)[0].poses_world_camera
    np.testing.assert_allclose(moved, T_correction @ frames, atol=1e-11)


def test_segments_are_separate_until_their_keyframes_are_joined() -> None:
    keyframe_poses, frames = random_poses(3), random_poses(3)
    world, history = world_of(keyframe_poses, (0, 0, 1)), FrameHistory()
    for i, T in enumerate(frames):
        history.append(i / 30, i, keyframe_poses[i], T)
    apart = history.trajectories(world)
    assert {s: len(t) for s, t in apart.items()} == {0: 2, 1: 1}
    np.testing.assert_allclose(apart[1].poses_world_camera[0], frames[2], atol=1e-12)
    world.keyframes[2].segment = 0
    assert {s: len(t) for s, t in history.trajectories(world).items()} == {0: 3}


def test_no_frames_give_no_trajectories() -> None:
    assert FrameHistory().trajectories(WorldMap()) == {}
