"""Instances excluded by class only, and reinstated when they are verified as static."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic_view import CAMERA

from bmask_slam.features.brisk import Features
from bmask_slam.graph.arrays import Array, Arrays
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.labelling.label_views import FIRST_LABEL_VIEW
from bmask_slam.moving.depth_view_buffer import PosedView
from bmask_slam.moving.free_space_check import FreeSpaceCheck, FreeSpaceCheckConfig, depth_view
from bmask_slam.moving.keyframe_masks import KeyframeMasks, surfaces
from bmask_slam.moving.static_verification import StaticVerification, StaticVerificationConfig
from bmask_slam.semantics.beliefs.pixel_assignment import assign_pixels
from bmask_slam.semantics.beliefs.vote_config import VoteConfig
from bmask_slam.semantics.instances.instances import Instance, certain
from bmask_slam.semantics.labels import label_set
from bmask_slam.semantics.tracks.instance_track import Track
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.world_map import WorldMap

NAMES = label_set(("person",))
WALL_M, BODY_M = 3.0, 2.0
TOP, LEFT, SIDE = 120, 200, 160
CHECK = FreeSpaceCheck(CAMERA, CAMERA.noise_of_depth(), FreeSpaceCheckConfig())
CONFIG = StaticVerificationConfig(stands_s=0.4)


def depth(left: int = LEFT, body_m: float = BODY_M) -> Array:
    """A body before a wall."""
    found = np.full((CAMERA.height, CAMERA.width), WALL_M, np.float32)
    found[TOP : TOP + SIDE, left : left + SIDE] = body_m
    return found


def masks_of(left: int = LEFT, keyframe_id: int = 0) -> KeyframeMasks:
    mask = depth(left) < WALL_M
    body = Instance(mask, np.zeros(4), 1, certain(1, 2, 0.9), 0.9, 0.9)
    thinned = depth(left)[::2, ::2].copy()
    assignment = assign_pixels([body], thinned, mask.shape, VoteConfig())
    none = np.zeros(0, np.int64)
    here = keyframe_id, keyframe(keyframe_id).timestamp_s, keyframe_id, np.eye(4)
    return KeyframeMasks(*here, NAMES, assignment, thinned, np.eye(4), none, none, np.eye(2)[:0])


def keyframe(keyframe_id: int = 0) -> Keyframe:
    """Three keypoints on the body, one on the wall."""
    pixels = np.array([[210.0, 130.0], [280.0, 200.0], [350.0, 270.0], [600.0, 30.0]])
    n = len(pixels)
    features = Features(
        pixels=pixels,
        image_pixels=pixels,
        descriptors=np.zeros((n, 8), np.uint64),
        scales=np.ones(n),
        angles_rad=np.zeros(n),
        depth_m=np.full(n, BODY_M),
        disparity_px=np.full(n, 10.0),
        sigmas_px=np.ones((n, 3)),
        colours=np.zeros((n, 3), np.uint8),
        gray=np.zeros((0, 0), np.uint8),
    )
    ids = np.full(n, -1, np.int64)
    return Keyframe(keyframe_id, 0, 0.1 * keyframe_id, 0, np.eye(4), features, ids)


def track(track_id: int = 7) -> Track:
    state = np.zeros(6), np.eye(6)
    return Track(track_id, 0.0, *state, np.full(3, 0.3), certain(1, 2, 0.9), 2.9, 0.0, 1)


def watching(config: StaticVerificationConfig = CONFIG) -> tuple[StaticVerification, WorldMap]:
    """Verification of a person observed by keyframe 0."""
    static_verification, world = StaticVerification(CHECK, config, 20, 5), WorldMap()
    world.add_keyframe(keyframe())
    add(static_verification, world, masks_of(), track())
    return static_verification, world


def add(
    static_verification: StaticVerification, world: WorldMap, masks: KeyframeMasks, of_track: Track
) -> None:
    static_verification.add(
        masks, surfaces(CAMERA, masks, CHECK.config.window_px, 20), [of_track], world
    )


def verified(
    static_verification: StaticVerification, world: WorldMap, images: list[Array], hz: float = 30
) -> list[int]:
    """The frames in which an instance is verified as static."""
    views = [depth_view(image, CHECK.config.window_px) for image in images]
    return [
        k
        for k, view in enumerate(views)
        if static_verification.verify((k + 1) / hz, view, np.eye(4), world)
    ]


def test_a_static_instance_is_verified_after_a_while() -> None:
    static_verification, world = watching()
    assert verified(static_verification, world, [depth()] * 30) == [13]  # 0.4 s and two frames more
    assert static_verification.pending == []


def test_an_instance_of_a_label_view_is_verified_where_that_saw_it() -> None:
    """The keyframe that it is near was elsewhere, and has no observations of it to restore."""
    static_verification, world = StaticVerification(CHECK, CONFIG, 20, 5), WorldMap()
    world.add_keyframe(replace(keyframe(), T_world_camera=se3_exp(np.array([0, 0, 0, -1.0, 0, 0]))))
    T_anchor_camera = se3_exp(np.array([0, 0, 0, 1.0, 0, 0]))
    view = replace(masks_of(), keyframe_id=FIRST_LABEL_VIEW, T_anchor_camera=T_anchor_camera)
    add(static_verification, world, view, track())
    assert static_verification.pending[0].removed == ()
    assert verified(static_verification, world, [depth()] * 30) == [13]


@pytest.mark.parametrize(
    "images",
    [
        [depth(LEFT + 3 * k) for k in range(30)],
        [depth(body_m=BODY_M + 0.008 * k) for k in range(30)],
        [depth(body_m=BODY_M - 0.008 * k) for k in range(30)],
    ],
    ids=["sideways", "away", "near"],
)
def test_a_slow_walker_is_not_verified(images: list[Array]) -> None:
    static_verification, world = watching()
    assert verified(static_verification, world, images) == []


def test_noise_and_missing_depth_do_not_prevent_verification() -> None:
    rng = np.random.default_rng(0)
    images = []
    for _ in range(20):
        image = depth() + rng.normal(0, 0.01, depth().shape).astype(np.float32)
        image[rng.random(image.shape) < 0.001] = np.nan
        images.append(image)
    static_verification, world = watching()
    assert verified(static_verification, world, images) == [13]


def test_removed_observations_are_listed_without_those_under_another_mask() -> None:
    static_verification, world = watching()
    (removed,) = static_verification.pending[0].removed
    assert removed.keypoints.tolist() == [0, 1, 2]
    np.testing.assert_array_equal(removed.mask.unpacked(), depth() < WALL_M)
    assert static_verification.not_pending(removed).tolist() == [False] * 3
    view = depth_view(depth(), CHECK.config.window_px)
    for time_s in (0.5, 0.6):
        assert not static_verification.verify(time_s, view, np.eye(4), world)
    (found,) = static_verification.verify(0.7, view, np.eye(4), world)
    assert static_verification.not_pending(found.removed[0]).tolist() == [True] * 3


def test_verification_counts_from_the_first_observation_unless_it_moved() -> None:
    for moved, since_s, expected in ((False, 0.0, 2), (True, 0.1, 1)):
        static_verification, world = watching()
        world.add_keyframe(keyframe(1))
        if moved:
            verified(static_verification, world, [depth(400)] * 15)
        add(static_verification, world, masks_of(keyframe_id=1), track())
        (one,) = static_verification.pending
        assert (one.time_s, len(one.removed)) == (since_s, expected)


def test_pending_instances_out_of_view_or_culled_are_dropped() -> None:
    static_verification, world = watching()
    turned = np.eye(4)
    turned[:3, :3] = np.diag([-1, 1, -1])
    view = depth_view(depth(), CHECK.config.window_px)
    for k in range(80):
        assert not static_verification.verify(0.5 + 0.03 * k, view, turned, world)
    assert len(static_verification.pending) == 1
    assert not static_verification.verify(3.1, view, turned, world)
    assert static_verification.pending == []
    static_verification, _ = watching()
    assert not static_verification.verify(0.5, view, np.eye(4), WorldMap())
    assert static_verification.pending == []


def test_a_restored_state_continues_identically() -> None:
    static_verification, world = watching()
    world.add_keyframe(keyframe(1))
    add(static_verification, world, masks_of(400, 1), track(9))
    verified(static_verification, world, [depth()] * 13)
    other = StaticVerification(CHECK, CONFIG, 20, 5)
    other.restore(static_verification.state())
    same(other.state(), static_verification.state())
    assert [s.track_id for s in other.pending] == [7, 9]
    assert [s.static_views for s in other.pending] == [2, 0]
    view = depth_view(depth(), CHECK.config.window_px)
    for one in (other, static_verification):
        (found,) = one.verify(14 / 30, view, np.eye(4), world)
        assert found.removed[0].keypoints.tolist() == [0, 1, 2]
    empty = StaticVerification(CHECK, CONFIG, 20, 5)
    other.restore(empty.state())
    assert other.pending == []


@pytest.mark.parametrize(
    ("left", "body_m", "from_s", "stood"),
    [
        (LEFT, BODY_M, -1.0, True),
        (LEFT, BODY_M, 0.4, True),
        (LEFT, BODY_M, -0.3, False),
        (LEFT + 40, BODY_M, -1.0, False),
        (LEFT, BODY_M + 0.05, -1.0, False),
        (LEFT, 0.6 * BODY_M, -1.0, False),
    ],
    ids=["before", "after", "too-recent", "sideways", "away", "hidden"],
)
def test_earlier_or_later_frames_verify_an_instance(
    left: int, body_m: float, from_s: float, stood: bool
) -> None:
    static_verification, now_s, masks = StaticVerification(CHECK, CONFIG, 20, 5), 5.0, masks_of()
    visible = [*surfaces(CAMERA, masks, CHECK.config.window_px, 20), None]
    view = depth_view(depth(left, body_m), CHECK.config.window_px)
    views = [PosedView(0, now_s + from_s + 0.1 * k, view, view, np.eye(4)) for k in range(5)]
    assert static_verification.stood(masks, visible, views, now_s) == [stood, False]
    switched_off = StaticVerification(CHECK, StaticVerificationConfig(stands_s=0), 20, 5)
    assert switched_off.stood(masks, visible, views, now_s) == [False, False]


def same(a: Arrays, b: Arrays) -> None:
    assert a.keys() == b.keys()
    for key in a:
        np.testing.assert_array_equal(a[key], b[key], err_msg=key)


def test_without_verification_nothing_is_pending() -> None:
    static_verification, _ = watching(StaticVerificationConfig(stands_s=0))
    assert static_verification.pending == []


def test_impossible_values_are_rejected() -> None:
    for wrong in (
        {"stands_s": -1},
        {"share": 0},
        {"shift_m": 0},
        {"frames": 0},
        {"patience_s": 0},
        {"recent": 0},
        {"interval_s": 0},
    ):
        with pytest.raises(ValueError, match="must"):
            StaticVerificationConfig(**wrong)
