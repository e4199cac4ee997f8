"""Real pairs of frames with a man who walks: he moves, boards and walls do not."""

from __future__ import annotations

import sys
from itertools import permutations
from pathlib import Path

import pytest

from slam.system_config import SystemConfig

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))

from dynamic_pairs import DATA, man_in, moving_points, read_pair  # noqa: E402
from moving_points import Count, count  # noqa: E402


@pytest.mark.skipif(not DATA.is_dir(), reason="the shared data are not here")
def test_the_man_moves_and_the_room_does_not_by_geometry_alone() -> None:
    total = {"man": Count(), "rest": Count()}
    for folder in (DATA / "test1", DATA / "test2"):
        for pair in permutations(read_pair(folder)):
            counts = count(*moving_points(pair, SystemConfig()), {"man": man_in(pair[1])})
            total = {kind: total[kind] + counts[kind] for kind in total}
    assert total["man"].on > 400
    assert total["man"].share > 0.9
    assert total["rest"].share < 0.1
