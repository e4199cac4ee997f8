"""frames.csv: what is written is read back; files of older versions are read too."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bmask_slam.events import Event, EventKind, read_events
from bmask_slam.graph.errors import InputError
from bmask_slam.run_folder.folder import RunFolder
from bmask_slam.run_folder.frame_file import read_frames
from bmask_slam.run_folder.reader import Run
from bmask_slam.tracking.results import FrameResult, TrackingStatus

RESULTS = (
    FrameResult(
        *(4, 1.25, TrackingStatus.OK, np.eye(4)),
        matches=9,
        inliers=8,
        ignored=7,
        mostly_moving=True,
        keyframe_id=0,
        keyframe_reason="first frame",
        stage_ms={"tracking": 1.5, "graph": 0.25},
    ),
    FrameResult(6, 1.5, TrackingStatus.LOST, None, segment=2),
)


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    with RunFolder(tmp_path) as folder:
        for result in RESULTS:
            folder.write_frame(result)
    frames = read_frames(tmp_path / "frames.csv")
    assert len(frames) == 2
    assert (frames.index.tolist(), frames.timestamps_s.tolist()) == ([4, 6], [1.25, 1.5])
    assert (frames.status, frames.segment.tolist()) == (("OK", "LOST"), [0, 2])
    counts = frames.matches, frames.inliers, frames.ignored
    assert [count.tolist() for count in counts] == [[9, 0], [8, 0], [7, 0]]
    assert frames.mostly_moving.tolist() == [True, False]
    assert frames.keyframe_ids.tolist() == [0, -1]
    assert frames.keyframe_reasons == ("first frame", "")
    np.testing.assert_array_equal(frames.stage_ms["tracking"], [1.5, np.nan])


def test_a_run_without_frames_has_no_rows(tmp_path: Path) -> None:
    with RunFolder(tmp_path):
        pass
    frames = read_frames(tmp_path / "frames.csv")
    assert (len(frames), frames.status, frames.stage_ms["loops"].shape) == (0, (), (0,))


def test_columns_that_older_versions_did_not_write_have_defaults(tmp_path: Path) -> None:
    path = tmp_path / "frames.csv"
    path.write_text("index,timestamp,status,keyframe\n0,0.5,OK,0\n1,0.6,WEAK,\n")
    frames = read_frames(path)
    assert frames.keyframe_ids.tolist() == [0, -1]
    assert frames.mostly_moving.tolist() == [False, False]
    assert np.isnan(frames.stage_ms["features"]).all()


def test_a_value_that_is_no_number_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "frames.csv"
    path.write_text("index,timestamp,status,keyframe\nfour,0.5,OK,0\n")
    with pytest.raises(InputError, match=r"frames\.csv: .*'four'; run again"):
        read_frames(path)
    with pytest.raises(InputError, match=r"none\.csv: no such file"):
        read_frames(tmp_path / "none.csv")


EVENTS = (
    Event(3, 1305031102.175304, EventKind.CALIBRATION, 'rolling shutter 17.0 ± 2.2 ms, "found"'),
    Event(4, 1305031102.211214, EventKind.LOOP_REFUSED, "keyframes 3 and 9: too few, limit 15"),
    Event(4, 1305031102.211214, EventKind.GRAPH, "2 observations refused: reprojection"),
)


def test_events_are_read_back_also_by_a_run(tmp_path: Path) -> None:
    with RunFolder(tmp_path) as folder:
        folder.write_events(EVENTS[:1])
        folder.write_frame(replace(RESULTS[0], events=EVENTS[1:]))
        assert read_events(tmp_path) == EVENTS  # on disk at once
    assert Run(tmp_path).events == EVENTS
    with (tmp_path / "events.csv").open("a") as file:
        file.write("5,1305031102.2,lo")
    assert read_events(tmp_path) == EVENTS  # a killed run's last line


def test_a_run_of_a_version_without_events_has_none(tmp_path: Path) -> None:
    (tmp_path / "frames.csv").write_text("index,timestamp,status,keyframe\n0,0.5,OK,0\n")
    assert Run(tmp_path).events == ()


def test_events_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    for line, what in (("x,1.0,lost,", "'x'"), ("1,1.0,found,", "'found' is not a valid")):
        (tmp_path / "events.csv").write_text(f"index,timestamp,kind,text\n{line}\n")
        with pytest.raises(InputError, match=rf"events\.csv: .*{what}.*; run again"):
            read_events(tmp_path)
