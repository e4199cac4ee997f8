"""Beliefs about what landmarks lie on."""

from __future__ import annotations

import numpy as np
import pytest

from bmask_slam.semantics.beliefs.surface_store import (
    CORRELATION,
    SurfaceEstimates,
    SurfaceStore,
    independent_views,
    pooled,
    with_things,
)
from bmask_slam.semantics.labels import label_set

NAMES = label_set(("wall", "floor", "door"))
VIEW = np.array([[0.6, 0.1, 0.3]], np.float32)


def store(views: int) -> SurfaceStore:
    made = SurfaceStore()
    for _ in range(views):
        made.update(NAMES, np.array([7]), VIEW)
    return made


def test_one_view_is_taken_at_its_word() -> None:
    np.testing.assert_allclose(store(1).probabilities(np.array([7])), VIEW, atol=1e-6)


def test_many_views_of_one_kind_do_not_make_certain() -> None:
    """However many, they count as 1 / r: (0.6 / 0.3)^(1 / r) to one for wall against door."""
    assert independent_views(np.array([1.0, 2.0])) == pytest.approx([1, 2 / (1 + CORRELATION)])
    few, many = (store(n).probabilities(np.array([7]))[0] for n in (3, 1000))
    assert few[0] < many[0]
    assert many[0] / many[2] == pytest.approx(2 ** (1 / CORRELATION), rel=0.01)


def test_what_later_views_say_can_change_the_belief() -> None:
    made = store(20)
    for _ in range(40):
        made.update(NAMES, np.array([7]), VIEW[:, [1, 0, 2]])
    found = SurfaceEstimates.of(NAMES, made.probabilities(np.array([7, 8])))
    assert found.labels.tolist() == [2, 0]
    assert found.probability[1] == pytest.approx(1 / 3)


def test_fused_landmarks_share_their_views() -> None:
    made = store(2)
    made.update(NAMES, np.array([3]), VIEW[:, [1, 0, 2]])
    made.move(np.array([3, 5000]), np.array([7, 7]))
    expected = pooled(2 * np.log(VIEW) + np.log(VIEW[:, [1, 0, 2]]), np.array([3]))
    np.testing.assert_allclose(made.probabilities(np.array([7])), expected, atol=1e-6)
    assert made.known().tolist() == [7]
    made.drop(np.array([7, 9999]))
    assert len(made.known()) == 0


def test_a_state_goes_on_identically() -> None:
    made, again = store(2), SurfaceStore()
    again.restore(made.state())
    for one in (made, again):
        one.update(NAMES, np.array([1, 7]), np.concatenate([VIEW, VIEW]))
    assert again.names == NAMES
    for key, value in made.state().items():
        np.testing.assert_array_equal(again.state()[key], value)
    empty = SurfaceStore()
    empty.restore(SurfaceStore().state())
    assert len(empty.names) == 1


def test_what_is_on_a_known_thing_has_its_surface() -> None:
    surfaces, things = label_set(("paper", "books", "chair")), label_set(("book", "cup", "chair"))
    p = np.array([[0.7, 0.2, 0.1], [0.7, 0.2, 0.1], [0.7, 0.2, 0.1]])
    on = np.array([[0.2, 0.8, 0, 0], [0.2, 0, 0.8, 0], [0, 0.5, 0.2, 0.3]])  # unknown first
    found = with_things(surfaces, p, things, on)
    assert found[0] == pytest.approx([0.2 * 0.7, 0.8 + 0.2 * 0.2, 0.2 * 0.1])
    assert found[1] == pytest.approx(p[1])  # cups are no class of surfaces
    assert found[2] == pytest.approx([0.2 * 0.7, 0.5 + 0.2 * 0.2, 0.3 + 0.2 * 0.1])
