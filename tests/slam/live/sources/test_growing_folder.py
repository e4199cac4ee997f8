"""A folder in TUM layout is read while another thread writes it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from bmask_slam.graph.errors import InputError
from bmask_slam.live.sources.growing_folder import FINISHED, FollowOptions, GrowingFolder
from bmask_slam.sequences.frame import Frame
from bmask_slam.sequences.sequence import open_sequence

CAMERA = "{width: 32, height: 24, fx: 30, fy: 31, cx: 15, cy: 12, depth_scale: 1000}\n"
QUICK = FollowOptions(silence_s=0.5, image_timeout_s=0.3, poll_s=0.002)
PATIENT = FollowOptions(silence_s=300.0, image_timeout_s=300.0, poll_s=0.002)
"""Ends when the folder is finished, however slow its writer is."""
WRITE_S = 0.004


class Recorder:
    """Writes a TUM folder step by step; image k has red 10 k and depth k + 1 decimetres."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "rgb").mkdir(parents=True)
        (folder / "depth").mkdir()
        (folder / "camera.yaml").write_text(CAMERA)

    def lists(self, *names: str) -> None:
        """Make empty lists."""
        for name in names or ("rgb", "depth"):
            (self.folder / f"{name}.txt").touch()

    def line(self, name: str, text: str) -> None:
        """Append this text to a list."""
        with (self.folder / f"{name}.txt").open("a") as file:
            file.write(text)

    def images(self, k: int) -> dict[Path, bytes]:
        """The files of frame k, as bytes."""
        bgr = np.full((24, 32, 3), (200, 20, 10 * k), np.uint8)
        depth = np.full((24, 32), (k + 1) * 100, np.uint16)
        depth[0] = 0
        kinds = {"rgb": bgr, "depth": depth}
        return {
            self.folder / kind / f"{k}.png": cv2.imencode(".png", pixels)[1].tobytes()
            for kind, pixels in kinds.items()
        }

    def write_images(self, k: int) -> None:
        """Write both files of frame k."""
        for path, data in self.images(k).items():
            path.write_bytes(data)

    def frame(self, k: int, lag_s: float = 0.004) -> None:
        """Write the images of frame k, then both lines."""
        self.write_images(k)
        self.line("rgb", f"{k / 10:.6f} rgb/{k}.png\n")
        self.line("depth", f"{k / 10 + lag_s:.6f} depth/{k}.png\n")

    def finish(self) -> None:
        (self.folder / FINISHED).touch()


@pytest.fixture
def recorder(tmp_path: Path) -> Recorder:
    return Recorder(tmp_path / "growing")


def follow_while(
    recorder: Recorder,
    write: Callable[[], None],
    options: FollowOptions = PATIENT,
    given: Callable[[], object] = lambda: None,
) -> list[Frame]:
    """The frames that are read while ``write`` runs in a thread; ``given`` is called at each."""
    thread = threading.Thread(target=write)
    thread.start()
    try:
        source, frames = GrowingFolder(recorder.folder, options=options), []
        for frame in source.frames():
            frames.append(frame)
            given()
    finally:
        thread.join()
    recorder.counts = source.counts
    return frames


def numbers(frames: list[Frame]) -> list[int]:
    """The numbers of the frames, by their pixels; colour and depth must agree."""
    found = [int(frame.rgb[0, 0, 0]) // 10 for frame in frames]
    assert [round(10 * float(frame.depth_m[1, 0])) - 1 for frame in frames] == found
    assert all(np.isnan(frame.depth_m[0]).all() for frame in frames)
    return found


def test_a_growing_folder_gives_the_frames_of_the_finished_one(recorder: Recorder) -> None:
    def write() -> None:
        recorder.lists()
        for k in range(12):
            recorder.frame(k)
            time.sleep(WRITE_S)
        recorder.finish()

    frames = follow_while(recorder, write)
    whole = list(open_sequence(recorder.folder).frames())
    assert len(frames) == len(whole) == 12
    for frame, expected in zip(frames, whole, strict=True):
        assert (frame.index, frame.timestamp_s) == (expected.index, expected.timestamp_s)
        assert frame.name == expected.name
        assert np.array_equal(frame.rgb, expected.rgb)
        assert np.array_equal(frame.depth_m, expected.depth_m, equal_nan=True)
    assert recorder.counts.line() == ""


def test_a_frame_is_given_before_the_next_but_one_is_written(recorder: Recorder) -> None:
    given, in_time = threading.Semaphore(0), []

    def write() -> None:
        recorder.lists()
        for k in range(5):
            if k >= 2:
                in_time.append(given.acquire(timeout=60))
            recorder.frame(k, lag_s=0.0)
        recorder.finish()

    frames = follow_while(recorder, write, given=given.release)
    assert numbers(frames) == [0, 1, 2, 3, 4]
    assert in_time == [True, True, True]


def test_half_written_lines_and_images_are_read_once_complete(recorder: Recorder) -> None:
    """Lines come in pieces and before their images, images in two halves."""

    def write() -> None:
        recorder.lists()
        for k in range(3):
            recorder.line("rgb", f"{k / 10:.6f} rgb/")
            recorder.line("depth", f"{k / 10:.4f}")
            time.sleep(WRITE_S)
            recorder.line("rgb", f"{k}.png\n")
            recorder.line("depth", f" depth/{k}.png\n")
            for path, data in recorder.images(k).items():
                half = len(data) // 2
                with path.open("wb") as file:
                    for part in (data[:half], data[half:]):
                        file.write(part)
                        file.flush()
                        time.sleep(WRITE_S)
        recorder.finish()

    frames = follow_while(recorder, write)
    assert numbers(frames) == [0, 1, 2]
    assert recorder.counts.line() == ""


def test_a_missing_image_costs_only_its_frame(recorder: Recorder) -> None:
    def write() -> None:
        recorder.lists()
        for k in range(4):
            recorder.frame(k)
            if k == 1:
                (recorder.folder / "rgb" / "1.png").unlink()
        recorder.line("rgb", "no line\n")
        time.sleep(2 * QUICK.image_timeout_s)
        recorder.frame(4)
        recorder.finish()

    options = FollowOptions(silence_s=300.0, image_timeout_s=QUICK.image_timeout_s, poll_s=0.002)
    frames = follow_while(recorder, write, options)
    assert numbers(frames) == [0, 2, 3, 4]
    assert [frame.index for frame in frames] == [0, 2, 3, 4]
    assert recorder.counts.broken == 2


@pytest.mark.parametrize(
    "line", ["{s} rgb/{k}.png {s} depth/{k}.png", "{s} depth/{k}.png {s} rgb/{k}.png"]
)
def test_associations_in_either_order(recorder: Recorder, line: str) -> None:
    def write() -> None:
        recorder.lists("associations")
        for k in range(4):
            recorder.write_images(k)
            recorder.line("associations", line.format(s=k / 10, k=k) + "\n")
            time.sleep(WRITE_S)
        recorder.finish()

    frames = follow_while(recorder, write)
    assert numbers(frames) == [0, 1, 2, 3]


def test_it_ends_with_the_last_frame_after_a_timeout(recorder: Recorder) -> None:
    """The last depth image has the later stamp, so that its pair is final only at the end."""
    recorder.lists()
    for k in range(3):
        recorder.frame(k)
    times_s = []
    frames = follow_while(recorder, lambda: None, QUICK, lambda: times_s.append(time.monotonic()))
    assert numbers(frames) == [0, 1, 2]
    assert QUICK.silence_s < time.monotonic() - times_s[1]


def test_a_list_may_be_far_ahead_of_the_other(recorder: Recorder) -> None:
    def write() -> None:
        recorder.lists()
        for k in range(100):
            recorder.line("rgb", f"{k / 10:.6f} rgb/{k % 4}.png\n")
        time.sleep(20 * WRITE_S)
        for k in range(100):
            recorder.line("depth", f"{k / 10 + 0.004:.6f} depth/{k % 4}.png\n")
        recorder.finish()

    for k in range(4):
        recorder.write_images(k)
    frames = follow_while(recorder, write)
    assert numbers(frames) == [k % 4 for k in range(100)]


def test_close_ends_it_at_once(recorder: Recorder) -> None:
    recorder.lists()
    source = GrowingFolder(recorder.folder, options=FollowOptions(silence_s=60))
    threading.Timer(0.1, source.close).start()
    begin_s = time.monotonic()
    assert list(source.frames()) == []
    assert time.monotonic() - begin_s < 50


def test_missing_lists_and_camera_are_waited_for_until_a_timeout(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        GrowingFolder(tmp_path / "none", options=QUICK)
    short = FollowOptions(silence_s=0.05)
    with pytest.raises(InputError, match=r"camera\.yaml"):
        GrowingFolder(tmp_path, options=short)
    (tmp_path / "camera.yaml").write_text(CAMERA)
    with pytest.raises(InputError, match=r"neither rgb\.txt and depth\.txt nor"):
        GrowingFolder(tmp_path, options=short)


def test_stamps_in_milliseconds_are_refused(recorder: Recorder) -> None:
    recorder.lists()
    for k in range(6):
        recorder.line("rgb", f"{33 * k} rgb/{k}.png\n")
    with pytest.raises(InputError, match=r"rgb\.txt.*seconds"):
        list(GrowingFolder(recorder.folder, options=QUICK).frames())
