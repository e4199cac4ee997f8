"""Incremental pairing of images equals pairing of all at once."""

from __future__ import annotations

import numpy as np
import pytest

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.trajectory import associate_stamps
from bmask_slam.live.sources.pairing import DEPTH, LATE_S, MAX_WAITING, RGB, Pair, Pairer
from bmask_slam.live.sources.source import SourceCounts
from bmask_slam.live.sources.source_clock import SourceClock


def pairs_of(
    rgb_s: Array, depth_s: Array, order: Array, counts: SourceCounts | None = None
) -> list[Pair[int]]:
    """Feed both streams; order (N,) says which stream's next image comes. Items are indices."""
    counts = counts or SourceCounts()
    pairer, streams, given = Pairer[int](counts), (rgb_s, depth_s), [0, 0]
    pairs = []
    for stream in order:
        pairs += pairer.add(stream, streams[stream][given[stream]], given[stream])
        given[stream] += 1
    return pairs + pairer.finish()


def by_time(rgb_s: Array, depth_s: Array) -> Array:
    """The order of the images by their stamps."""
    streams = np.repeat([RGB, DEPTH], (len(rgb_s), len(depth_s)))
    return streams[np.argsort(np.concatenate([rgb_s, depth_s]), kind="stable")]


def delayed(rgb_s: Array, depth_s: Array, rng: np.random.Generator) -> Array:
    """An order in which either stream may come up to 0.3 s behind the other."""
    lag_s = rng.uniform(-0.3, 0.3)
    return by_time(rgb_s, depth_s + lag_s)


@pytest.mark.parametrize("seed", range(8))
def test_pairs_are_those_of_all_stamps_at_once(seed: int) -> None:
    """Two clocks that drift, jitter, losses and delays give the pairs of ``associate_stamps``."""
    rng = np.random.default_rng(seed)
    rgb_s = 1e9 + np.arange(150) / 30 + rng.uniform(-0.004, 0.004, 150)
    depth_s = 1e9 + rng.uniform(0, 0.04) + np.arange(150) / 29.7 + rng.uniform(-0.004, 0.004, 150)
    rgb_s, depth_s = (s[rng.random(150) < 0.9] for s in (rgb_s, depth_s))
    counts = SourceCounts()
    pairs = pairs_of(rgb_s, depth_s, delayed(rgb_s, depth_s, rng), counts)
    i, j = associate_stamps(rgb_s, depth_s)
    assert [(pair.rgb, pair.depth) for pair in pairs] == list(zip(i, j, strict=True))
    assert [pair.stamp_s for pair in pairs] == list(rgb_s[i])
    assert counts.unpaired_rgb == len(rgb_s) - len(i)
    assert counts.unpaired_depth == len(depth_s) - len(j)
    assert counts.duplicates == counts.late == counts.clock_jumps == 0


def test_a_pair_is_returned_as_soon_as_it_is_final() -> None:
    pairer = Pairer[str](SourceCounts())
    assert not pairer.add(DEPTH, 1.000, "d0")
    assert pairer.add(RGB, 1.000, "c0") == [Pair(1.000, "c0", "d0", 0.0)]
    assert not pairer.add(RGB, 1.033, "c1")
    assert not pairer.add(DEPTH, 1.045, "d1")  # the next colour image might lie nearer
    (pair,) = pairer.add(RGB, 1.066, "c2")
    assert pair[:3] == (1.033, "c1", "d1") and pair.lag_s == pytest.approx(0.012)
    assert not pairer.add(DEPTH, 1.060, "d2")  # and here the next depth image
    (pair,) = pairer.add(DEPTH, 1.078, "d3")
    assert pair[:3] == (1.066, "c2", "d2") and pair.lag_s == pytest.approx(-0.006)


def test_images_too_far_apart_in_time_are_not_paired() -> None:
    counts = SourceCounts()
    rgb_s, depth_s = np.array([0.0, 0.1, 0.2]), np.array([0.0201, 0.1199, 0.25])
    pairs = pairs_of(rgb_s, depth_s, by_time(rgb_s, depth_s), counts)
    assert [(pair.rgb, pair.depth) for pair in pairs] == [(1, 1)]
    assert (counts.unpaired_rgb, counts.unpaired_depth) == (2, 2)


def test_a_known_delay_of_depth_is_added_to_its_stamps() -> None:
    pairer = Pairer[str](SourceCounts(), depth_offset_s=lambda: -0.05)
    assert not pairer.add(RGB, 1.00, "c0")
    assert not pairer.add(DEPTH, 1.00, "of 0.95")
    (pair,) = pairer.add(DEPTH, 1.05, "of 1.00")
    assert pair[:3] == (1.00, "c0", "of 1.00")
    assert pair.lag_s == pytest.approx(0.05)  # of the stamps


def test_a_delay_that_is_found_on_the_way_pairs_the_images_that_wait_too() -> None:
    known_s, pairs = [0.0], []
    pairer = Pairer[int](SourceCounts(), depth_offset_s=lambda: known_s[0])
    for k in range(8):
        if k == 4:
            known_s[0] = -0.2  # as of the depth image two frames later
        pairs += pairer.add(RGB, k / 10, k) + pairer.add(DEPTH, k / 10, k)
    pairs += pairer.finish()
    assert [(pair.rgb, pair.depth) for pair in pairs[:4]] == [(k, k) for k in range(4)]
    assert [(pair.rgb, pair.depth) for pair in pairs[4:]] == [(4, 6), (5, 7)]
    assert [pair.lag_s for pair in pairs[4:]] == pytest.approx([0.2, 0.2])


def test_with_a_known_delay_images_half_an_interval_apart_are_paired() -> None:
    counts, pairs = SourceCounts(), []
    pairer = Pairer[int](counts, depth_offset_s=lambda: -0.049)
    for k in range(20):
        pairs += pairer.add(RGB, k / 10, k) + pairer.add(DEPTH, k / 10, k)
    assert [pair.depth - pair.rgb for pair in pairs[2:]] == [0] * len(pairs[2:])
    assert len(pairs) >= 16 and counts.unpaired_rgb <= 3


def test_duplicates_and_late_images_are_skipped_and_counted() -> None:
    counts = SourceCounts()
    rgb_s = np.array([0.0, 0.0, 0.1, 0.05, 0.2])
    depth_s = np.array([0.0, 0.1, 0.1, 0.2])
    pairs = pairs_of(rgb_s, depth_s, np.array([0, 0, 1, 0, 1, 1, 0, 0, 1]), counts)
    assert [(pair.rgb, pair.depth) for pair in pairs] == [(0, 0), (2, 1), (4, 3)]
    assert (counts.duplicates, counts.late) == (2, 1)
    assert counts.unpaired_rgb == counts.unpaired_depth == 0


def test_stamps_go_forward_after_the_clock_was_set_back(caplog) -> None:
    """Depth reaches the jump two images later than colour; nothing is paired across it."""
    rgb_s = np.concatenate([100 + np.arange(10) / 10, 40 + np.arange(10) / 10])
    depth_s = rgb_s + 0.003
    counts = SourceCounts()
    order = np.concatenate([[RGB] * 2, np.tile([RGB, DEPTH], 18), [DEPTH] * 2])
    pairs = pairs_of(rgb_s, depth_s, order, counts)
    assert [(pair.rgb, pair.depth) for pair in pairs] == [(k, k) for k in range(20)]
    stamps_s = np.array([pair.stamp_s for pair in pairs])
    assert np.allclose(stamps_s[:10], rgb_s[:10])
    assert np.allclose(np.diff(stamps_s[10:]), 0.1)
    assert 0.9 * LATE_S < stamps_s[10] - stamps_s[9] < 1.1 * LATE_S
    assert (counts.clock_jumps, counts.late, counts.gaps) == (1, 0, 1)
    assert "set back by 60.9" in caplog.text


@pytest.mark.parametrize("wrong_s", [0.0, 1e4 + 3600, 1e4 - 3600, 1e4 + 6.2, 1e4 - 1.8])
@pytest.mark.parametrize("streams", [(RGB,), (DEPTH,), (RGB, DEPTH)])
def test_one_wrong_stamp_costs_one_or_two_pairs(wrong_s: float, streams, caplog) -> None:
    """Taken for a clock that was set back, it left the streams unpaired for ever."""
    right_s, counts = 1e4 + np.arange(100) / 30, SourceCounts()
    rgb_s, depth_s = right_s.copy(), right_s + 0.002
    for stream in streams:
        (rgb_s, depth_s)[stream][50] = wrong_s
    pairs = pairs_of(rgb_s, depth_s, np.tile([RGB, DEPTH], 100), counts)
    known = [pair for pair in pairs if pair.rgb != 50]
    assert len(known) >= 98 and all(pair.rgb == pair.depth for pair in known)
    assert [pair.stamp_s for pair in known] == right_s[[pair.rgb for pair in known]].tolist()
    assert counts.clock_jumps == 0
    assert f"the stamp {wrong_s:.3f} was wrong" in caplog.text


@pytest.mark.parametrize("wrong_s", [0.0, 1e4 + 3600, 1e4 + 6.2])
def test_a_pair_with_one_wrong_stamp_does_not_move_later_ones(wrong_s: float) -> None:
    stamps_s, clock = 1e4 + np.arange(40) / 30, SourceClock()
    stamps_s[20] = wrong_s
    used_s = []
    for pair in pairs_of(stamps_s, stamps_s, np.tile([RGB, DEPTH], 40)):
        used_s.append(clock.checked(pair.stamp_s))
        clock.used(used_s[-1])
    right_s = np.delete(stamps_s, 20).tolist()
    assert used_s in (right_s, [s for s in right_s if s != stamps_s[21]])


@pytest.mark.parametrize("ahead_s", [3600.0, 6.2])
@pytest.mark.parametrize("stream", [RGB, DEPTH])
@pytest.mark.parametrize("order", [[RGB, DEPTH], [DEPTH, RGB]])
def test_a_wrong_first_stamp_costs_one_or_two_pairs(ahead_s: float, stream: int, order) -> None:
    """Taken for a clock that was set back, it left the streams unpaired for ever."""
    right_s, counts = 1e4 + np.arange(40) / 30, SourceCounts()
    rgb_s, depth_s = right_s.copy(), right_s + 0.002
    (rgb_s, depth_s)[stream][0] += ahead_s
    pairs = pairs_of(rgb_s, depth_s, np.tile(order, 40), counts)
    first = 40 - len(pairs)
    assert first <= 2
    assert [pair.rgb for pair in pairs] == [pair.depth for pair in pairs] == list(range(first, 40))
    assert [pair.stamp_s for pair in pairs] == right_s[first:].tolist()
    assert counts.clock_jumps == 0


def test_gaps_are_counted_relative_to_the_usual_step() -> None:
    counts = SourceCounts()
    stamps_s = np.cumsum([0, 0.1, 0.1, 0.25, 0.1, 0.5, 0.1, 60, 0.1])
    assert len(pairs_of(stamps_s, stamps_s, by_time(stamps_s, stamps_s), counts)) == 9
    assert counts.gaps == 2
    assert counts.line() == "2 gaps"


def test_images_without_the_other_stream_use_bounded_memory() -> None:
    counts = SourceCounts()
    pairer = Pairer[int](counts)
    for k in range(1000):
        pairer.add(RGB, k / 30, k)
    assert counts.unpaired_rgb == 1000 - MAX_WAITING
    pairs = pairer.add(DEPTH, 999 / 30, 0)
    assert [pair.rgb for pair in pairs] == [999]
