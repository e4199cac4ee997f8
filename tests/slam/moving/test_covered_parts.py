"""Parts of the image that are attached to the camera: found in moving textures, and in runs."""

from __future__ import annotations

import signal
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from fake_run import FakeSystem, make_sequence, signal_at

from bmask_slam.config.configuration import resolve
from bmask_slam.evaluation import plot
from bmask_slam.graph.arrays import Image, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.moving.covered_parts import CoveredWatch, find_covered_parts, rectangles_of
from bmask_slam.offline.runner import RunOptions, resume, run
from bmask_slam.sequences.cameras import read_camera
from bmask_slam.sequences.frame import Frame
from bmask_slam.system_config import SystemConfig

SIZE = 640, 480
STRIP = (0, 400, 640, 480)
FRAMES = 60
STAMPS_S = np.arange(FRAMES) / 10
Read = Callable[[int], Image]


def texture(seed: int, width: int, height: int) -> Image:
    """Spots of several sizes (height, width, 3)."""
    rng = np.random.default_rng(seed)
    total = sum(
        cv2.resize(rng.uniform(0, 110, (height // n, width // n, 3)), (width, height))
        for n in (4, 8, 20)
    )
    return np.clip(total, 0, 255).astype(np.uint8)


ROOM = texture(1, 1600, 480)
ROBOT = texture(2, *SIZE)
PEOPLE = [texture(n, *SIZE) for n in (3, 4, 5)]


def moving(k: int) -> Image:
    """The room as a camera that turns sees it."""
    start = (37 * k) % 900
    return np.ascontiguousarray(ROOM[:, start : start + SIZE[0]])


def with_robot(k: int) -> Image:
    image = moving(k)
    image[STRIP[1] :] = ROBOT[STRIP[1] :]
    return image


def found(read: Read, frames: int = FRAMES) -> tuple[tuple[int, int, int, int], ...]:
    return find_covered_parts(read, STAMPS_S[:frames], SIZE)


def test_a_robot_in_view_is_found() -> None:
    assert found(with_robot) == (STRIP,)
    assert found(moving) == ()


def test_a_spot_on_the_lens_is_found_and_nothing_beside_it() -> None:
    spot = cv2.circle(np.zeros(SIZE[::-1], np.uint8), (300, 200), 50, 255, -1) > 0

    def read(k: int) -> Image:
        return np.where(spot[..., None], ROBOT, moving(k))

    covered = ~Camera(*SIZE, 500, 500, 320, 240, covered=found(read)).visible()
    assert covered[170:230, 270:330].mean() > 0.8
    assert (covered & ~cv2.dilate(spot.astype(np.uint8), np.ones((33, 33))).astype(bool)).sum() == 0


def test_light_that_changes_is_no_motion() -> None:
    gain = 1 + 0.3 * np.sin(0.5 * np.arange(FRAMES))

    def read(k: int) -> Image:
        return np.clip(0.7 * gain[k] * with_robot(k), 0, 255).astype(np.uint8)

    assert found(read) == (STRIP,)


def test_a_camera_at_rest_shows_nothing() -> None:
    assert found(lambda _: with_robot(3)) == ()


def test_a_camera_that_drives_straight_on_keeps_what_is_ahead() -> None:
    wall = texture(7, 1920, 1440)

    def read(k: int) -> Image:
        share = 0.95 - 0.55 * (k % 30) / 30
        width, height = round(1920 * share), round(1440 * share)
        left, top = (1920 - width) // 2, (1440 - height) // 2
        return cv2.resize(wall[top : top + height, left : left + width], SIZE)

    assert found(read) == ()


def test_a_robot_that_rests_most_of_the_time_is_found() -> None:
    stamps_s = np.arange(1200) / 10

    def read(k: int) -> Image:
        return with_robot(min(k, 300))

    assert find_covered_parts(read, stamps_s, SIZE) == (STRIP,)


def test_a_resting_camera_in_a_crowd_keeps_its_image() -> None:
    """People who walk by leave each part of the wall in view now and then, but never all of it."""
    rng = np.random.default_rng(5)
    places = rng.integers(-100, 600, (FRAMES, 3))

    def read(k: int) -> Image:
        image = moving(0)
        for n, left in enumerate(places[k].tolist()):
            columns = slice(max(left, 0), min(left + 150, SIZE[0]))
            image[60:, columns] = PEOPLE[n][60:, columns]
        return image

    assert found(read) == ()


def test_few_pairs_and_broken_images() -> None:
    assert found(with_robot, 12) == ()
    assert found(with_robot, 0) == ()

    def read(k: int) -> Image:
        if k % 3 == 0:
            raise InputError("broken")
        return with_robot(k)

    assert found(read) == (STRIP,)


def test_a_frame_of_another_size_is_refused_as_by_tracking() -> None:
    watch, camera = CoveredWatch(), Camera(*SIZE, 500, 500, 320, 240)
    depth_m = np.ones(SIZE[::-1], np.float32)
    assert watch.look(Frame(0, 0.0, with_robot(0), depth_m), camera) is None
    with pytest.raises(InputError, match="resize it, or correct the camera"):
        watch.look(Frame(1, 0.5, with_robot(1)[:99], depth_m), camera)


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        (["..", ".."], ()),
        (["##", "##"], ((0, 0, 32, 32),)),
        (["#.", "##"], ((0, 0, 16, 16), (0, 16, 32, 32))),
        (["#.", "#.", ".#"], ((0, 0, 16, 32), (16, 32, 32, 48))),
    ],
)
def test_cells_become_rectangles(rows: list[str], expected: tuple) -> None:
    cells: Mask = np.array([[c == "#" for c in row] for row in rows])
    assert rectangles_of(np.pad(cells, ((0, 28), (0, 38))), SIZE) == expected


# --- in a run -------------------------------------------------------------------------------------

SMALL = 320, 240
SMALL_STRIP = 0, 200, 320, 240


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    """Forty frames of a camera on a robot that it sees."""
    folder = make_sequence(tmp_path / "seq", 40)
    text = (folder / "camera.yaml").read_text().replace("width: 32", "width: 320")
    (folder / "camera.yaml").write_text(text.replace("height: 24", "height: 240"))
    for k in range(40):
        image = cv2.resize(with_robot(k), SMALL, interpolation=cv2.INTER_AREA)
        image[0, 0] = 9, 9, k
        cv2.imwrite(str(folder / f"rgb/{k}.png"), image)
        cv2.imwrite(str(folder / f"depth/{k}.png"), np.full(SMALL[::-1], 1500, np.uint16))
    return folder


@pytest.fixture(autouse=True)
def quick_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plot, "plot_trajectory", lambda path, *_: path.write_text("quick"))


def options(sequence: Path, **changes: Any) -> RunOptions:
    return RunOptions(
        sequence, resolve(SystemConfig), out=sequence.parent / "out", quiet=True, **changes
    )


def test_a_run_leaves_it_out_and_says_so(sequence: Path) -> None:
    seen: list[np.ndarray] = []

    class System(FakeSystem):
        def process(self, frame: Any) -> Any:
            seen.append(frame.depth_m)
            return super().process(frame)

    summary = run(options(sequence), System)
    text = "16.7% of the image never moves: the robot itself, an overlay or dirt on the lens"
    assert summary.calibration == f"{text}: left out"
    assert f"calibration: {text}: left out" in (summary.folder / "log.txt").read_text()
    given = read_camera(sequence / "camera.yaml")
    used = read_camera(summary.folder / "camera.yaml")
    assert used == replace(given, covered=(SMALL_STRIP,))
    assert np.isnan(seen[5][200:]).all() and (seen[5][:200] == 1.5).all()


def test_told_and_not_looked_for(sequence: Path) -> None:
    summary = run(options(sequence, calibrate="report"), FakeSystem)
    assert summary.calibration.endswith("dirt on the lens: found, not left out")
    assert not (summary.folder / "camera.yaml").exists()
    summary = run(options(sequence, calibrate="off", overwrite=True), FakeSystem)
    assert summary.calibration == ""
    given = (sequence / "camera.yaml").read_text().replace("}", ", covered: [[0, 0, 9, 9]]}")
    (sequence / "camera.yaml").write_text(given)
    summary = run(options(sequence, overwrite=True), FakeSystem)
    assert summary.calibration == ""


def test_a_stopped_run_goes_on_with_it(sequence: Path) -> None:
    cameras: list[Camera] = []

    def make(camera: Camera, config: SystemConfig, **more: Any) -> FakeSystem:
        cameras.append(camera)
        return FakeSystem(camera, config, **more)

    stop = partial(make, on_frame=signal_at(20, signal.SIGTERM))
    stopped = run(options(sequence, checkpoint_every=5), stop)
    assert stopped.resumable
    done = resume(stopped.folder, {"quiet": True}, make)
    assert done is not None and done.frames == 40
    assert cameras[0] == cameras[1] and cameras[0].covered == (SMALL_STRIP,)
