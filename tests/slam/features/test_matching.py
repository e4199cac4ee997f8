"""Every fast search against a simple loop."""

import numpy as np
import pytest

from bmask_slam.features.matching import (
    MatchConfig,
    Matches,
    WindowIndex,
    consistent_rotation,
    expand_ranges,
    hamming,
    match_brute_force,
    match_pairs,
    unique_train,
)

RNG = np.random.default_rng(2)
EMPTY = np.zeros(0, np.int64)


def bits(count: int, flips: int = 0, base: np.ndarray | None = None) -> np.ndarray:
    """Random descriptors, or those of ``base`` with so many bits flipped in each."""
    if base is None:
        return RNG.integers(0, 2**64, (count, 8), dtype=np.uint64)
    unpacked = np.unpackbits(base.view(np.uint8).reshape(count, 64), axis=1)
    for row in unpacked:
        row[RNG.permutation(512)[:flips]] ^= 1
    return np.packbits(unpacked, axis=1).view(np.uint64).reshape(count, 8)


def slow_hamming(a: np.ndarray, b: np.ndarray) -> int:
    return sum(bin(int(x) ^ int(y)).count("1") for x, y in zip(a, b, strict=True))


def slow_match(
    pairs: set[tuple[int, int]], tables: tuple[np.ndarray, np.ndarray], config: MatchConfig
) -> list[tuple[int, int, int]]:
    """Best and second best of every query by a loop; then the best query of every train."""
    found = []
    for q in sorted({q for q, _ in pairs}):
        ranked = sorted((slow_hamming(tables[0][q], tables[1][t]), t) for p, t in pairs if p == q)
        clear = len(ranked) < 2 or ranked[0][0] <= config.ratio * ranked[1][0]
        if clear and ranked[0][0] <= config.max_distance:
            found.append((q, ranked[0][1], ranked[0][0]))
    if config.mutual:
        best = {t: min((d, q) for q, u, d in found if u == t) for _, t, _ in found}
        found = [(q, t, d) for q, t, d in found if best[t] == (d, q)]
    return found


def as_tuples(matches: Matches) -> list[tuple[int, int, int]]:
    columns = (matches.query.tolist(), matches.train.tolist(), matches.distance.tolist())
    return list(zip(*columns, strict=True))


def test_hamming_counts_differing_bits() -> None:
    a, b = bits(30), bits(30)
    assert hamming(a, b).tolist() == [slow_hamming(*pair) for pair in zip(a, b, strict=True)]
    assert hamming(a, a).tolist() == [0] * 30
    assert hamming(a[0], ~a[0]) == 512


def test_expand_ranges_is_a_list_of_ranges() -> None:
    start, stop = np.array([3, 5, 5, 9, -2]), np.array([6, 5, 4, 11, 1])
    owner, value = expand_ranges(start, stop)
    slow = [(i, v) for i in range(5) for v in range(start[i], stop[i])]
    assert list(zip(owner.tolist(), value.tolist(), strict=True)) == slow
    assert [len(part) for part in expand_ranges(EMPTY, EMPTY)] == [0, 0]


@pytest.mark.parametrize("radius_px", [0.5, 7.0, 16.0, 60.0])
def test_window_pairs_equal_a_double_loop(radius_px: float) -> None:
    pixels = RNG.uniform([-5.0, -5.0], [645.0, 485.0], (400, 2))  # undistortion leaves the image
    centres = np.concatenate([RNG.uniform([-30, -30], [670, 510], (80, 2)), pixels[:5]])
    radius = radius_px * RNG.uniform(0.5, 1.5, len(centres))
    query, train = WindowIndex(pixels).pairs(centres, radius)
    slow = {
        (q, t)
        for q in range(len(centres))
        for t in range(len(pixels))
        if np.hypot(*(pixels[t] - centres[q])) <= radius[q]
    }
    found = list(zip(query.tolist(), train.tolist(), strict=True))
    assert len(found) == len(set(found))
    assert set(found) == slow


def test_the_window_includes_its_edge() -> None:
    """FAST corners are at whole pixels, so that distances can equal the radius."""
    pixels = np.array([[105.0, 50.0], [95.0, 50.0], [100.0, 55.0], [100.0, 45.0], [103.0, 54.0]])
    _, train = WindowIndex(pixels).pairs(np.array([[100.0, 50.0]]), np.array([5.0]))
    assert sorted(train.tolist()) == [0, 1, 2, 3, 4]


def test_no_keypoints_give_no_window_pairs() -> None:
    none = np.zeros((0, 2))
    for pixels, centres in ((none, RNG.uniform(0, 99, (4, 2))), (RNG.uniform(0, 99, (4, 2)), none)):
        query, train = WindowIndex(pixels).pairs(centres, np.full(len(centres), 50.0))
        assert len(query) == len(train) == 0


@pytest.mark.parametrize("mutual", [False, True])
@pytest.mark.parametrize("ratio", [0.8, 1.0])
def test_match_pairs_equals_a_loop_over_candidates(mutual: bool, ratio: float) -> None:
    train = bits(25)
    chosen = RNG.integers(0, 25, 40)  # some train keypoints are wanted by several queries
    query = bits(40, flips=60, base=train[chosen])
    train[20:] = bits(5, flips=10, base=train[15:20])  # and some are twins
    pairs = {(q, int(t)) for q in range(40) for t in RNG.integers(0, 25, 8)}
    pairs |= {(q, int(chosen[q])) for q in range(0, 40, 2)}
    shuffled = RNG.permutation(np.array(sorted(pairs)))
    config = MatchConfig(max_distance=230, ratio=ratio, mutual=mutual)
    matches = match_pairs((shuffled[:, 0], shuffled[:, 1]), (query, train), config)
    assert as_tuples(matches) == slow_match(pairs, (query, train), config)
    assert len(matches) > 8


def test_a_match_needs_the_distance_gate_inclusively() -> None:
    train = bits(1)
    query = np.concatenate([bits(1, 50, train), bits(1, 51, train)])
    pairs = (np.array([0, 1]), np.array([0, 0]))
    config = MatchConfig(max_distance=50, mutual=False)
    assert match_pairs(pairs, (query, train), config).query.tolist() == [0]


def test_no_candidates_no_matches() -> None:
    assert len(match_pairs((EMPTY, EMPTY), (bits(3), bits(3)), MatchConfig())) == 0
    assert len(unique_train(Matches(EMPTY, EMPTY, EMPTY))) == 0
    assert len(match_brute_force(bits(0), bits(5), MatchConfig())) == 0
    assert len(match_brute_force(bits(5), bits(0), MatchConfig())) == 0
    none = Matches(EMPTY, EMPTY, EMPTY)
    assert len(consistent_rotation(none, np.zeros(0), 0.3)) == 0


@pytest.mark.parametrize("mutual", [False, True])
def test_brute_force_equals_match_pairs_of_all_pairs(mutual: bool) -> None:
    train = bits(30)
    query = np.concatenate([bits(20, 70, train[:20]), bits(5, 90, train[:5]), bits(10)])
    config = MatchConfig(max_distance=200, ratio=0.85, mutual=mutual)
    everything = np.meshgrid(np.arange(35), np.arange(30), indexing="ij")
    pairs = (everything[0].ravel(), everything[1].ravel())
    expected = match_pairs(pairs, (query, train), config)
    assert as_tuples(match_brute_force(query, train, config)) == as_tuples(expected)
    assert len(expected) == (20 if mutual else 25)


def test_consistent_rotation_keeps_the_common_one_across_the_wrap() -> None:
    """60 matches turned by about 359 degrees, 30 by anything."""
    common = np.deg2rad(359.0) + RNG.normal(0, np.deg2rad(3.0), 60)
    rotation = np.concatenate([common, RNG.uniform(np.deg2rad(60), np.deg2rad(300), 30)])
    order = RNG.permutation(90)
    matches = Matches(order, order, order)
    kept = consistent_rotation(matches, rotation[order] - 2 * np.pi * (order % 2), np.deg2rad(25))
    assert set(kept.query.tolist()) == set(range(60))


def test_matches_select_all_their_columns() -> None:
    matches = Matches(np.array([4, 5, 6]), np.array([1, 2, 3]), np.array([7, 8, 9]))
    assert as_tuples(matches[np.array([True, False, True])]) == [(4, 1, 7), (6, 3, 9)]
