"""Frames move with their keyframes, also those of culled keyframes."""

import numpy as np
from synthetic_view import add_keyframe, make_features

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import inverse, make_pose, se3_exp
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.world.frame_history import NO_KEYFRAME, FrameHistory
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


def noisy_frames(history: FrameHistory, keyframe_poses: Array, count: int) -> Array:
    """Frames of a camera that moves steadily, with noise; returns the true positions (N, 3)."""
    draw = np.random.default_rng(8)
    path = np.arange(count)[:, None] * np.array([0.01, 0.0, 0.005])
    for i, place in enumerate(path):
        noise = draw.normal(size=6) * np.repeat([1e-3, 4e-3], 3)
        T_world_camera = make_pose(np.eye(3), place) @ se3_exp(noise)
        information = np.diag(np.repeat([1e6, 1 / 16e-6], 3))
        poses = keyframe_poses[i % 3], T_world_camera
        history.append(i / 30, i % 3, *poses, information if i else None)
    return path


def test_smoothed_frames_follow_their_keyframes_and_the_state() -> None:
    keyframe_poses = random_poses(3)
    world, history = world_of(keyframe_poses), FrameHistory()
    path = noisy_frames(history, keyframe_poses, 90)
    history.hand_over(1, 2, inverse(keyframe_poses[2]) @ keyframe_poses[1])
    del world.keyframes[1]
    before = history.trajectories(world)[0].poses_world_camera[:, :3, 3] - path
    again = FrameHistory()
    again.restore(history.state())
    history.smooth(world)
    after = history.trajectories(world)[0].poses_world_camera[:, :3, 3] - path
    assert np.abs(after).mean() < 0.5 * np.abs(before).mean()
    again.smooth(world)
    np.testing.assert_array_equal(
        again.state()["T_keyframe_camera"], history.state()["T_keyframe_camera"]
    )


def test_a_state_without_information_is_not_smoothed() -> None:
    keyframe_poses = random_poses(3)
    world, history = world_of(keyframe_poses), FrameHistory()
    noisy_frames(history, keyframe_poses, 90)
    history.restore(history.state() | {"information": np.zeros((0, 6, 6))})
    before = history.trajectories(world)[0].poses_world_camera
    history.smooth(world)
    np.testing.assert_allclose(
        history.trajectories(world)[0].poses_world_camera, before, atol=1e-12
    )


def test_frames_can_be_placed_by_their_stamps() -> None:
    keyframe_poses, frames = random_poses(3), random_poses(6)
    world, history = world_of(keyframe_poses, (0, 1, 1)), FrameHistory()
    for i, T in enumerate(frames):
        history.append(i / 30, i // 2, keyframe_poses[i // 2], T)
    placed = random_poses(3)
    history.place(world, Trajectory(np.array([1, 3, 8]) / 30, placed))
    frames[[1, 3]] = placed[:2]  # no frame has the third stamp
    for segment, rows in ((0, [0, 1]), (1, [2, 3, 4, 5])):
        found = history.trajectories(world)[segment].poses_world_camera
        np.testing.assert_allclose(found, frames[rows], atol=1e-12)


def test_the_largest_segment_is_that_of_most_frames() -> None:
    """Two keyframes have two frames, one that replaces a culled one has four."""
    keyframe_poses, frames = random_poses(4), random_poses(6)
    world, history = world_of(keyframe_poses, (0, 0, 1, 1)), FrameHistory()
    assert history.largest_segment(world) == world.largest_segment() == 0
    for i, keyframe in enumerate((0, 1, 2, 2, 3, 3)):
        history.append(i / 30, keyframe, keyframe_poses[keyframe], frames[i])
    history.hand_over(3, 2, np.eye(4))
    del world.keyframes[3]
    assert world.largest_segment() == 0 and history.largest_segment(world) == 1
    assert len(history.trajectories(world)[1]) == 4
    history.hand_over(2, NO_KEYFRAME, np.eye(4))
    assert history.largest_segment(world) == 0
