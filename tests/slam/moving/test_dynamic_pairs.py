"""Real pairs of frames with a walking person: the person moves, boards and walls do not."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

from benchmarks.moving.composited import composed
from benchmarks.moving.dynamic_pairs import DATA, moving_points, person_mask, read_pair
from benchmarks.moving.moving_points import Count, count
from bmask_slam.sequences.frame import Frame
from bmask_slam.system_config import SystemConfig


@pytest.mark.skipif(not DATA.is_dir(), reason="the shared data are not here")
def test_a_person_is_found_moving_by_geometry_alone() -> None:
    total = {"man": Count(), "rest": Count()}
    for folder in (DATA / "test1", DATA / "test2"):
        for pair in permutations(read_pair(folder)):
            counts = count(*moving_points(pair, SystemConfig()), {"man": person_mask(pair[1])})
            total = {kind: total[kind] + counts[kind] for kind in total}
    assert total["man"].on > 400
    assert total["man"].share > 0.9
    assert total["rest"].share < 0.1


@pytest.mark.skipif(not DATA.is_dir(), reason="the shared data are not here")
def test_a_composited_person_occludes_and_is_occluded() -> None:
    man = read_pair(DATA / "test1")[0]
    depth_m = np.full((480, 640), 4.0, np.float32)
    depth_m[:, 320:] = 0.8
    frame = Frame(0, 0.0, np.zeros((480, 640, 3), np.uint8), depth_m)
    new = composed(frame, man, np.array([0.0, 0.0, 1.15]), (525.0, 319.5))
    assert np.array_equal(new.depth_m[:, 320:], depth_m[:, 320:])
    assert not new.rgb[:, 320:].any()
    his = new.rgb[:, :320].any(axis=2)
    assert his.sum() > 20000
    assert abs(np.nanmedian(new.depth_m[:, :320][his]) - 1.15) < 0.1
    assert np.array_equal(new.depth_m[:, :320][~his], depth_m[:, :320][~his])
