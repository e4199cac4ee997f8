"""``open_source`` picks the kind of source by its name; ``bmask-slam live`` runs on it."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from recorded_bags import DEPTH, INFO, RGB, BagMaker, camera_info, image, write_bag
from synthetic_view import CAMERA, render_plane

from bmask_slam.cli import main, make_parser
from bmask_slam.commands import live as live_command
from bmask_slam.dense.keyframe_input import frame_index
from bmask_slam.dense.saved_map import open_run
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse, se3_exp
from bmask_slam.graph.trajectory import read_tum
from bmask_slam.live.sources.bag_source import BagSource
from bmask_slam.live.sources.growing_folder import GrowingFolder
from bmask_slam.live.sources.opening import SourceOptions, open_source
from bmask_slam.live.sources.recorded_source import RecordedSource
from bmask_slam.live.sources.source import Source
from bmask_slam.sequences.bags.topics import BagTopics
from bmask_slam.sequences.cameras import write_camera
from bmask_slam.sequences.sequence import Sequence, open_sequence

FRAMES = 8
TRUTH = [se3_exp(np.array([0, 0.01 * k, 0, 0.02 * k, 0, 0])) for k in range(FRAMES)]


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Sequence:
    """A camera that turns and moves sideways before a plane, as a folder."""
    folder = tmp_path_factory.mktemp("sources") / "plane"
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
    write_camera(folder / "camera.yaml", replace(CAMERA, depth_scale=5000.0))
    lines = []
    for k, pose in enumerate(TRUTH):
        frame = render_plane(pose, k)
        lines.append(f"{frame.timestamp_s:.6f} {{}}/{k}.png\n")
        cv2.imwrite(str(folder / f"rgb/{k}.png"), frame.rgb)
        cv2.imwrite(str(folder / f"depth/{k}.png"), np.rint(5000 * frame.depth_m).astype(np.uint16))
    for kind in ("rgb", "depth"):
        (folder / f"{kind}.txt").write_text("".join(lines).format(*[kind] * FRAMES))
    return open_sequence(folder)


@pytest.fixture(scope="module")
def bag(recording: Sequence) -> Path:
    """The recording as a bag; its third colour image has no depth, the fifth comes twice."""
    path = recording.folder.parent / "plane.bag"
    with BagMaker(path) as made:
        info, camera = camera_info((0.0,) * 5), recording.camera
        info.width, info.height, info.k = camera.width, camera.height, camera.K.ravel()
        made.write(INFO, 1.0, info)
        for frame in recording.frames():
            stamp_s = 1000 + frame.timestamp_s
            for _ in range(1 + (frame.index == 4)):
                made.write(RGB, stamp_s, image("rgb8", frame.rgb))
            if frame.index != 2:
                made.write(DEPTH, stamp_s + 0.002, image("32FC1", frame.depth_m))
    return path


def source_of(path: Path | str, **options) -> Source:
    return open_source(str(path), SourceOptions(**options))


def test_the_source_kind_is_chosen_by_name(recording: Sequence, bag: Path, tmp_path: Path) -> None:
    assert isinstance(source_of(recording.folder), RecordedSource)
    assert isinstance(source_of(recording.folder, follow=True), GrowingFolder)
    assert isinstance(source_of(bag), BagSource)
    assert isinstance(source_of(write_bag(tmp_path / "folder")), BagSource)
    assert isinstance(source_of(write_bag(tmp_path / "a.mcap")), BagSource)


def test_recordings_do_not_drop_frames_unless_in_realtime(recording, bag: Path) -> None:
    for path in (recording.folder, bag):
        assert source_of(path).waits
        assert not source_of(path, realtime=True).waits
    assert not source_of(recording.folder, follow=True).waits


def test_any_source_can_be_limited(recording: Sequence, bag: Path) -> None:
    for path, follow in ((recording.folder, False), (recording.folder, True), (bag, False)):
        source = source_of(path, max_frames=3, follow=follow)
        assert [frame.index for frame in source.frames()] == [0, 1, 2]
        source.close()


def test_a_folder_counts_unpaired_images(recording: Sequence) -> None:
    assert source_of(recording.folder).counts.line() == ""


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("nowhere", "not a source; give a recording"),
        ("nowhere.bag", "no such bag"),
        ("opencv:x", "write e.g. opencv:0"),
        ("opencv:0", "give --camera F"),
    ],
)
def test_other_names_are_refused(text: str, reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        source_of(text)


@pytest.mark.parametrize(("name", "value"), [("max_frames", 0), ("silence_s", -1.0)])
def test_numbers_out_of_range_are_refused(name: str, value: float) -> None:
    with pytest.raises(
        InputError, match=f"--{name.removesuffix('_s').replace('_', '-')} {value:g}"
    ):
        SourceOptions(**{name: value})


def test_gaps_of_a_recording_are_counted(recording: Sequence, tmp_path: Path) -> None:
    whole, path = source_of(recording.folder), tmp_path / "seq"
    assert len(list(whole.frames())) == FRAMES and whole.counts.gaps == 0
    shutil.copytree(recording.folder, path)
    for name in ("rgb.txt", "depth.txt"):  # a step of four after frame 2
        lines = (path / name).read_text().splitlines(keepends=True)
        (path / name).write_text("".join(lines[:3] + lines[6:]))
    source = source_of(path)
    assert len(list(source.frames())) == FRAMES - 3
    assert source.counts.line() == "1 gaps"


def test_live_on_a_bag(recording: Sequence, bag: Path, tmp_path: Path, capsys) -> None:
    assert main(["live", str(bag), "--out", str(tmp_path / "run")]) == 0
    counts = "1 unpaired rgb, 1 duplicates"
    assert f"Source      {counts}" in capsys.readouterr().out
    found = read_tum(tmp_path / "run" / "trajectory.txt")
    expected_s = 1000 + np.delete(recording.timestamps_s, 2)
    assert np.allclose(found.timestamps_s, expected_s, atol=1e-6)
    T_first_last = inverse(found.poses_world_camera[0]) @ found.poses_world_camera[-1]
    expected = inverse(TRUTH[0]) @ TRUTH[-1]
    assert np.allclose(T_first_last, expected, atol=0.002)
    mapped = open_run(tmp_path / "run")  # the run knows its bag
    assert mapped.sequence.folder == bag.absolute()
    assert frame_index(mapped, mapped.keyframes[0]) == 0
    source = json.loads((tmp_path / "run" / "health.json").read_text())["source"]
    assert (source["unpaired_rgb"], source["duplicates"], source["gaps"]) == (1, 1, 0)
    assert main(["map", str(tmp_path / "run"), "--mesh-voxel", "0.04", "--quiet"]) == 0
    assert (tmp_path / "run" / "dense" / "cloud.ply").is_file()


def test_run_and_map_on_a_bag(recording: Sequence, bag: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "run"
    words = ["run", f"{bag}", "--segmenter", "none", "--calibrate", "off", "--out", f"{out}"]
    assert main([*words, "--rgb-topic", RGB]) == 0
    found = read_tum(out / "trajectory.txt")
    assert np.allclose(found.timestamps_s, 1000 + np.delete(recording.timestamps_s, 2), atol=1e-6)
    T_first_last = inverse(found.poses_world_camera[0]) @ found.poses_world_camera[-1]
    assert np.allclose(T_first_last, inverse(TRUTH[0]) @ TRUTH[-1], atol=0.002)
    assert main(["map", str(out), "--mesh-voxel", "0.04", "--quiet"]) == 0
    assert (out / "dense" / "cloud.ply").is_file()


def test_the_commands_options_reach_the_source() -> None:
    plain = live_command.source_options(make_parser().parse_args(["live", "a"]))
    assert plain == SourceOptions()
    words = "live a --follow --silence 3 --realtime --max-frames 7 --camera c.yaml"
    topics = "--rgb-topic /r --depth-topic /d --camera-info-topic /i"
    given = live_command.source_options(make_parser().parse_args(f"{words} {topics}".split()))
    expected = SourceOptions(Path("c.yaml"), True, 7, True, 3.0, BagTopics("/r", "/d", "/i"))
    assert given == expected


def test_info_lists_the_topics_of_a_bag(bag: Path, capsys) -> None:
    assert main(["info", str(bag)]) == 0
    out = capsys.readouterr().out
    assert [topic in out for topic in (RGB, DEPTH, INFO)] == [True] * 3
    assert f"{FRAMES + 1} messages" in out
