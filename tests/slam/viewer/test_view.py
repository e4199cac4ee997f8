"""What reaches Rerun, read back from the recording."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from synthetic_view import CAMERA, render_plane

from graph.errors import InputError
from graph.geometry import se3_exp
from slam.cli import main
from slam.live.live_slam import LiveOptions, LiveSlam
from slam.viewer.scene import Scene, ViewOptions

RrdReader = pytest.importorskip("rerun.chunk").RrdReader
POSES = [se3_exp(np.array([0, 0, 0, 0.02 * k, 0, 0])) for k in range(12)]
FRAMES = [render_plane(pose, index) for index, pose in enumerate(POSES)]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """A live run with its recording, and a replay of it."""
    folder = tmp_path_factory.mktemp("view")
    view = ViewOptions(record=folder / "live.rrd")
    with LiveSlam(CAMERA, options=LiveOptions(folder / "run", view=view)) as slam:
        for frame in FRAMES:
            slam.track(frame.timestamp_s, frame.rgb, frame.depth_m)
    assert main(["view", str(folder / "run"), "--record", str(folder / "replay.rrd")]) == 0
    return folder


def entities(path: Path) -> dict[str, int]:
    """Rows by entity path of a recording."""
    found: dict[str, int] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        name = str(chunk.entity_path)
        found[name] = found.get(name, 0) + chunk.num_rows
    return found


@pytest.mark.parametrize("name", ["live.rrd", "replay.rrd"])
def test_the_recording_holds_camera_map_and_plots(recorded, name) -> None:
    rows = entities(recorded / name)
    assert rows["/world/camera"] == len(FRAMES)
    assert rows["/plots/status/status"] == len(FRAMES)
    for path in ("/world/landmarks", "/world/keyframes", "/world/camera/image"):
        assert rows[path] >= 1, path


def test_without_rerun_it_says_what_to_install(monkeypatch, tmp_path) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(InputError, match=r"pip install 'bmask-slam\[view\]'"):
        Scene("a", ViewOptions(record=tmp_path / "a.rrd"))


def test_a_recording_in_no_folder_is_refused(tmp_path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        Scene("a", ViewOptions(record=tmp_path / "none" / "a.rrd"))
