"""The motion of a keyframe's instances by its masks and views."""

from __future__ import annotations

import numpy as np
import pytest

from bmask_slam.graph.arrays import Array, Floats
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import se3_exp, transform
from bmask_slam.moving.depth_view_buffer import PosedView
from bmask_slam.moving.free_space_check import FreeSpaceCheck, FreeSpaceCheckConfig, depth_view
from bmask_slam.moving.instance_motion import InstanceMotion, MotionState, motion_state
from bmask_slam.moving.keyframe_masks import KeyframeMasks
from bmask_slam.semantics.beliefs.movability import read_priors
from bmask_slam.semantics.beliefs.pixel_assignment import assign_pixels
from bmask_slam.semantics.beliefs.vote_config import VoteConfig
from bmask_slam.semantics.labels import label_set
from bmask_slam.semantics.tracks.instance_track import Track

CAMERA = Camera(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
NAMES = label_set(("person",))
POSE = se3_exp(np.array([0.1, -0.4, 0.2, 0.3, -0.2, 0.5]))
SIZE = (CAMERA.height, CAMERA.width)


def instance_motion() -> InstanceMotion:
    check = FreeSpaceCheck(CAMERA, CAMERA.noise_of_depth(0.1), FreeSpaceCheckConfig())
    return InstanceMotion(CAMERA, check, read_priors("movability"), 2.0, 20)


def masks(depth_m: Floats) -> KeyframeMasks:
    """Masks of a keyframe with depth at every fourth pixel and without instances."""
    assignment = assign_pixels([], depth_m, SIZE, VoteConfig())
    none = np.zeros(0, np.int64)
    here = 3, 0.0, 3, np.eye(4)
    return KeyframeMasks(*here, NAMES, assignment, depth_m, POSE, none, none, np.zeros((0, 2)))


def track(centre: Array) -> Track:
    """A track of an object half a metre deep with this centre in the camera frame."""
    (mean,) = transform(POSE, np.array([centre]))
    half_size, distribution = np.array([0.3, 0.9, 0.25]), np.array([0, 1], np.float32)
    state = np.r_[mean, 0, 0, 0], np.eye(6)
    return Track(0, 0.0, *state, half_size, distribution, 3.0, 0.0, 1)


@pytest.mark.parametrize(
    ("centre", "there_m", "shown"),
    [
        ((0.5, 0.2, 2.0), 2.0, True),
        ((0.5, 0.2, 2.0), 4.0, True),
        ((0.5, 0.2, 2.0), 1.6, False),
        ((0.5, 0.2, 2.0), np.nan, False),
        ((1.4, 0.2, 2.0), 4.0, False),
        ((0.5, 0.2, -2.0), 4.0, False),
    ],
)
def test_a_keyframe_observes_an_unoccluded_position(
    centre: tuple[float, float, float], there_m: float, shown: bool
) -> None:
    depth_m = np.full((120, 160), 4.0, np.float32)
    column, row = CAMERA.project(np.array([[0.5, 0.2, 2.0]]))[0] / 4
    depth_m[int(row) - 1 : int(row) + 2, int(column) - 1 : int(column) + 2] = there_m
    assert instance_motion().shows(masks(depth_m), track(np.array(centre))) is shown


@pytest.mark.parametrize(
    ("apart_s", "shift_m", "found"),
    [
        (0.1, 0.08, MotionState.UNKNOWN),  # 0.8 m/s: five sixths of its place were its own
        (0.1, 0.0, MotionState.UNKNOWN),
        (0.5, 0.0, MotionState.STATIC),
        (0.5, 0.4, MotionState.MOVING),
        (0.1, 0.4, MotionState.MOVING),
    ],
)
def test_what_moves_is_not_called_static_while_it_is_in_its_own_place(
    apart_s: float, shift_m: float, found: MotionState
) -> None:
    """A body half a metre wide, 2 m away and in front of a wall at 4 m."""
    x, y = np.meshgrid(np.linspace(-0.25, 0.25, 40), np.linspace(-0.5, 0.5, 40))
    body = np.stack([x, y, np.full_like(x, 2.0)], axis=-1).reshape(-1, 3)
    depth_m = np.full(SIZE, 4.0, np.float32)
    left, right = (int(CAMERA.project(np.array([[e, 0, 2.0]]))[0, 0]) for e in (-0.25, 0.25))
    depth_m[:, left - 3 : right + 3] = 2.0
    check = FreeSpaceCheck(CAMERA, CAMERA.noise_of_depth(0.1), FreeSpaceCheckConfig())
    view = depth_view(depth_m, check.config.window_px)
    before = [PosedView(0, 10.0, view, view, np.eye(4))]
    moved = body + np.array([shift_m, 0, 0])
    assert motion_state(moved, 10.0 + apart_s, before, check, 20) is found


def test_a_view_without_depth_observes_nothing() -> None:
    without_depth = masks(np.full((120, 160), np.nan, np.float32))
    assert not instance_motion().shows(without_depth, track(np.array([0.0, 0.0, 2.0])))
