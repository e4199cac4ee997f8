"""Votes of random descriptors against a simple reference, and the rules for candidates."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from synthetic_view import random_descriptors

from bmask_slam.features.descriptor_index import DescriptorIndex, IndexConfig
from bmask_slam.features.matching import hamming
from bmask_slam.graph.arrays import Bits
from bmask_slam.loops.place_recognition import PlaceConfig, PlaceRecogniser

PARTITIONED = IndexConfig(lists=8, probes=8)  # from 256 descriptors on
WHOLE = IndexConfig(lists=1 << 20)


def changed(descriptors: Bits, bits: int, rng: np.random.Generator) -> Bits:
    """The descriptors with exactly this many of 512 bits flipped."""
    order = np.argsort(rng.random((len(descriptors), 512)), axis=1)
    return descriptors ^ np.packbits(order < bits, axis=1).view(np.uint64)


def alone(_: int) -> list[int]:
    return []


def neighbours(places: dict[int, int]) -> Callable[[int], list[int]]:
    """Keyframes of the same visit to a place, which are covisible."""
    return lambda k: [j for j, place in places.items() if j != k and place == places.get(k)]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def reference_votes(
    query: Bits, keyframes: dict[int, Bits], config: IndexConfig
) -> dict[int, float]:
    """The definition as loops."""
    scores: dict[int, float] = {}
    size = len(keyframes) + 1
    for descriptor in query:
        nearest = {k: int(hamming(descriptor[None], d).min()) for k, d in keyframes.items()}
        near = {k: d for k, d in nearest.items() if d <= config.max_distance}
        for k, distance in near.items():
            if config.ratio * distance <= min(near.values()):
                scores[k] = scores.get(k, 0.0) + np.log(size / len(near)) / np.log(size)
    return scores


@pytest.mark.parametrize("config", [WHOLE, PARTITIONED])
def test_votes_equal_the_definition(config: IndexConfig, rng: np.random.Generator) -> None:
    shared = random_descriptors(60, rng)
    keyframes = {
        k: np.concatenate([changed(shared[k * 5 :], 20 + 4 * k, rng), random_descriptors(20, rng)])
        for k in range(6)
    }
    index = DescriptorIndex(config)
    for k, descriptors in keyframes.items():
        index.add(k, descriptors)
    query = changed(shared, 15, rng)
    votes = index.votes(query)
    expected = reference_votes(query, keyframes, config)
    found = dict(zip(votes.keyframe_ids.tolist(), votes.scores.tolist(), strict=True))
    assert found == pytest.approx(expected)
    assert len(found) >= 3
    assert (np.diff(votes.scores) <= 0).all()


@pytest.mark.parametrize("config", [WHOLE, PARTITIONED])
def test_a_search_ahead_gives_the_same_votes(config: IndexConfig, rng: np.random.Generator) -> None:
    """Also of other descriptors, and after a change of the index."""
    keyframes = {k: random_descriptors(60, rng) for k in range(8)}
    index, plain = DescriptorIndex(config), DescriptorIndex(config)
    for k, descriptors in keyframes.items():
        index.add(k, descriptors)
        plain.add(k, descriptors)
    for change in (None, 3, 4, 5, 6, 7):  # with the last of them the index is built anew
        query, other = (changed(keyframes[k], 10, rng) for k in (0, 1))
        index.search_ahead(query)
        if change is not None:
            index.remove(change)
            plain.remove(change)
        for descriptors in (other, query):
            votes, expected = index.votes(descriptors), plain.votes(descriptors)
            assert votes.keyframe_ids.tolist() == expected.keyframe_ids.tolist()
            assert votes.scores.tolist() == expected.scores.tolist()


def test_the_distance_threshold_is_inclusive(rng: np.random.Generator) -> None:
    place = random_descriptors(40, rng)
    index = DescriptorIndex()
    index.add(4, place)
    gate = index.config.max_distance
    assert index.votes(changed(place, gate, rng)).scores.tolist() == [40.0]
    assert len(index.votes(changed(place, gate + 1, rng))) == 0


def test_common_descriptors_have_little_weight(rng: np.random.Generator) -> None:
    wallpaper, poster = random_descriptors(50, rng), random_descriptors(10, rng)
    index = DescriptorIndex()
    for k in range(20):
        index.add(k, np.concatenate([wallpaper, poster]) if k == 13 else wallpaper)
    votes = index.votes(np.concatenate([wallpaper, poster]))
    assert votes.keyframe_ids[0] == 13
    assert votes.scores[0] > 10
    assert votes.scores[1] < 1


@pytest.mark.parametrize("config", [WHOLE, PARTITIONED])
def test_removing_equals_never_adding(config: IndexConfig, rng: np.random.Generator) -> None:
    keyframes = {k: random_descriptors(60, rng) for k in range(12)}
    pruned, fresh = DescriptorIndex(config), DescriptorIndex(config)
    for k, descriptors in keyframes.items():
        pruned.add(k, descriptors)
    for k in range(9):  # rows are only marked at first, and the index is built anew on the way
        pruned.remove(k)
        query = changed(np.concatenate(list(keyframes.values())), 10, rng)
        assert set(pruned.votes(query).keyframe_ids.tolist()) == set(range(k + 1, 12))
    pruned.remove(999)
    for k in range(9, 12):
        fresh.add(k, keyframes[k])
    a, b = pruned.votes(query), fresh.votes(query)
    np.testing.assert_array_equal(a.keyframe_ids, b.keyframe_ids)
    np.testing.assert_array_equal(a.scores, b.scores)
    pruned.add(0, keyframes[0])  # an id may return
    assert 0 in pruned.votes(keyframes[0]).keyframe_ids


def test_a_keyframe_that_is_added_again_has_its_new_descriptors(rng: np.random.Generator) -> None:
    first, second, other = (random_descriptors(40, rng) for _ in range(3))
    index = DescriptorIndex(WHOLE)
    for k, descriptors in enumerate((other, first, random_descriptors(90, rng))):
        index.add(k, descriptors)
    index.remove(1)
    index.add(1, second)
    assert len(index.votes(first)) == 0
    assert index.votes(second).keyframe_ids.tolist() == [1]


def test_excluded_keyframes_do_not_displace_others(rng: np.random.Generator) -> None:
    """The best of the others is compared with the others only, not with excluded ones."""
    place = random_descriptors(40, rng)
    index = DescriptorIndex()
    index.add(0, changed(place, 40, rng))
    index.add(1, place)
    assert index.votes(place).keyframe_ids.tolist() == [1]
    assert index.votes(place, {1}).keyframe_ids.tolist() == [0]


def test_empty_and_repeated_input(rng: np.random.Generator) -> None:
    index = DescriptorIndex()
    none = random_descriptors(0, rng)
    assert len(index.votes(random_descriptors(5, rng))) == 0
    index.add(0, none)
    index.add(1, random_descriptors(5, rng))
    assert len(index.votes(none)) == 0
    with pytest.raises(ValueError, match="keyframe 1"):
        index.add(1, none)


def walk(
    recogniser: PlaceRecogniser, route: list[int], rng: np.random.Generator
) -> list[list[int]]:
    """Candidates of each keyframe of a walk through places; neighbours in time are covisible."""
    places = {p: random_descriptors(80, np.random.default_rng(p)) for p in set(route)}
    found = []
    for k, place in enumerate(route):
        descriptors = changed(places[place], 25, rng)
        candidates = recogniser.query(k, descriptors, lambda i: [i - 1, i + 1])
        found.append([c.keyframe_id for c in candidates])
        recogniser.index.add(k, descriptors)
    return found


def test_a_revisit_is_a_candidate_at_the_second_query(rng: np.random.Generator) -> None:
    rules = PlaceConfig(recent=3, consistent_queries=2)
    route = [0, 1, 2, 3, 4, 5, 6, 7, 0, 1, 2]
    found = walk(PlaceRecogniser(DescriptorIndex(), rules), route, rng)
    assert found == [[]] * 9 + [[1], [2]]


def test_a_single_hit_or_a_jump_is_not_consistent(rng: np.random.Generator) -> None:
    rules = PlaceConfig(recent=3, consistent_queries=2)
    route = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 0, 20, 4, 7, 21]
    found = walk(PlaceRecogniser(DescriptorIndex(), rules), route, rng)
    assert not any(found)
    once = PlaceConfig(recent=3, consistent_queries=1)
    found = walk(PlaceRecogniser(DescriptorIndex(), once), route, rng)
    assert [f for f in found if f] == [[0], [4], [7]]


def test_recent_and_covisible_keyframes_are_not_candidates(rng: np.random.Generator) -> None:
    place = random_descriptors(80, rng)
    rules = PlaceConfig(recent=2, consistent_queries=1)
    recogniser = PlaceRecogniser(DescriptorIndex(), rules)
    for k in range(4):
        recogniser.index.add(k, changed(place, 10 + k, rng))
    assert [c.keyframe_id for c in recogniser.query(4, place, lambda k: [0] * (k == 4))] == [1]
    assert recogniser.query(4, place, lambda k: [0, 1] if k == 4 else []) == []


def test_covisible_keyframes_vote_together(rng: np.random.Generator) -> None:
    """Two visits: one keyframe with most votes, and three that have more together."""
    place = random_descriptors(120, rng)
    visits = {0: 0, 1: 1, 2: 1, 3: 1}
    rules = PlaceConfig(recent=0, consistent_queries=1, group_share=0.9)
    recogniser = PlaceRecogniser(DescriptorIndex(), rules)
    recogniser.index.add(0, place[:48])
    for k in (1, 2, 3):
        recogniser.index.add(k, place[k * 20 + 20 : k * 20 + 60])
    (candidate,) = recogniser.query(9, place, neighbours(visits))
    assert candidate.keyframe_id in (1, 2, 3)
    assert candidate.group_votes > 1.5 * candidate.votes


def test_a_dismissed_place_makes_room_for_another_until_it_is_tried_again(
    rng: np.random.Generator,
) -> None:
    """Three visits to places that look alike; the first is the likest, and a keyframe of it too."""
    place, visits = random_descriptors(120, rng), {0: 0, 1: 0, 2: 1, 3: 2}
    rules = PlaceConfig(recent=0, consistent_queries=1, candidates=1, patience=5)
    recogniser = PlaceRecogniser(DescriptorIndex(), rules)
    for k, seen in enumerate((place, place[:100], place[:90], place[:80])):
        recogniser.index.add(k, changed(seen, 10 + k, rng))

    def best(keyframe_id: int) -> list[int]:
        return [c.keyframe_id for c in recogniser.query(keyframe_id, place, neighbours(visits))]

    assert best(20) == [0]
    recogniser.dismiss(1, 20)  # of the same visit
    again = PlaceRecogniser(recogniser.index, rules)
    again.restore(recogniser.state())
    recogniser = again
    assert [best(k) for k in (21, 25, 26)] == [[2], [2], [0]]
