"""What frames observe that are no keyframes: at most so many, evenly spread, saved and restored."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_view import CAMERA, make_features, points_before, random_descriptors

from bmask_slam.world import frame_observations
from bmask_slam.world.frame_observations import FrameObservations

FEATURES = make_features(
    np.eye(4),
    points_before(np.eye(4), 12, np.random.default_rng(1)),
    random_descriptors(12, np.random.default_rng(2)),
)
FEATURES.depth_m[3] = FEATURES.disparity_px[3] = np.nan


def filled(count: int) -> FrameObservations:
    """Frame k has stamp k, and its keypoints 3 to 3 + k % 4 - 1 observe landmarks from 0 on."""
    frames = FrameObservations()
    for k in range(count):
        ids = np.arange(k % 4)
        frames.append(float(k), FEATURES, 3 + ids, ids)
    return frames


def stamps(frames: FrameObservations) -> list[float]:
    return [view.timestamp_s for view in frames.views]


def test_frames_of_a_long_run_are_thinned_evenly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frame_observations, "MAX_FRAMES", 10)
    for count in (10, 11, 25, 200):
        kept = stamps(filled(count))
        assert len(kept) <= 10
        steps = np.unique(np.diff(kept))
        assert len(steps) == 1
        assert kept[0] < steps[0]
        assert count - kept[-1] <= steps[0]
    assert len(stamps(filled(200))) > 5


@pytest.mark.parametrize("count", [0, 1, 25])
def test_a_restored_store_goes_on_as_the_first(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frame_observations, "MAX_FRAMES", 10)
    frames, again = filled(count), FrameObservations()
    again.restore(frames.state())
    for store in (frames, again):
        for k in range(count, count + 9):
            store.append(float(k), FEATURES, np.arange(2), np.arange(2))
    assert stamps(frames) == stamps(again)
    for one, other in zip(frames.views, again.views, strict=True):
        np.testing.assert_array_equal(one.landmark_ids, other.landmark_ids)
        np.testing.assert_array_equal(one.columns, other.columns)


def test_a_view_has_the_features_that_observe_something() -> None:
    view = filled(4).views[3]
    seen = view.features(CAMERA.stereo_bf_px_m)
    for name in ("pixels", "image_pixels", "depth_m", "disparity_px", "sigmas_px"):
        expected = getattr(FEATURES, name)[3:6]
        np.testing.assert_allclose(getattr(seen, name), expected, rtol=1e-6, err_msg=name)
    assert np.isnan(seen.depth_m[0])
    again = view.seen_as(seen)
    np.testing.assert_array_equal(again.columns, view.columns)
    assert again.landmark_ids is view.landmark_ids


def test_what_was_appended_may_be_changed_and_is_forgotten_if_cleared() -> None:
    frames, ids = FrameObservations(), np.arange(3)
    frames.append(0.0, FEATURES, np.arange(3), ids)
    ids += 7
    assert frames.views[0].landmark_ids.tolist() == [0, 1, 2]
    frames.clear()
    assert frames.views == []


def test_a_state_whose_lengths_do_not_agree_is_refused() -> None:
    state = filled(5).state()
    for name in ("columns", "timestamps_s", "counts"):
        with pytest.raises(ValueError, match=r"rows|shorter|longer"):
            FrameObservations().restore({**state, name: state[name][:-1]})
