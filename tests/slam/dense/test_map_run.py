"""Which keyframes a map that goes on reads again."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bmask_slam.dense.map_run import RunFusion


@pytest.mark.parametrize(
    ("source", "first"), [("sensor", 14), ("stereo", 14), ("both", 8), ("motion", 8)]
)
def test_keyframes_are_read_with_all_that_their_depth_comes_from(source: str, first: int) -> None:
    """Six neighbours on either side; by a sweep, what the first of them is matched with too."""
    fusion: Any = SimpleNamespace(
        run=SimpleNamespace(keyframes=[SimpleNamespace(id=k) for k in range(40)]),
        folder=SimpleNamespace(is_done=lambda k: k not in (20, 21, 39)),
        options=SimpleNamespace(source=source),
    )
    last = set(range(39 - (20 - first), 40))
    expected = set(range(first, 28)) | last
    assert set(np.flatnonzero(RunFusion._needed(fusion)).tolist()) == expected
