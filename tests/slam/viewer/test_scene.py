"""What a scene tells its transports."""

from __future__ import annotations

import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import make_pose
from bmask_slam.live.display import Display
from bmask_slam.tracking.results import FrameResult, TrackingStatus
from bmask_slam.viewer import rerun_transport
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


@contextmanager
def full_scene(options: ViewOptions) -> Iterator[Scene]:
    """A scene with more to write than the disk has room for."""
    scene, limits = Scene("a", options), resource.getrlimit(resource.RLIMIT_FSIZE)
    points = np.random.default_rng(0).normal(size=(40_000, 3))
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    try:
        scene.log_points("world/landmarks", points, np.zeros((len(points), 3), np.uint8), 0.01)
        yield scene
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.parametrize(
    ("library", "option"), [("rerun", "record"), ("foxglove", "foxglove_file")]
)
def test_a_file_that_the_disk_has_no_room_for_is_one_line(
    tmp_path: Path, monkeypatch, caplog: pytest.LogCaptureFixture, library: str, option: str
) -> None:
    """``view`` ends with it; ``live``, whose run is what counts, warns."""
    pytest.importorskip(library)
    monkeypatch.setattr(rerun_transport, "FILE_FLUSH_S", 2.0)
    file = tmp_path / "a.mcap"
    options = ViewOptions(**{option: file})
    with full_scene(options) as scene, pytest.raises(InputError, match=f"^{file}: .*free some"):
        scene.close()
    with full_scene(options) as scene:
        Display(scene).close()
    assert caplog.messages[-1].startswith(f"{file}: ")


@pytest.mark.skipif(sys.platform != "linux", reason="a folder in which nobody may write")
def test_a_file_of_foxglove_that_cannot_be_made_is_one_line() -> None:
    pytest.importorskip("foxglove")
    with pytest.raises(InputError, match=r"^/proc/run\.mcap: .*; change the folder's permissions"):
        Scene("a", ViewOptions(foxglove_file=Path("/proc/run.mcap")))
