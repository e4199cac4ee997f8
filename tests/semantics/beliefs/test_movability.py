"""The filter against Bayes' rule written out; fusing, dropping and errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.beliefs.movability import MovabilityConfig, MovabilityFilter, read_priors
from bmask_slam.semantics.labels import label_set, read_label_set

IDS = np.array([3, 2000])


def test_evidence_is_combined_by_bayes_rule() -> None:
    movability = MovabilityFilter(0.3, MovabilityConfig(hit_rate=0.8, max_evidence=50))
    p = 0.3
    for says_moving in (True, True, False, True):
        movability.update(IDS[:1], np.array([says_moving]))
        if_moving, if_static = (0.8, 0.2) if says_moving else (0.2, 0.8)
        p = p * if_moving / (p * if_moving + (1 - p) * if_static)
    found = movability.probabilities(np.array([3, 7, 99999]))
    np.testing.assert_allclose(found, [p, 0.3, 0.3], rtol=1e-5)
    assert movability.moving(np.array([3, 7])).tolist() == [True, False]


def test_the_power_is_an_exponent_of_the_likelihood() -> None:
    whole, quarters = (MovabilityFilter(0.5) for _ in range(2))
    whole.update(IDS, np.array([True, False]))
    for _ in range(4):
        quarters.update(IDS, np.array([True, False]), 0.25)
    np.testing.assert_allclose(whole.log_odds(IDS), quarters.log_odds(IDS), rtol=1e-6)


def test_it_recovers_from_any_number_of_wrong_observations() -> None:
    movability = MovabilityFilter(0.2)
    for _ in range(100):
        movability.update(IDS, np.array([True, True]))
    assert movability.moving(IDS).all()
    for _ in range(3):
        movability.update(IDS, np.array([False, False]))
    assert not movability.moving(IDS).any()


def test_a_label_changes_the_prior_and_keeps_the_evidence() -> None:
    movability = MovabilityFilter(0.2)
    movability.update(IDS, np.array([False, False]))
    before = movability.log_odds(IDS)
    movability.set_priors(IDS[:1], np.array([0.95]))
    moved_by = movability.log_odds(IDS) - before
    np.testing.assert_allclose(moved_by, [np.log(0.95 / 0.05) - np.log(0.2 / 0.8), 0], atol=1e-6)


def test_fused_landmarks_share_evidence_and_dropped_ones_are_unknown() -> None:
    movability = MovabilityFilter(0.2)
    movability.update(IDS, np.array([True, True]), 0.5)
    movability.set_priors(IDS[1:], np.array([0.9]))
    movability.move(IDS[1:], IDS[:1])
    expected = np.log(9) + movability.config.step
    np.testing.assert_allclose(movability.log_odds(IDS), [expected, np.log(0.25)], rtol=1e-5)
    assert movability.known().tolist() == movability.known_moving().tolist() == IDS[:1].tolist()
    assert not len(movability.known(without=np.arange(4) == IDS[0]))
    movability.drop(IDS)
    assert not len(movability.known())
    assert not len(movability.known_moving())


def test_the_state_is_restored() -> None:
    movability, other = MovabilityFilter(0.2), MovabilityFilter(0.2)
    movability.update(IDS, np.array([True, False]))
    other.update(np.array([5]), np.array([True]))
    other.restore(movability.state())
    ids = np.arange(3000)
    np.testing.assert_array_equal(movability.log_odds(ids), other.log_odds(ids))


def test_shipped_priors_rank_people_chairs_and_walls() -> None:
    priors = read_priors("movability").of(label_set(("wall", "chair", "person")))
    unknown, wall, chair, person = priors
    assert wall < chair < 0.5 < person
    assert 0 < unknown < 0.5


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("unknown: 0.2\nother: 0.1\nperson: 1.0\n", "person: 1.0 is no prior"),
        ("unknown: 0.2\nother: 0.1\nperson: high\n", "person: 'high' is no prior"),
        ("unknown: 0.2\nother: true\n", "other: True is no prior"),
        ("person: 0.9\n", "needs lines"),
        ("a: [", "line 1: expected the node content"),
    ],
)
def test_bad_priors_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "priors.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message):
        read_priors(str(path))


@pytest.mark.parametrize("bad", [{"hit_rate": 0.5}, {"frame_power": 0.0}, {"max_evidence": 0.0}])
def test_bad_configuration_is_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        MovabilityConfig(**bad)


def test_every_animal_of_coco_moves_by_itself() -> None:
    names = read_label_set("coco")
    animals = [
        "bird",
        "cat",
        "dog",
        "horse",
        "sheep",
        "cow",
        "elephant",
        "bear",
        "zebra",
        "giraffe",
    ]
    priors = read_priors("movability").of(names)
    assert (priors[[names.names.index(animal) for animal in animals]] > 0.5).all()
