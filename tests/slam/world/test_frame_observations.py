"""What frames observe that are no keyframes: at most so many, evenly spread, saved and restored."""

from __future__ import annotations

import numpy as np
import pytest

from bmask_slam.world import frame_observations
from bmask_slam.world.frame_observations import FrameObservations


def filled(count: int) -> FrameObservations:
    """Frame k has stamp k and observes landmarks 0 to k % 4 - 1."""
    frames = FrameObservations()
    for k in range(count):
        ids = np.arange(k % 4)
        measured = np.full((len(ids), 3), k + 0.1)
        measured[:1, 2] = np.nan
        frames.append(float(k), ids, measured, np.full((len(ids), 3), 0.5))
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
            store.append(float(k), np.arange(2), np.ones((2, 3)), np.ones((2, 3)))
    assert stamps(frames) == stamps(again)
    for one, other in zip(frames.views, again.views, strict=True):
        np.testing.assert_array_equal(one.landmark_ids, other.landmark_ids)
        np.testing.assert_array_equal(one.measurements, other.measurements)
        np.testing.assert_array_equal(one.sigmas_px, other.sigmas_px)


def test_what_was_appended_may_be_changed_and_is_forgotten_if_cleared() -> None:
    frames, ids = FrameObservations(), np.arange(3)
    frames.append(0.0, ids, np.zeros((3, 3)), np.ones((3, 3)))
    ids += 7
    assert frames.views[0].landmark_ids.tolist() == [0, 1, 2]
    frames.clear()
    assert frames.views == []


def test_a_state_whose_lengths_do_not_agree_is_refused() -> None:
    state = filled(5).state()
    for name in ("measurements", "timestamps_s", "counts"):
        with pytest.raises(ValueError, match=r"rows|shorter|longer"):
            FrameObservations().restore({**state, name: state[name][:-1]})
