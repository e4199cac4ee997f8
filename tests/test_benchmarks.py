"""The benchmarks import and start, and pages under docs/results/ state how they were made."""

from __future__ import annotations

import importlib
import json
import logging
import os
import re
import signal
import subprocess
import sys
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import cv2
import numpy as np
import pytest
from repository import ROOT

from benchmarks.cameras.mirrored import CHANGES, write_changed
from benchmarks.cameras.orb_slam3 import settings_of
from benchmarks.cameras.orb_vocabulary import lines_of, nearest
from benchmarks.live.session import Rounds
from benchmarks.machine import own_mb, resident_mb
from benchmarks.pages import table, written_sections
from benchmarks.paths import RESULTS
from benchmarks.scale import day
from benchmarks.section_report import REPORTS
from benchmarks.semantics.mounted import write_turned
from benchmarks.semantics.real_rooms import ROOMS, score_objects
from benchmarks.semantics.room_truth import centre_in, moved
from benchmarks.suite import never_lost
from benchmarks.suite.measure import in_own_process, stage_times
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse, se3_exp, transform
from bmask_slam.graph.trajectory import Trajectory, read_tum, write_tum
from bmask_slam.run_folder.frame_file import read_frames
from bmask_slam.run_folder.semantic_files import SavedObject
from bmask_slam.semantics.objects.boxes3d import OrientedBox
from bmask_slam.sequences.cameras import read_camera, write_camera
from bmask_slam.sequences.lists import read_lists
from bmask_slam.sequences.sequence import open_sequence

SCRIPTS = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path in sorted((ROOT / "benchmarks").rglob("*.py"))
]


def test_every_script_starts(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    """All in one process, since importing the libraries takes most of the time."""
    for module in SCRIPTS:
        monkeypatch.setattr(sys, "argv", [module, "--help"])
        code = importlib.import_module(module)
        if hasattr(code, "main"):
            with pytest.raises(SystemExit) as end:
                code.main()
            assert end.value.code == 0, module
            assert "usage:" in capsys.readouterr().out
        assert logging.getLogger("bmask_slam").level == logging.NOTSET, module


def test_a_script_runs_as_its_description_says() -> None:
    command = ["-m", "benchmarks.semantics.label_store", "--landmarks", "10", "--repeats", "2"]
    done = subprocess.run(
        [sys.executable, *command], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("10 landmarks,")


def test_minutes_of_a_simulated_robot_stay_true(tmp_path: Path, monkeypatch, capsys) -> None:
    given = ["--hours", "0.03", "--storeys", "1", "--keypoints", "120", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["day", *given])
    day.main()
    heads, *rows, events, optimised = capsys.readouterr().out.splitlines()
    assert optimised.startswith("last optimisation")
    assert len(rows) == 4
    last = dict(zip(heads.split(), map(float, rows[-1].split()), strict=True))
    assert 20 < last["keyframes"] <= 75
    assert last["ate_mm"] < 50
    assert last["wrong"] == 0
    assert "refused: keyframe" not in events
    assert (tmp_path / "day.png").stat().st_size > 10_000
    assert len(json.loads((tmp_path / "day.json").read_text())) == 4


@pytest.mark.parametrize("report", REPORTS.values(), ids=REPORTS)
def test_every_section_names_command_commit_and_date(report) -> None:
    commands = {
        title: f"benchmarks.{given.split()[0]}"
        for title, given in report.sections.values()
        if given
    }
    titles = [title for title, _ in report.sections.values()]
    written = written_sections(report.path)
    assert written
    for section in written:
        assert section.title in titles
        if section.title not in commands:  # written by hand
            continue
        assert section.module == commands[section.title]
        assert section.module in SCRIPTS
        assert section.machine, section.title
        assert section.commit, section.title
        assert section.date, section.title


def test_the_page_of_make_bench_names_commands_commit_and_date() -> None:
    page = (RESULTS / "benchmarks.md").read_text(encoding="utf-8")
    assert re.search(
        r"; commit [0-9a-f]{12}.*; \d{4}-\d\d-\d\d \d\d:\d\d UTC; by `make bench`", page
    )
    assert "\nbmask-slam run " in page.partition("## Commands")[2]


def test_a_section_without_a_stamp_is_reported(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    stamp = "CPU; commit 0123abcd with changes in a.py; 2026-01-02 03:04 UTC; 5 s."
    command = "`python -m benchmarks.loops.loop_closing corridor`"
    page.write_text(f"# Page\n\n## One\n\n{command}\n\n{stamp}\n\n## Two\n\nnothing\n")
    one, two = written_sections(page)
    assert (one.module, one.machine, one.commit, one.date) == (
        "benchmarks.loops.loop_closing", "CPU", "0123abcd", "2026-01-02 03:04"
    )  # fmt: skip
    assert (two.title, two.module, two.commit, two.date) == ("Two", "", "", "")


def test_a_table_has_one_cell_under_each_heading() -> None:
    assert table(("a", "b"), [("1", "2")]) == "| a | b |\n| --- | --- |\n| 1 | 2 |"
    with pytest.raises(ValueError, match="1 cells under 2"):
        table(("a", "b"), [("1",)])


def test_a_recording_that_is_missing_is_no_rendered_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(never_lost, "SHARED", tmp_path)
    for entry in never_lost.INPUTS.values():
        if entry.source not in never_lost.RENDERED:
            with pytest.raises(InputError, match=entry.source):
                never_lost.sequence_of(entry, tmp_path / "into")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("room", ROOMS)
def test_objects_that_are_the_truth_are_right_in_any_world(room: str) -> None:
    truth = json.loads((ROOT / "tests" / "data" / f"{room}_truth.json").read_text())
    T_truth_world = se3_exp(np.array([0.3, -1.2, 0.5, 2.0, -1.0, 0.7]))
    found = []
    for k, o in enumerate(truth["objects"]):
        T = np.eye(4)
        T[:3, 3] = o["centre_m"]
        box = OrientedBox(inverse(T_truth_world) @ T, np.array(o["size_m"]))
        none = np.zeros(0, np.int64)
        found.append(SavedObject(k, o["labels"][0], 0.9, T[:3, 3], box, none, none, 0.0, 1.0))
    score = score_objects(found, truth, T_truth_world)
    assert score.reported == score.right == score.true
    elsewhere = score_objects(found, truth, T_truth_world @ T_truth_world)
    assert elsewhere.right == 0


@pytest.mark.parametrize("room", ROOMS)
def test_every_point_of_a_room_is_of_a_known_kind(room: str) -> None:
    truth = json.loads((ROOT / "tests" / "data" / f"{room}_truth.json").read_text())
    up = np.array(truth["up"])
    for x, y, z, *_, kind in truth["points"]:
        assert kind in truth["kinds"]
        height_m = up @ [x, y, z] - truth["floor_m"]
        assert -0.1 < height_m < 3, kind  # metres above the floor
        assert kind != "floor" or height_m < 0.1
        assert not kind.startswith("table") or 0.6 < height_m < 0.8


def test_a_truth_moves_with_the_depth_that_a_run_straightens() -> None:
    camera = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
    T_world_camera = se3_exp(np.array([0.3, -1.2, 0.5, 2.0, -1.0, 0.7]))
    pixel, z_m = np.array([500.0, 100.0]), 4.0
    ray = camera.backproject(pixel, np.array(1.0))
    place = transform(T_world_camera, z_m * ray[None])[0]
    bend = np.array([0.01, 0.0, 0.02, 0.0, 0.0])
    x = (500 - 319.5) / 320
    straight_m = 1 / (1 / z_m - 0.01 * x - 0.02 * x**2)
    expected = transform(T_world_camera, straight_m * ray[None])[0]
    assert moved(place, pixel, T_world_camera, camera, bend) == pytest.approx(expected)
    assert centre_in(place, T_world_camera, camera, bend) == pytest.approx(expected.tolist())
    away = T_world_camera @ np.diag([-1, 1, -1, 1.0])  # turned by half a turn
    assert centre_in(place, away, camera, bend) == []


def write_recording(folder: Path, camera: Camera) -> Trajectory:
    """Three images of noise, with stamps that are not evenly spaced, and their poses."""
    rng, stamps_s = np.random.default_rng(4), np.array([10.0, 10.1, 10.25])
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
        for k in range(3):
            image = rng.integers(0, 255, (camera.height, camera.width), dtype=np.uint8)
            cv2.imwrite(str(folder / kind / f"{k}.png"), image)
        rows = (f"{stamp:.6f} {kind}/{k}.png\n" for k, stamp in enumerate(stamps_s))
        (folder / f"{kind}.txt").write_text("".join(rows), encoding="utf-8")
    truth = Trajectory(stamps_s, np.array([se3_exp(0.1 * rng.normal(size=6)) for _ in range(3)]))
    write_camera(folder / "camera.yaml", camera)
    write_tum(folder / "groundtruth.txt", truth)
    return truth


def check_same_pixel(first: tuple[Path, Array], second: tuple[Path, Array], number: int) -> None:
    """Colour and depth at a pixel (2,) of one recording are those at a pixel of another."""
    for kind in ("rgb", "depth"):
        found = []
        for folder, pixel in (first, second):
            u, v = np.rint(pixel).astype(int)
            image = cv2.imread(str(folder / kind / f"{number}.png"), cv2.IMREAD_UNCHANGED)
            found.append(image[v, u])
        assert found[0] == found[1]


@pytest.mark.parametrize("name", CHANGES)
def test_a_changed_recording_is_one_that_a_camera_could_have_made(name, tmp_path: Path) -> None:
    """The changed camera sees a flipped point where the flipped image shows what the point is."""
    change, bent = CHANGES[name], (0.2, -0.6, 0.003, -0.002, 0.7)
    camera = Camera(64, 48, fx=52.0, fy=51.0, cx=30.2, cy=25.1, distortion=bent)
    source, out = tmp_path / "source", tmp_path / "out"
    poses = write_recording(source, camera).poses_world_camera
    write_changed(source, out, change)
    changed, truth = read_camera(out / "camera.yaml"), read_tum(out / "groundtruth.txt")
    sign = np.array([-1.0 if change.left_right else 1.0, -1.0 if change.upside_down else 1.0, 1.0])
    colour, _ = read_lists(out)
    np.testing.assert_allclose(colour.timestamps_s, truth.timestamps_s)
    order = [2, 1, 0] if change.upside_down else [0, 1, 2]
    assert [file.name for file in colour.files] == [f"{k}.png" for k in order]
    for k, T_world_changed in zip(order, truth.poses_world_camera, strict=True):
        point = transform(poses[k], np.array([[0.2, -0.3, 1.5]]))
        (seen,) = camera.project_distorted(transform(inverse(poses[k]), point))
        (again,) = changed.project_distorted(transform(inverse(T_world_changed), point * sign))
        check_same_pixel((source, seen), (out, again), k)


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_a_turned_recording_shows_the_same_world(turns: int, tmp_path: Path) -> None:
    """The turned camera sees a point where the turned image shows it."""
    camera = Camera(64, 48, fx=52.0, fy=51.0, cx=30.2, cy=25.1, distortion=(0.2, -0.6, 0, 0, 0))
    source, out = tmp_path / "source", tmp_path / "out"
    poses = write_recording(source, camera).poses_world_camera
    write_turned(source, out, turns)
    turned, truth = read_camera(out / "camera.yaml"), read_tum(out / "groundtruth.txt")
    for k, T_world_turned in enumerate(truth.poses_world_camera):
        point = transform(poses[k], np.array([[0.2, -0.3, 1.5]]))
        (seen,) = camera.project_distorted(transform(inverse(poses[k]), point))
        (again,) = turned.project_distorted(transform(inverse(T_world_turned), point))
        check_same_pixel((source, seen), (out, again), k)


def test_a_vocabulary_is_a_tree_that_orb_slam_can_read() -> None:
    """Parents come before children, each has ten at most, and every descriptor reaches a word."""
    rng = np.random.default_rng(4)
    centres = rng.integers(0, 256, (40, 32), dtype=np.uint8)
    owners = np.arange(2000) % 50
    flips = np.packbits(rng.random((2000, 256)) < 0.03, axis=1)
    descriptors = centres[rng.integers(0, 40, 2000)] ^ flips
    first, *lines = lines_of(descriptors, owners)
    assert first == "10 6 0 0"
    rows = [line.split(" ") for line in lines]
    parents = np.array([int(row[0]) for row in rows])
    words = np.array([row[1] == "1" for row in rows])
    assert all(len(row) == 2 + 32 + 1 for row in rows)
    assert (parents < np.arange(1, len(rows) + 1)).all()
    assert np.bincount(parents).max() <= 10
    assert not words[parents[parents > 0] - 1].any()
    weights = np.array([float(row[-1]) for row in rows])
    assert (weights[words] >= 0).all() and (weights[~words] == 0).all()
    values = np.array([row[2:34] for row in rows], int).astype(np.uint8)
    for descriptor in descriptors[:20]:
        node = 0
        while node == 0 or not words[node - 1]:
            below = np.flatnonzero(parents == node)
            node = int(below[nearest(descriptor[None], values[below])[0]]) + 1
        differing = np.unpackbits(descriptor ^ values[node - 1]).sum()
        assert differing < 60  # another centre's differ by about 128


def test_orb_slam3_gets_the_camera_in_its_own_format() -> None:
    camera = Camera(640, 480, fx=520.0, fy=521.5, cx=318, cy=240, distortion=(0.1, -0.2, 0, 0, 0.3))
    lines = dict(line.split(": ", 1) for line in settings_of(camera).splitlines()[1:])
    assert lines["Camera1.fx"] == "520.000000000"
    assert lines["Camera1.cx"] == "318.000000000"
    assert lines["Camera1.k3"] == "0.300000000"
    assert (lines["Camera.width"], lines["Camera.fps"]) == ("640", "30")
    assert float(lines["Stereo.b"]) == pytest.approx(camera.stereo_bf_px_m / camera.fx)


def _grown_mb(held_bytes: int) -> dict[str, float]:
    own_before_mb, all_before_mb = own_mb("self"), resident_mb()
    held = np.ones(held_bytes // 8)
    return {
        "held": held.nbytes / 1e6,
        "own": own_mb("self") - own_before_mb,
        "all": resident_mb() - all_before_mb,
    }


def test_memory_is_told_in_the_same_megabytes_everywhere() -> None:
    """Of the map's arrays and of its process, which stand beside each other: 1e6 bytes.

    In a process of its own: this one may give memory of other tests back in between.
    """
    grown = in_own_process(_grown_mb, 150_000_000)
    assert grown["own"] == pytest.approx(grown["held"], rel=0.02)
    assert grown["all"] == pytest.approx(grown["held"], rel=0.02)


def test_the_memory_of_a_network_is_not_that_of_the_process_that_started_its_own(capfd) -> None:
    held = np.ones(100_000_000)  # getrusage of a process on Linux would have it too
    code = "from benchmarks.semantics import beside_torchvision as b\n"
    code += "b.make = lambda name: {'ours': dict}\nb.peak_mb('resnet50', 'ours')"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)
    assert 0 < float(capfd.readouterr().out) < held.nbytes / 1e6


def _mortal(what: str) -> dict[str, float]:
    if what == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    return {what: 1.0}


def test_a_measurement_in_its_own_process_that_is_killed_ends_the_benchmark() -> None:
    assert in_own_process(_mortal, "measured") == {"measured": 1.0}
    with pytest.raises(BrokenProcessPool):
        in_own_process(_mortal, "killed")


def test_stages_of_keyframes_are_counted_over_keyframes(tmp_path: Path) -> None:
    lines = ["index,timestamp,status,keyframe,tracking_ms,graph_ms", "0,0.0,OK,0,2.0,30.0"]
    lines += ["1,0.1,OK,,4.0,0.0", "2,0.2,OK,1,6.0,50.0", "3,0.3,LOST,,,"]
    (tmp_path / "frames.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    frames = read_frames(tmp_path / "frames.csv")
    assert stage_times(frames, "tracking") == pytest.approx((4.0, 5.8, 3))
    assert stage_times(frames, "graph") == pytest.approx((40.0, 49.0, 2))
    assert stage_times(frames, "loops") == (0.0, 0.0, 0)


def test_a_tour_shows_each_sequence_forward_and_backward(office: Path) -> None:
    sequence, seen = open_sequence(office), list[None]()
    tour = Rounds(
        [sequence, sequence], 2 * len(sequence) + 2, 20.0, True, lambda: seen.append(None)
    )
    frames = list(tour.frames())
    there = list(range(len(sequence)))
    assert [index for _, index in tour.order] == 2 * (there + there[::-1])
    assert [frame.timestamp_s for frame in frames] == pytest.approx(np.arange(len(frames)) / 20)
    assert len(seen) == len(frames)
    np.testing.assert_array_equal(frames[0].rgb, frames[2 * len(sequence) - 1].rgb)
    np.testing.assert_array_equal(frames[1].rgb, frames[2 * len(sequence) + 1].rgb)
