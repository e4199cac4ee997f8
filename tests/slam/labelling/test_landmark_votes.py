"""Keyframes vote on landmarks that are made later."""

from __future__ import annotations

import numpy as np
import pytest
from test_semantic_mapper import (
    CAMERA,
    FILE,
    FRAMES,
    MANY_KEYFRAMES,
    Sides,
    estimates,
    right_share,
    run,
)

from bmask_slam.labelling import remembered_masks
from bmask_slam.labelling.landmark_votes import LabelVotes
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig


def test_keyframes_vote_on_landmarks_made_later(monkeypatch: pytest.MonkeyPatch) -> None:
    """All recent keyframes that show the last keyframe's new landmarks vote on them."""
    views, shares = {}, {}
    for recent in (0, 3):
        monkeypatch.setattr(remembered_masks, "REMEMBERED", recent)
        system = run(Sides(FRAMES), MANY_KEYFRAMES)
        views[recent], shares[recent] = estimates(system).views, right_share(system)
        assert len(system.semantics._label_votes._remembered.rows) == recent
    ids, world = system.landmarks().ids, system.mapper.world
    last = world.landmarks.host[ids] == max(world.keyframes)
    gained = views[3] - views[0]
    assert last.sum() > 50
    assert gained.min() == 0  # what was there from the start
    assert gained[last].min() >= 1
    assert gained[last].max() == 3
    assert min(shares.values()) > 0.995


@pytest.fixture(scope="module")
def labelled() -> SlamSystem:
    """A run whose masks are remembered; not to be changed."""
    return run(Sides(FRAMES), MANY_KEYFRAMES)


def other_votes() -> LabelVotes:
    return SlamSystem(CAMERA, SystemConfig(), Sides(FRAMES)).semantics._label_votes


def test_what_is_remembered_outlives_a_state_and_older_states_lack_surfaces(
    labelled: SlamSystem,
) -> None:
    state, votes = labelled.semantics._label_votes.state(), other_votes()
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


def test_masks_that_an_older_version_kept_whole_are_thinned(labelled: SlamSystem) -> None:
    """A state of both sizes could not be saved."""
    state, votes = labelled.semantics._label_votes.state(), other_votes()
    height, width = CAMERA.height, CAMERA.width
    count, (h, w) = len(state["keyframes"]), state["shape"][:2]
    older = {n: a for n, a in state.items() if not n.startswith(("cod", "cell"))}
    for name in ("owner", "under", "inner"):
        whole = state[name].reshape(count, h, w).repeat(height // h, 1).repeat(width // w, 2)
        older[name] = whole.ravel()
    older["shape"] = np.tile([height, width], count)
    votes.restore(older)
    np.testing.assert_array_equal(votes.state()["owner"], state["owner"])


def test_a_map_of_an_older_version_lacks_the_surfaces_of_masks(labelled: SlamSystem) -> None:
    state = {n: a for n, a in labelled.state().items() if "semantics.votes.code" not in n}
    del state["semantics.votes.cell_px"]
    again = SlamSystem(CAMERA, SystemConfig())
    again.restore(state, FILE)
    assert len(again.semantics._label_votes.state()["keyframes"]) > 1
