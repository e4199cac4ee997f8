"""The index of observations against a plain count, and an update of the graph against a search."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from bmask_slam.world.observers import Observers


@pytest.mark.parametrize("seed", range(3))
def test_random_changes_leave_what_a_count_gives(seed: int) -> None:
    rng, observers = np.random.default_rng(seed), Observers()
    counted: Counter[tuple[int, int]] = Counter()
    for _ in range(300):
        keyframe = int(rng.integers(20))
        own = [landmark for (landmark, k), n in counted.items() if k == keyframe for _ in range(n)]
        if own and rng.random() < 0.4:
            ids = rng.permutation(own)[: rng.integers(1, len(own) + 1)]
            observers.remove(keyframe, ids)
            counted.subtract((landmark, keyframe) for landmark in ids.tolist())
        else:
            ids = rng.integers(0, 3000, rng.integers(0, 200))  # some of them twice
            observers.add(keyframe, ids)
            counted.update((landmark, keyframe) for landmark in ids.tolist())
        asked = np.unique(rng.integers(0, 4000, 500))
        known = set(asked.tolist())
        expected = sorted(
            k for (landmark, k), n in counted.items() if landmark in known for _ in range(n)
        )
        assert sorted(observers.of(asked).tolist()) == expected


def test_what_is_not_observed_cannot_be_removed() -> None:
    observers = Observers()
    observers.add(3, np.array([5, 5, 9]))
    observers.remove(3, np.array([5]))
    with pytest.raises(KeyError, match="keyframe 4 does not observe \\[5\\]"):
        observers.remove(4, np.array([5]))
    assert observers.of(np.array([5, 9])).tolist() == [3, 3]


def test_entries_are_used_again() -> None:
    observers = Observers()
    for keyframe in range(200):
        observers.add(keyframe, np.arange(500))
        observers.remove(keyframe, np.arange(500))
    assert len(observers._keyframe) < 10_000
