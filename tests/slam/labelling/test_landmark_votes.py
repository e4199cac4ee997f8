"""Keyframes vote on landmarks that are made later."""

from __future__ import annotations

import numpy as np
import pytest
from test_semantic_mapper import FRAMES, MANY_KEYFRAMES, Sides, estimates, right_share, run

from bmask_slam.labelling import landmark_votes as label_votes


def test_keyframes_vote_on_landmarks_made_later(monkeypatch: pytest.MonkeyPatch) -> None:
    """All recent keyframes that show the last keyframe's new landmarks vote on them."""
    views, shares = {}, {}
    for recent in (0, 3):
        monkeypatch.setattr(label_votes, "REMEMBERED", recent)
        system = run(Sides(FRAMES), MANY_KEYFRAMES)
        views[recent], shares[recent] = estimates(system).views, right_share(system)
        assert len(system.semantics._label_votes._remembered) == recent
    ids, world = system.landmarks().ids, system.mapper.world
    last = world.landmarks.host[ids] == max(world.keyframes)
    gained = views[3] - views[0]
    assert last.sum() > 50
    assert gained.min() == 0  # what was there from the start
    assert gained[last].min() >= 1
    assert gained[last].max() == 3
    assert min(shares.values()) > 0.995


def test_what_is_remembered_outlives_a_state_and_older_states_lack_surfaces() -> None:
    votes = run(Sides(FRAMES), MANY_KEYFRAMES).semantics._label_votes
    state = votes.state()
    assert len(state["coded"]) == len(state["keyframes"]) > 1
    votes.restore(state)
    again = votes.state()
    assert state.keys() == again.keys()
    for name, array in state.items():
        np.testing.assert_array_equal(again[name], array)
    older = {
        n: a for n, a in state.items() if n not in ("coded", "codes", "codes_shape", "cell_px")
    }
    votes.restore(older)
    assert not len(votes.state()["coded"])
    np.testing.assert_array_equal(votes.state()["owner"], state["owner"])
