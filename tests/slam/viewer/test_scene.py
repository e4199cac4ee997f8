"""What a scene tells its transports."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import make_pose
from bmask_slam.tracking.results import FrameResult, TrackingStatus
from bmask_slam.viewer import scene as module
from bmask_slam.viewer.options import ViewOptions
from bmask_slam.viewer.scene import Scene


class Lines:
    """A transport that keeps lines alone."""

    def __init__(self) -> None:
        self.shown: list[Array] = []

    def lines(self, path: str, lines: list[Array], colour: object) -> None:
        self.shown += lines

    def __getattr__(self, name: str) -> Any:
        return lambda *given: None


def test_a_long_path_is_shown_from_its_begin_to_its_end_by_few_points(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "MAX_PATH", 30)
    told, scene = Lines(), Scene("a", ViewOptions())
    scene._transports = [told]
    for k in range(1000):
        T = make_pose(np.eye(3), np.array([k, 0.0, 1.0]))
        scene.log_frame(FrameResult(k, 0.1 * k, TrackingStatus.OK, T))
    assert len(told.shown) == 100
    np.testing.assert_array_equal(told.shown[2][:, 0], np.arange(30))
    assert max(map(len, told.shown)) == 30
    for line in told.shown:
        assert line[0, 0] == 0 and (line[:, 2] == 1).all()
        steps = np.diff(line[:, 0])
        assert (steps == steps[0]).all()
    assert told.shown[-1][-1, 0] > 1000 - steps[0]
