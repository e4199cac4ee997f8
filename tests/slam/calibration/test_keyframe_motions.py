"""By what frames that are no keyframes are interpreted anew: their path's velocity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from synthetic_view import CAMERA, make_features, points_before, random_descriptors

from bmask_slam.calibration.keyframe_motions import frame_motions, motions_without_images
from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.world.frame_observations import FrameObservations

TWIST = np.array([0.1, -0.2, 0.3, 0.4, 0.1, -0.2])
STAMPS_S = np.arange(10) / 30
PATH = Trajectory(STAMPS_S, se3_exp(STAMPS_S[:, None] * TWIST))


def frames_at(*stamps_s: float) -> FrameObservations:
    rng = np.random.default_rng(3)
    points = points_before(np.eye(4), 6, rng)
    features = make_features(np.eye(4), points, random_descriptors(6, rng))
    frames, every = FrameObservations(), np.arange(6)
    for stamp_s in stamps_s:
        frames.append(stamp_s, features, every, every)
    return frames


def test_frames_on_a_path_have_its_velocity_and_others_none() -> None:
    stamps = STAMPS_S[4], STAMPS_S[7], 0.5
    found = frame_motions(frames_at(*stamps), {0: PATH}, None)
    assert found.keys() == {STAMPS_S[4], STAMPS_S[7]}
    for motion in found.values():
        np.testing.assert_allclose(motion.twist, TWIST, atol=1e-6)
        assert len(motion.keypoints) == 0


def test_depths_change_by_the_images_at_the_keypoints() -> None:
    def change(stamp_s: float, pixels: Array) -> tuple[Ints, Array]:
        return np.arange(len(pixels)), stamp_s + pixels[:, 0]

    frames = frames_at(STAMPS_S[4])
    found = frame_motions(frames, {0: PATH}, change)[STAMPS_S[4]]
    expected = STAMPS_S[4] + frames.views[0].columns[:, 2].astype(float)
    np.testing.assert_allclose(found.inverse_depth_change, expected)


def test_without_images_another_delay_of_depth_makes_frames_unknown() -> None:
    frames, paths = frames_at(STAMPS_S[4]), {0: PATH}
    readout = replace(CAMERA, rolling_shutter_s=0.02)
    assert list(motions_without_images(frames, paths, CAMERA, readout)) == [STAMPS_S[4]]
    late = replace(readout, depth_time_offset_s=-0.01)
    assert motions_without_images(frames, paths, CAMERA, late) == {}
