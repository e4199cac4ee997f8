"""The label store against Bayes' rule written out, and through fusion, culling and storage."""

from __future__ import annotations

import numpy as np
import pytest

from bmask_slam.semantics.beliefs.label_fusion import LabelStoreConfig
from bmask_slam.semantics.beliefs.label_store import LabelStore
from bmask_slam.semantics.beliefs.observation import GROUPS, observation_model
from bmask_slam.semantics.beliefs.surface_store import SurfaceStore
from bmask_slam.semantics.labels import label_set, read_label_set

C = 5
PRIOR = np.array([0.5, *4 * [0.125]])
NO_LIMIT = LabelStoreConfig(max_log_odds=60.0, recall_views=1e9)


def views(count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Distributions (count, C) and weights (count,)."""
    p = rng.dirichlet(np.full(C, 0.7), count).astype(np.float32)
    return p, rng.uniform(0.2, 0.95, count).astype(np.float32)


def posterior(p: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Bayes' rule for one landmark, view by view."""
    belief = PRIOR.copy()
    for distribution, weight in zip(p, weights, strict=True):
        likelihood = weight * distribution / PRIOR + (1 - weight)
        belief = belief * likelihood / (belief * likelihood).sum()
    return belief


def test_a_batch_update_equals_bayes_rule_one_by_one() -> None:
    rng = np.random.default_rng(1)
    store, ids = LabelStore(C, NO_LIMIT), np.array([3, 0, 1500])
    observed = [views(3, rng) for _ in range(6)]
    for p, weights in observed:
        store.update(ids, p, weights)
    for row, i in enumerate(ids):
        expected = posterior(*(np.array([part[row] for part in v]) for v in zip(*observed)))  # noqa: B905
        assert np.allclose(store.probabilities(np.array([i]))[0], expected, atol=1e-5)
    assert store.estimates(ids).views.tolist() == [6, 6, 6]


def test_the_distribution_is_uniform_before_the_first_view() -> None:
    store = LabelStore(C)
    found = store.estimates(np.array([0, 7, 99999]))
    assert found.labels.tolist() == [0, 0, 0]
    assert np.allclose(found.probability, 0.5)
    assert np.allclose(found.entropy, -(PRIOR * np.log(PRIOR)).sum())
    assert found.views.tolist() == [0, 0, 0]
    assert len(store.estimates(np.zeros(0, np.int64)).labels) == 0


def test_one_view_counts_by_its_mask_score() -> None:
    store = LabelStore(C)
    sure = np.eye(C, dtype=np.float32)[[2, 2]]
    store.update(np.array([0, 1]), sure, np.array([0.8, 0.0], np.float32))
    p = store.probabilities(np.array([0, 1]))
    assert p[0, 2] == pytest.approx(0.8 + 0.2 * 0.125)
    assert np.allclose(p[1], PRIOR)  # a mask without any worth says nothing


def test_the_order_of_views_and_repeated_ids_do_not_matter() -> None:
    p, weights = views(4, np.random.default_rng(2))
    a, b, c = (LabelStore(C, NO_LIMIT) for _ in range(3))
    for k in (0, 1, 2, 3):
        a.update(np.array([5]), p[k : k + 1], weights[k : k + 1])
    for k in (2, 0, 3, 1):
        b.update(np.array([5]), p[k : k + 1], weights[k : k + 1])
    c.update(np.array([5, 5, 5, 5]), p, weights)
    five = np.array([5])
    assert np.allclose(a.probabilities(five), b.probabilities(five), atol=1e-6)
    assert np.allclose(a.probabilities(five), c.probabilities(five), atol=1e-6)


def missed_by_integral(prior: np.ndarray, misses: float, a: float, b: float) -> np.ndarray:
    """The distribution after views that missed it, with the recall integrated out numerically."""
    recall = (np.arange(200_000) + 0.5) / 200_000
    density = recall ** (a - 1) * (1 - recall) ** (b - 1)
    chance = (density * (1 - recall) ** misses).sum() / density.sum()
    belief = prior * np.array([1.0, *4 * [chance]])
    return belief / belief.sum()


def test_misses_of_one_view_are_dependent() -> None:
    config = LabelStoreConfig(0.5, 2.0, 1.5, recall_views=1e9, max_log_odds=60.0)
    store, three = LabelStore(C, config), np.array([3])
    p, weights = views(1, np.random.default_rng(6))
    store.miss(np.array([3, 3]), np.array([1.0, 0.5], np.float32))
    store.update(three, p, weights)
    store.miss(np.array([9]), np.array([1.0], np.float32))
    expected = missed_by_integral(posterior(p, weights), 1.5, 2.0, 1.5)
    assert np.allclose(store.probabilities(three)[0], expected, atol=1e-4)
    assert store.estimates(np.array([3, 9])).views.tolist() == [3, 1]
    first, then = (np.log(missed_by_integral(PRIOR, m, 2.0, 1.5)[1]) for m in (1, 2))
    nine = store.probabilities(np.array([9]))[0]
    assert np.log(nine[1]) == pytest.approx(first, abs=1e-4)
    assert then - first > first - np.log(PRIOR[1])  # the second adds less than the first


def labelled_after(views: int, recall: float, things: int = 500) -> tuple[float, float]:
    """Share of things with a label, and with the right one, after views of all of them.

    A mask is on a thing in a random part of the views. It has the score of a usual detection, and
    one in five has another class.
    """
    rng = np.random.default_rng(7)
    store, ids = LabelStore(81), np.arange(things)
    p = np.zeros((2, 81), np.float32)
    p[:, 0] = 0.35
    p[0, 3], p[1, 8] = 0.65, 0.65
    for _ in range(views):
        seen = rng.random(things) < recall
        other = (rng.random(seen.sum()) < 0.2).astype(int)
        store.update(ids[seen], p[other], np.full(seen.sum(), 0.5, np.float32))
        store.miss(ids[~seen], np.ones((~seen).sum(), np.float32))
    labels = store.estimates(ids).labels
    return float(np.mean(labels > 0)), float(np.mean(labels == 3))


@pytest.mark.parametrize("count", [10, 50, 200])
def test_what_is_seen_often_is_not_forgotten(count: int) -> None:
    labelled, right = labelled_after(count, recall=0.7)
    assert labelled >= 0.95
    assert right >= 0.9


def test_what_a_wrong_mask_covers_now_and_then_stays_unknown() -> None:
    for count in (10, 50, 200):
        assert labelled_after(count, recall=0.05)[0] < 0.05


def test_a_label_is_withdrawn_after_many_misses_and_comes_back() -> None:
    store, one = LabelStore(81), np.array([0])
    certain = np.eye(81, dtype=np.float32)[[2]]
    for _ in range(50):
        store.update(one, certain, np.array([0.9], np.float32))
    store.miss(one, np.ones(1, np.float32))
    store.miss(one, np.ones(1, np.float32))
    assert store.estimates(one).labels[0] == 2
    for _ in range(1000):
        store.miss(one, np.ones(1, np.float32))
    assert store.estimates(one).labels[0] == 0
    for _ in range(5):
        store.update(one, certain, np.array([0.9], np.float32))
    assert store.estimates(one).labels[0] == 2


def test_a_fused_landmark_combines_both_distributions() -> None:
    p, weights = views(4, np.random.default_rng(3))
    store, whole = LabelStore(C, NO_LIMIT), LabelStore(C, NO_LIMIT)
    store.update(np.array([1, 1]), p[:2], weights[:2])
    store.update(np.array([2, 2]), p[2:], weights[2:])
    store.miss(np.array([1, 2]), np.array([0.5, 1.0], np.float32))
    store.move(np.array([1]), np.array([2]))
    whole.update(np.array([2, 2, 2, 2]), p, weights)
    whole.miss(np.array([2, 2]), np.array([0.5, 1.0], np.float32))
    ids = np.array([1, 2])
    assert np.allclose(store.probabilities(ids), whole.probabilities(ids), atol=1e-6)
    assert store.estimates(ids).views.tolist() == [0, 6]
    store.drop(ids)
    assert store.known().tolist() == []


def test_a_wrong_label_can_be_corrected() -> None:
    store, one = LabelStore(C), np.array([0])
    wrong, right = np.eye(C, dtype=np.float32)[[1]], np.eye(C, dtype=np.float32)[[2]]
    weight = np.array([0.9], np.float32)
    for _ in range(1000):
        store.update(one, wrong, weight)
    for _ in range(4):
        store.update(one, right, weight)
    assert store.estimates(one).labels[0] == 2


def test_a_store_is_restored_from_its_state() -> None:
    p, weights = views(3, np.random.default_rng(4))
    store = LabelStore(C)
    store.update(np.array([2, 5000, 7]), p, weights)
    store.miss(np.array([2, 7, 9]), np.array([1.0, 1.0, 0.6], np.float32))
    store.drop(np.array([7]))
    twin = LabelStore(C)
    twin.restore(store.state())
    for name, table in vars(store).items():
        assert np.array_equal(table, vars(twin)[name]), name
    older = {**store.state(), "counts": np.ones(3 * C, np.float32)}  # with Dirichlet counts
    twin.restore(older)
    assert np.array_equal(twin.probabilities(np.arange(6000)), store.probabilities(np.arange(6000)))


def test_an_empty_store_and_one_of_an_older_version_are_restored() -> None:
    twin = LabelStore(C)
    twin.restore(LabelStore(C).state())
    assert len(twin.known()) == 0
    store = LabelStore(C)
    store.update(np.array([2, 7]), *(v[:2] for v in views(3, np.random.default_rng(4))))
    new = ("scores", "seen", "judged")
    twin.restore({name: array for name, array in store.state().items() if name not in new})
    assert np.array_equal(twin.probabilities(np.arange(9)), store.probabilities(np.arange(9)))


def test_an_id_beyond_the_capacity_is_moved_to_a_smaller_id_and_back() -> None:
    """After moving 3000 down no larger id remains, and the tables shrink."""
    p, weights = views(1, np.random.default_rng(7))
    store, whole = LabelStore(C), LabelStore(C)
    store.update(np.array([5000]), p, weights)
    store.move(np.array([5000]), np.array([3000]))
    whole.update(np.array([3000]), p, weights)
    ids = np.array([3000, 5000])
    assert np.array_equal(store.probabilities(ids), whole.probabilities(ids))
    store.move(np.array([3000]), np.array([9000]))
    assert store.known().tolist() == [9000]


def test_a_store_has_rows_for_what_is_known_alone() -> None:
    """Ids are never used twice, and most landmarks of a long session are removed."""
    rng, names = np.random.default_rng(8), label_set(("wall", "floor"))
    store, surfaces = LabelStore(C), SurfaceStore()
    for first in range(0, 10**9, 10**8):
        ids = first + np.arange(50)
        store.update(ids, *views(50, rng))
        surfaces.update(names, ids, rng.dirichlet(np.ones(2), 50).astype(np.float32))
        for each in (store, surfaces):
            each.move(ids[:10], ids[10:20])
            each.drop(ids[20:])
            assert each.known().tolist()[-10:] == ids[10:20].tolist()
    tables = [*vars(store).values(), *vars(surfaces).values()]
    assert max(len(t) for t in tables if isinstance(t, np.ndarray)) == 100


@pytest.mark.parametrize("measured", ["", "light"])
def test_views_fused_at_once_equal_those_fused_one_after_another(measured: str) -> None:
    """Of things that are seen several times, also from one viewpoint, and missed in between."""
    names, rng, count = read_label_set("coco"), np.random.default_rng(5), 400
    model = observation_model(measured, names)
    at_once, in_turn = (LabelStore(len(names), model=model) for _ in range(2))
    ids, cells = rng.integers(0, 60, count), rng.integers(0, 5, count)
    missed = rng.random(count) < 0.4
    distributions = rng.dirichlet(np.full(len(names), 0.05), count).astype(np.float32)
    weights = rng.uniform(0.2, 1.0, count).astype(np.float32)
    groups = 1 if model is None else GROUPS
    misses = rng.uniform(0.2, 1.0, (count, groups)).astype(np.float32)
    told = distributions[~missed], weights[~missed]
    at_once.fuse(ids, missed, told, misses[missed], cells)
    for k in range(count):
        one = slice(k, k + 1)
        if missed[k]:
            in_turn.miss(ids[one], misses[one], cells[one])
        else:
            in_turn.update(ids[one], distributions[one], weights[one], cells[one])
    states = at_once.state(), in_turn.state()
    assert states[0]["views"].sum() == count
    for name, array in states[0].items():
        np.testing.assert_array_equal(array, states[1][name], err_msg=name)
