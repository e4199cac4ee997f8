"""A run whose map and masks are in other processes: it repeats, is resumed, and survives them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from faults import children, wait_until

from bmask_slam.config.configuration import from_tree
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.trajectory import read_tum
from bmask_slam.labelling.awaited_masks import LAG
from bmask_slam.live.messages import ImageToSegment, Masks, Ready
from bmask_slam.live.processes import segmentation
from bmask_slam.offline.runner import RunOptions, resume, run
from bmask_slam.parallel import lockstep
from bmask_slam.parallel.lockstep import MOST_LAG, LockstepSegmenter
from bmask_slam.parallel.system import ParallelSystem
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions
from bmask_slam.semantics.segmenters.upright import Upright
from bmask_slam.sequences.frame import Frame
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import FrameResult

FRAMES, EVERY = 20, 6
SAME = ("trajectory.txt", "keyframes.txt", "landmarks.ply", "events.csv", "map", "labels.csv")


def options(sequence: Path, out: Path, segmenter: str = "none", **more: object) -> RunOptions:
    config = from_tree(SystemConfig, {"semantics": {"segmenter": {"name": segmenter}}}, "test")
    return RunOptions(
        sequence, config, out=out, quiet=True, max_frames=FRAMES, parallel=True, **more
    )


def result(folder: Path) -> dict[str, bytes]:
    """The files of a run that hold no times."""
    return {name: (folder / name).read_bytes() for name in SAME if (folder / name).exists()}


def with_each_frame(
    monkeypatch: pytest.MonkeyPatch, do: Callable[[ParallelSystem, int], object]
) -> None:
    """Do something before each frame is tracked."""
    process = ParallelSystem.process

    def then(system: ParallelSystem, frame: Frame, *more: object) -> FrameResult:
        do(system, frame.index)
        return process(system, frame, *more)

    monkeypatch.setattr(ParallelSystem, "process", then)


@pytest.fixture(scope="module")
def whole(slow_office: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with true masks and checkpoints."""
    out = tmp_path_factory.mktemp("parallel") / "run"
    return run(options(slow_office, out, "truth", checkpoint_every=EVERY)).folder


def test_it_tracks_as_well_as_one_process_does(slow_office: Path, whole: Path, tmp_path) -> None:
    alone = run(RunOptions(slow_office, out=tmp_path / "run", quiet=True, max_frames=FRAMES))
    ours, theirs = (read_tum(path / "trajectory.txt") for path in (whole, alone.folder))
    assert len(ours) == len(theirs) == FRAMES
    apart_m = np.linalg.norm(
        ours.poses_world_camera[:, :3, 3] - theirs.poses_world_camera[:, :3, 3], axis=1
    )
    assert apart_m.max() < 0.02
    assert "labels.csv" in result(whole)


def test_it_repeats_its_bytes_however_fast_the_others_are(
    slow_office: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here answers wait for tracking, in the other run tracking waits for them."""
    with_each_frame(monkeypatch, lambda system, index: time.sleep(0.1 * (index % 3)))
    again = run(options(slow_office, tmp_path / "run", "truth", checkpoint_every=EVERY))
    assert result(again.folder) == result(whole)
    assert not children()


def test_killed_and_resumed_it_ends_in_the_same_bytes(
    slow_office: Path, whole: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    words = ["--segmenter", "truth", "--parallel", "--checkpoint-every", str(EVERY), "--quiet"]
    command = [sys.executable, "-m", "bmask_slam", "run", str(slow_office), "--out", str(out)]
    process = subprocess.Popen([*command, *words, "--max-frames", str(FRAMES)])

    def has_written_15_frames() -> bool:
        frames = out / "frames.csv"
        return frames.is_file() and len(frames.read_text().splitlines()) > 15

    wait_until(has_written_15_frames)
    process.kill()
    process.wait()
    assert resume(out) is not None
    assert result(out) == result(whole)


def test_it_goes_on_when_the_maps_process_dies(
    slow_office: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def kill(system: ParallelSystem, index: int) -> None:
        if index == FRAMES // 2:
            os.kill(system.remote.worker.pid, signal.SIGKILL)

    with_each_frame(monkeypatch, kill)
    folder = run(options(slow_office, tmp_path / "run")).folder
    assert len(read_tum(folder / "trajectory.txt")) == FRAMES
    assert "does not give the same bytes again" in (folder / "log.txt").read_text()


def test_a_wrong_voxel_is_refused_before_the_first_frame(slow_office: Path, tmp_path) -> None:
    wrong = options(slow_office, tmp_path / "run", dense=True, mesh_voxel_m=-1.0)
    with pytest.raises(InputError, match=r"voxel -1\.0 m: must be between"):
        run(wrong)
    assert not (tmp_path / "run").exists()


def test_a_map_of_another_run_is_refused(slow_office: Path, whole: Path) -> None:
    with pytest.raises(InputError, match=r"--parallel: .* without --continue"):
        options(slow_office, whole, map=whole)


def test_masks_of_the_first_keyframe_are_used_before_the_next_frame(
    slow_office: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    awaited: dict[int, list[bool]] = {}

    def look(system: ParallelSystem, index: int) -> None:
        assert system.segmenter is not None
        awaited[index] = [system.segmenter.awaits(k) for k in system.map.world.keyframes]

    with_each_frame(monkeypatch, look)
    run(options(slow_office, tmp_path / "run", "truth"))
    assert awaited[1] == [True]
    assert awaited[2][0] is False
    assert any(any(others[1:]) for others in awaited.values())  # later ones have time


def test_landmarks_of_a_keyframe_come_before_what_the_graph_makes_of_them(
    slow_office: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lockstep, "LAG_S", 1.0)
    waits: list[bool] = []

    def look(system: ParallelSystem, index: int) -> None:
        world, ahead = system.map.world, system.map.landmarks_ahead
        hosts = world.landmarks.host[ahead]
        for keyframe in world.keyframes.values():
            if index > keyframe.frame_index + LAG:
                assert not (hosts == keyframe.id).any()
                waits.append(system.remote.awaits(keyframe.id))

    with_each_frame(monkeypatch, look)
    run(options(slow_office, tmp_path / "run"))
    assert any(waits) and not all(waits)


class SlowWorker(SimpleNamespace):
    """A segmenter's process whose masks have come when they were asked for three times."""

    def __init__(self, *_: object) -> None:
        super().__init__(asked={}, seen=[], crashes=0, given_up=False, is_away=False, labels=())

    def wait_until_ready(self) -> Ready:
        return Ready(("cup",))

    def send(self, image: ImageToSegment, _: bool = False) -> None:
        self.asked[image.keyframe_id] = 3
        self.seen.append(image.name)

    def receive(self) -> list[Masks]:
        self.asked = {number: left - 1 for number, left in self.asked.items()}
        return [Masks(number, []) for number, left in self.asked.items() if left == 0]

    def restart_if_needed(self, busy: bool) -> bool:
        return False


@pytest.mark.parametrize(
    ("hz", "lag"), [(30.0, 8), (60.0, 15), (12.0, 3), (1.0, LAG), (1e6, MOST_LAG)]
)
def test_masks_are_used_some_frames_later_and_made_once_an_image(
    monkeypatch: pytest.MonkeyPatch, hz: float, lag: int
) -> None:
    monkeypatch.setattr(segmentation, "SupervisedWorker", SlowWorker)
    segmenter = LockstepSegmenter(SegmenterOptions("light"), Path(), Upright())
    image = np.zeros((2, 2, 3), np.uint8)
    for _ in range(2):  # the run begins anew
        segmenter.begin()
        used = []
        for frame in range(lag + 5):
            segmenter.begin_frame(1e9 + frame / hz)
            used += [(frame, masks.keyframe_id) for masks in segmenter.receive_masks()]
            if frame in (0, 1, 4):
                segmenter.request(ImageToSegment(frame, image, f"{frame}.png"))
        assert used == [(lag, 0), (lag + 1, 1), (lag + 4, 4)]
        assert segmenter.waiting == 0
    assert segmenter.worker.seen == ["0.png", "1.png", "4.png"]
    segmenter.request(ImageToSegment(9, image, "9.png"))
    assert segmenter.awaits(9)
    segmenter.use_all()
    assert [masks.keyframe_id for masks in segmenter.receive_masks()] == [9]
