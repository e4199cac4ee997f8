"""Keyframes vote on landmarks that are made later."""

from __future__ import annotations

import pytest
from test_semantic_mapper import FRAMES, MANY_KEYFRAMES, Sides, estimates, right_share, run

from bmask_slam.labelling import landmark_votes as label_votes


def test_keyframes_vote_on_landmarks_made_later(monkeypatch: pytest.MonkeyPatch) -> None:
    """All recent keyframes that show the last keyframe's new landmarks vote on them."""
    views, shares = {}, {}
    for recent in (0, 3):
        monkeypatch.setattr(label_votes, "RECENT", recent)
        system = run(Sides(FRAMES), MANY_KEYFRAMES)
        views[recent], shares[recent] = estimates(system).views, right_share(system)
        assert len(system.semantics._label_votes._recent) == recent
    ids, world = system.landmarks().ids, system.mapper.world
    last = world.landmarks.host[ids] == max(world.keyframes)
    gained = views[3] - views[0]
    assert last.sum() > 50
    assert gained.min() == 0  # what was there from the start
    assert gained[last].min() >= 1
    assert gained[last].max() == 3
    assert min(shares.values()) > 0.995
