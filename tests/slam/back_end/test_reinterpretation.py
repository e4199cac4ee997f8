"""Stored observations as a camera with another readout time and another depth delay gives them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic_view import (
    CAMERA,
    make_features,
    points_before,
    random_descriptors,
    render_plane,
)

from bmask_slam.back_end.reinterpretation import (
    KeyframeMotion,
    reinterpret,
    reinterpret_frames,
)
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import inverse, se3_exp, se3_log, transform
from bmask_slam.system import SlamSystem
from bmask_slam.world.frame_observations import FrameObservations, FrameView
from bmask_slam.world.keyframe import Keyframe

TWIST = np.array([0.5, -0.6, 0.4, 0.3, 0.2, -0.3])
READOUT_S = 0.025
ROLLING = replace(CAMERA, rolling_shutter_s=READOUT_S)


def exposed_keyframe() -> tuple[Keyframe, Array]:
    """A keyframe whose rows were exposed one by one, and its points at their mean row's time."""
    points_world = points_before(np.eye(4), 200, np.random.default_rng(1))
    later_s = np.zeros(len(points_world))
    for _ in range(5):
        T = se3_exp(later_s[:, None] * TWIST)
        points = transform(inverse(T), points_world[:, None])[:, 0]
        later_s = READOUT_S * CAMERA.share_of_rows(CAMERA.project(points)[:, 1])
    features = make_features(
        np.eye(4), points, random_descriptors(len(points), np.random.default_rng(0))
    )
    features = replace(features, image_pixels=CAMERA.distort(features.pixels))
    T_mean = se3_exp(later_s.mean() * TWIST)
    ids = np.full(len(points), -1, np.int64)
    return Keyframe(0, 0, 0.0, 0, np.eye(4), features, ids), transform(
        inverse(T_mean), points_world
    )


def as_view(keyframe: Keyframe, stamp_s: float) -> FrameView:
    """What a frame would keep of the same features."""
    frames, every = FrameObservations(), np.arange(len(keyframe.features))
    frames.append(stamp_s, keyframe.features, every, every)
    return frames.views[0]


def error_px(keyframe: Keyframe, points: Array) -> float:
    seen = keyframe.features
    np.testing.assert_allclose(seen.disparity_px * seen.depth_m, CAMERA.stereo_bf_px_m)
    u_right = seen.pixels[:, 0] - seen.disparity_px
    truth = CAMERA.project_stereo(points)
    return float(np.abs(np.column_stack([seen.pixels, u_right]) - truth).max())


def test_a_readout_time_that_is_found_later_corrects_keyframes() -> None:
    keyframe, points = exposed_keyframe()
    assert error_px(keyframe, points) > 3
    reinterpret(keyframe, KeyframeMotion(TWIST), CAMERA, ROLLING)
    assert error_px(keyframe, points) < 0.05
    twice = replace(CAMERA, rolling_shutter_s=2 * READOUT_S)
    reinterpret(keyframe, KeyframeMotion(TWIST), ROLLING, twice)
    assert error_px(keyframe, points) > 3


def test_the_correction_of_the_old_camera_is_undone() -> None:
    keyframe, _ = exposed_keyframe()
    before = keyframe.features
    reinterpret(keyframe, KeyframeMotion(TWIST), CAMERA, ROLLING)
    assert np.abs(keyframe.features.depth_m - before.depth_m).max() > 1e-3
    reinterpret(keyframe, KeyframeMotion(TWIST), ROLLING, CAMERA)
    np.testing.assert_allclose(keyframe.features.pixels, before.pixels, atol=1e-6)
    np.testing.assert_allclose(keyframe.features.depth_m, before.depth_m, atol=2e-4)


def test_inverse_depth_changes_by_what_the_delay_did_and_no_more_than_is_possible() -> None:
    keyframe, _ = exposed_keyframe()
    before_m = keyframe.features.depth_m.copy()
    change = np.array([0.01, -0.02, 10.0, np.nan]) / before_m[:4]
    reinterpret(keyframe, KeyframeMotion(TWIST, np.arange(4), change), CAMERA, CAMERA)
    after_m = keyframe.features.depth_m
    np.testing.assert_allclose(1 / after_m[:2], 1 / before_m[:2] + change[:2])
    np.testing.assert_array_equal(after_m[2:], before_m[2:])
    assert before_m[0] == pytest.approx(after_m[0] * 1.01)


def test_a_bend_of_depth_that_is_found_later_is_taken_out_at_each_keypoint() -> None:
    keyframe, _ = exposed_keyframe()
    before_m, pixels = keyframe.features.depth_m.copy(), keyframe.features.image_pixels
    bent = replace(CAMERA, depth_distortion=(0.004, -0.006, 0.010, 0.014, -0.005))
    reinterpret(keyframe, KeyframeMotion(TWIST), CAMERA, bent)
    bend = 1 / before_m - 1 / keyframe.features.depth_m
    np.testing.assert_allclose(bend, bent.depth_bend(pixels), atol=1e-9)
    assert np.ptp(bend) > 5e-3
    reinterpret(keyframe, KeyframeMotion(TWIST), bent, CAMERA)
    np.testing.assert_allclose(keyframe.features.depth_m, before_m)


def test_frames_are_interpreted_anew_like_keyframes_and_dropped_if_their_motion_is_unknown() -> (
    None
):
    keyframe, _ = exposed_keyframe()
    frames = FrameObservations()
    frames.views = [as_view(keyframe, stamp_s) for stamp_s in (1.0, 2.0)]
    motion = KeyframeMotion(TWIST, np.array([3, 5]), np.array([0.01, -0.02]))
    reinterpret_frames(frames, {2.0: motion}, CAMERA, ROLLING)
    reinterpret(keyframe, motion, CAMERA, ROLLING)
    (view,) = frames.views
    assert view.timestamp_s == 2.0
    seen = view.features(CAMERA.stereo_bf_px_m)
    for name in ("pixels", "depth_m", "disparity_px"):
        expected = getattr(keyframe.features, name)
        np.testing.assert_allclose(getattr(seen, name), expected, rtol=1e-5, err_msg=name)


def test_the_keyframe_that_begins_a_map_in_motion_is_not_bent() -> None:
    """Rendered row by row; the second frame tells how the camera moved during the first."""
    twist = np.array([0.3, -1.2, 0.2, 0.1, 0.1, 0.0])
    rows_s = READOUT_S * CAMERA.share_of_rows(np.arange(480.0))
    frames = [render_plane(se3_exp((k / 30 + rows_s)[:, None] * twist), k) for k in range(3)]
    system = SlamSystem(ROLLING)

    def unevenness_m() -> float:
        """Of the plane's landmarks; the map's frame is that of the mean row, wherever that is."""
        landmarks = system.map.world.landmarks
        points = landmarks.points_world[landmarks.in_map]
        return float(np.linalg.svd(points - points.mean(0))[1][2] / len(points) ** 0.5)

    system.process(frames[0])
    assert unevenness_m() > 0.005
    second = system.process(frames[1]).T_world_camera
    assert unevenness_m() < 0.001
    T = se3_exp(twist / 30)  # in the frame of the first
    assert second is not None
    turned, moved = np.split(np.abs(se3_log(inverse(np.asarray(T)) @ second)), 2)
    assert turned.max() < 0.001 and moved.max() < 0.002
    observed, sent = system.map.world.keyframes[0].features, system.frame_observations.views
    system.process(frames[2])
    assert system.map.world.keyframes[0].features is observed  # once
    assert len(sent) == 2
