"""A delay of depth by its edges, from one look at a live run to the next."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic_view import CAMERA

from bmask_slam.calibration.adoption import SelfCalibration
from bmask_slam.calibration.edge_delay import EdgeDelay
from bmask_slam.graph.calibration.registration import Registration

GIVEN = replace(CAMERA, depth_time_offset_s=0.004)


def shown(delay_ms: float, bound_ms: float) -> Registration:
    return Registration(np.zeros(2), np.ones(2), 1e-3 * delay_ms, 1e-3 * bound_ms / 1.96, 9.0)


@pytest.mark.parametrize(
    ("looks", "used_ms"),
    [
        ([(41, 4)], 45),  # surely large
        ([(38, 4)], None),
        ([(34, 5), (38, 4)], 42),  # confirmed
        ([(-34, 5), (38, 4)], None),  # not the same
        ([(20, 5), (38, 4)], None),  # the first may be a right camera's
        ([None, (38, 4)], None),
        ([(12, 2), (13, 2)], None),
    ],
)
def test_a_delay_is_used_that_is_large_or_was_seen_before(looks, used_ms) -> None:
    edges, state = EdgeDelay(GIVEN), SelfCalibration(GIVEN, GIVEN)
    for k, look in enumerate(looks):
        found = None if look is None else shown(*look)
        state, warning = edges.judge(state, found)
        if k < len(looks) - 1:
            assert not edges.is_used
    assert edges.is_used == (used_ms is not None)
    used_s = state.camera.depth_time_offset_s
    assert used_s == pytest.approx(GIVEN.depth_time_offset_s if used_ms is None else used_ms / 1e3)
    if used_ms is None and looks[-1][0] > 22:
        assert "set depth_time_offset: 0.042 in camera.yaml" in warning
    else:
        assert not warning


def test_a_delay_by_the_motion_stays_where_edges_do_not_contradict_it() -> None:
    by_motion = replace(GIVEN, depth_time_offset_s=0.025)
    state = SelfCalibration(GIVEN, by_motion, text="by the motion")
    edges = EdgeDelay(GIVEN)
    assert edges.judge(state, shown(41, 4)) == (state, "")  # 20 ms from it: a right camera's
    late, _ = EdgeDelay(GIVEN).judge(state, shown(49, 4))
    assert late.camera.depth_time_offset_s == pytest.approx(0.053)
    assert not edges.contradicts(None, by_motion)
