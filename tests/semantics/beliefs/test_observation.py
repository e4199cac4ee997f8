"""What masks are worth: the measured model by hand, and views from one place counted once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.beliefs import class_sizes
from bmask_slam.semantics.beliefs.class_sizes import NEVER, PLACES, read_sizes
from bmask_slam.semantics.beliefs.label_store import LabelStore
from bmask_slam.semantics.beliefs.observation import (
    GROUPS,
    ObservationModel,
    observation_model,
    viewpoint_cells,
)
from bmask_slam.semantics.labels import label_set, read_label_set

NAMES = label_set(("cup", "chair", "couch"))
CONFUSED = np.zeros((4, 4))
CONFUSED[3, 2] = 0.2
MODEL = ObservationModel(
    precision=np.array([-0.8, 1.0, 0.4, 0.3]),
    objects=np.array([1.0, 1.0, 0.0]),
    recall=np.array([0.0, 0.5]),
    corners=np.array([1.5, 0.5, 2.0, 1.0]),
    precision_offsets=np.array([0.0, 0.0, 0.5, 0.0]),
    object_offsets=np.zeros(4),
    recall_offsets=np.zeros(4),
    corner_offsets=np.array([0.0, 0.0, 0.5, 0.0]),
    confused=CONFUSED,
    sizes=read_sizes(NAMES),
)


def sigmoid(x: float) -> float:
    return 1 / (1 + np.exp(-x))


def test_what_a_thing_is_follows_from_what_it_looks_like() -> None:
    looks = np.eye(4)
    seen = np.tile([0.7, 1.0], (4, 1))
    p = MODEL.truth(looks, seen)
    assert np.allclose(p.sum(axis=1), 1)
    assert p[0].tolist() == [1, 0, 0, 0]
    right = [sigmoid(0.2), sigmoid(0.7), sigmoid(-0.1)]  # a couch's evidence does not count
    assert np.diag(p)[1:] == pytest.approx(right)
    assert p[1, 0] == pytest.approx(1 - right[0])  # no cup: nothing that has a name
    assert p[3, 2] == pytest.approx(0.2)  # no couch: a chair, in one of five cases
    whole = MODEL.truth(looks, seen, MODEL.object_precision(seen))
    assert whole[1, 1] == pytest.approx(sigmoid(1.7))
    mixed = MODEL.truth(looks.mean(axis=0)[None], seen[:1])
    assert np.allclose(mixed, p.mean(axis=0))
    more = MODEL.truth(looks, np.tile([0.7, 2.0], (4, 1)))
    assert more[1, 1] == pytest.approx(sigmoid(-0.8 + 0.7 + 0.4 * np.log(2) + 0.3 * 2))
    most = MODEL.truth(looks, np.tile([0.7, 1e9], (4, 1)))
    assert most[1, 1] < sigmoid(-0.8 + 0.7 + 0.4 * np.log(3) + 0.3 * 3)  # as much as was measured


def test_a_landmark_is_right_as_its_thing_is_and_as_corners_well_inside_are() -> None:
    seen = np.array([[0.7, 1.0]])
    corner = MODEL.corner_precision(seen)[0]
    assert corner[1:] == pytest.approx([sigmoid(0.2), sigmoid(0.7), sigmoid(-0.1)])
    thing = MODEL.thing_precision(seen)[0]
    assert thing[1:] == pytest.approx(corner[1:] / [sigmoid(2.0), sigmoid(2.5), sigmoid(1.5)])
    assert MODEL.thing_precision(np.array([[4.0, 1.0]])).max() == pytest.approx(0.98)
    inside = MODEL.on_thing(seen)[0]  # a couch's evidence does not count
    assert inside[1:] == pytest.approx([sigmoid(3.0), sigmoid(3.5), sigmoid(1.5)])
    most = MODEL.on_thing(np.array([[0.7, 1e9]]))[0]
    assert sigmoid(3.0) < most[1] < sigmoid(2.0 + 5.0)  # it grows as far as it was measured
    store, one = LabelStore(4, model=MODEL), np.array([0])
    cup = np.array([[0.0, 1, 0, 0]], np.float32)
    for place in range(8):  # there is no doubt of what it looks like
        store.update(one, cup, np.array([0.9], np.float32), np.array([place]))
    scores = store._scores[:1] / [store._scores[0, 1], 1]
    on = MODEL.on_thing(scores)[0, 1]
    right = MODEL.thing_precision(scores)[0, 1]
    assert store.probabilities(one)[0, 1] == pytest.approx(right * on, abs=2e-3)
    store.judge(one, np.array([1]), np.array([1.5]))  # of a cup's size, and on a table
    odds = right / (1 - right) * np.exp(1.5)
    expected = odds / (1 + odds) * on
    assert store.probabilities(one)[0, 1] == pytest.approx(expected, abs=2e-3)


def test_small_and_far_things_are_missed_more_often() -> None:
    near, far = MODEL.group_recall(np.array([0.5, 5.0]), 500.0, 640)
    assert (np.diff(far) > 0).all()  # by size
    assert (near >= far).all()
    assert near[-1] == pytest.approx(1.0)
    side_px = 0.6 * np.sqrt(0.15 * 0.4) * 500 / 5
    logit = 0.5 * np.log2(side_px / 64)
    assert far[1] == pytest.approx(sigmoid(logit) / sigmoid(0.5 * 2))
    half = MODEL.group_recall(np.array([5.0]), 250.0, 320)  # the same camera at half the size
    assert np.allclose(half, far)


def test_views_from_one_place_are_one_piece_of_evidence() -> None:
    p = np.zeros((1, 4), np.float32)
    p[0, :2] = 0.4, 0.6
    weight, one = np.array([0.5], np.float32), np.array([0])
    once, often, around = (LabelStore(4) for _ in range(3))
    once.update(one, p, weight, np.array([7]))
    for place in range(4):
        often.update(one, p, weight, np.array([7]))
        around.update(one, p, weight, np.array([place]))
    odds = [np.log(s.probabilities(one)[0, 1] / s.probabilities(one)[0, 2]) for s in (once, often)]
    assert odds[1] == pytest.approx(odds[0] * (1 + 3 * once.config.again), rel=1e-4)
    assert once.evidence(one)[0] == pytest.approx(0.5)
    assert often.evidence(np.array([0, 99])).tolist() == pytest.approx([0.5 * 1.45, 0])
    all_around = around.probabilities(one)[0]
    assert np.log(all_around[1] / all_around[2]) == pytest.approx(4 * odds[0], rel=1e-4)


def test_a_miss_of_what_is_too_far_says_little() -> None:
    cup = np.array([[0.4, 0.6, 0, 0]], np.float32)
    found = []
    for z_m in (0.5, 8.0):
        store, one = LabelStore(4, model=MODEL), np.array([0])
        store.update(one, cup, np.array([0.8], np.float32), np.array([0]))
        for place in range(1, 7):
            expected = MODEL.group_recall(np.array([z_m]), 500.0, 640).astype(np.float32)
            store.miss(one, expected, np.array([place]))
        found.append(store.appearance(one)[0, 1])
    assert found[0] < 0.5 * found[1]


def test_a_table_seen_often_does_not_hide_the_book_on_it() -> None:
    names = label_set(("book", "dining table", *(f"other {k}" for k in range(60))))
    count = len(names)
    curved = ("precision", "object", "recall", "corner")
    nothing = {f"{name}_offsets": np.zeros(count) for name in curved}
    curves = {"precision": np.array([3.0, 0, 0, 0]), "objects": np.array([4.0, 0, 0])}
    curves["corners"] = np.array([4.0, 0.0, 4.0, 0.0])
    confused, sizes = np.zeros((count, count)), read_sizes(names)
    model = replace(MODEL, **curves, **nothing, confused=confused, sizes=sizes)
    table, book = np.zeros((2, 1, count), np.float32)
    table[0, [0, 2]], book[0, [0, 1]] = [0.2, 0.8], [0.5, 0.5]
    on_book, beside = LabelStore(count, model=model), LabelStore(count, model=model)
    one, sure, weak = np.array([0]), np.array([0.7], np.float32), np.array([0.4], np.float32)
    for view in range(20):
        for store in (on_book, beside):
            store.update(one, table, sure, np.array([view]))
        if view % 4 == 0:
            on_book.update(one, book, weak, np.array([40 + view]))
    assert on_book.estimates(one).labels[0] == 1
    assert beside.estimates(one).labels[0] == 2
    what = beside.probabilities(one)[0, 2]
    beside.judge(one, np.array([2]), np.array([-6.0]))  # its size is no table's
    assert beside.probabilities(one)[0, 2] < 0.5 * what


def test_a_store_with_a_model_is_saved_and_an_older_one_is_read() -> None:
    store, ids = LabelStore(4, model=MODEL), np.array([0, 3])
    p = np.array([[0.2, 0.8, 0, 0], [0.3, 0, 0, 0.7]], np.float32)
    store.update(ids, p, np.array([0.7, 0.6], np.float32), np.array([1, 2]))
    store.miss(ids[:1], np.ones((1, GROUPS), np.float32), np.array([5]))
    store.judge(ids, np.array([1, 3]), np.array([0.0, -3.0]))
    again = LabelStore(4, model=MODEL)
    again.restore(store.state())
    assert np.array_equal(again.probabilities(ids), store.probabilities(ids))
    assert store.probabilities(ids)[1, 3] < 0.2 * store.appearance(ids)[1, 3]
    older = {k: store.state()[k] for k in ("ids", "log_p", "views")}
    older["misses"] = np.array([1.0, 0.0], np.float32)
    again.restore(older)
    assert again.estimates(ids).views.tolist() == [2, 1]
    without = LabelStore(4)
    without.restore(store.state())
    assert without.estimates(ids).labels[1] == 3


def test_viewpoints_are_directions_and_distances() -> None:
    rng = np.random.default_rng(3)
    points = rng.normal(size=(500, 3))
    away = rng.normal(size=(500, 3))
    away *= 2 / np.linalg.norm(away, axis=1, keepdims=True)
    here = viewpoint_cells(points, points + away)
    assert here.min() >= 0
    assert here.max() < 64
    assert (viewpoint_cells(points, points + 1.001 * away) == here).mean() > 0.95
    for other in (-away, 2 * away, away[:, [1, 2, 0]]):
        assert (viewpoint_cells(points, points + other) == here).mean() < 0.1


def test_the_shipped_table_fits_the_light_networks_labels() -> None:
    names = read_label_set("coco")
    model = observation_model("light", names)
    assert model is not None
    assert (model.precision[1:] > 0).all()  # surer and repeated masks are right more often
    assert model.recall[1] > 0  # larger things are found more often
    assert (model.confused.sum(axis=1) < 0.6).all()
    assert (model.best_recall > 0.1).all()
    assert (model.best_recall < 0.95).all()
    sizes = model.sizes
    assert sizes.typical_m[names.number("cup")] < 0.2 < sizes.typical_m[names.number("chair")]
    assert set(sizes.places) <= set(PLACES)
    assert sizes.places[names.number("person")] == NEVER
    assert observation_model("precomputed", names) is None
    assert replace(model).groups.max() == GROUPS - 1


@pytest.mark.parametrize(
    "row",
    [
        "5", "", "[]", "[a, b, floor]", "[0.1, 0.2, moon]", "[0.1, .inf, floor]",
        "[.nan, 1.0, floor]", "[0.2, 0.1, floor]", "[0.1, 0.2, [floor]]", "[false, 1, any]",
        "[0.1, 1000000000, floor]",
    ],
)  # fmt: skip
def test_sizes_that_are_no_lengths_are_refused(
    row: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "sizes.yaml"
    monkeypatch.setattr(class_sizes, "data_path", lambda *parts: path)
    path.write_text("chair: [0.4, 1.2, support]\n")
    assert read_sizes(NAMES).longest_m[2] == 1.2
    path.write_text(f"chair: {row}\n")
    with pytest.raises(InputError, match=r"sizes\.yaml: chair: .* place"):
        read_sizes(NAMES)
