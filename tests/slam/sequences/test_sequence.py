"""Sequences in TUM layout: frames, their order, and the reading thread."""

import dataclasses
import json
import re
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from repository import KITCHEN

from bmask_slam.graph.errors import InputError
from bmask_slam.sequences.info import format_info, info_as_json, sequence_info
from bmask_slam.sequences.lists import clock_set_back
from bmask_slam.sequences.prefetch import prefetched
from bmask_slam.sequences.recording import Recording
from bmask_slam.sequences.sequence import open_sequence


def prefetch_threads() -> int:
    return sum(thread.name.startswith("prefetch") for thread in threading.enumerate())


def test_frames(folder):
    sequence = open_sequence(folder)
    frames = list(sequence.frames())
    assert len(sequence) == len(frames) == 12
    assert sequence.name == "seq"
    assert sequence.groundtruth is None
    assert [f.index for f in frames] == list(range(12))
    np.testing.assert_allclose([f.timestamp_s for f in frames], sequence.timestamps_s)
    frame = frames[3]
    assert frame.rgb.shape == (24, 32, 3)
    assert frame.rgb.dtype == np.uint8
    assert frame.rgb[5, 5].tolist() == [30, 20, 200]  # red first
    assert frame.depth_m.dtype == np.float32
    assert np.isnan(frame.depth_m[0]).all()
    np.testing.assert_allclose(frame.depth_m[1:], 0.4)  # 400 at 1000 to the metre


@pytest.mark.parametrize("prefetch", [0, 1, 4, 100])
def test_slices(folder, prefetch):
    frames = open_sequence(folder).frames(2, 11, 4, prefetch=prefetch)
    assert [f.index for f in frames] == [2, 6, 10]


def test_one_other_thread_works_ahead():
    names = []
    items = prefetched((names.append(threading.current_thread().name) for _ in range(12)), 4)
    next(items)
    deadline = time.monotonic() + 60
    while len(names) < 5 and time.monotonic() < deadline:
        time.sleep(0.005)
    time.sleep(0.02)
    assert names == ["prefetch_0"] * 5  # one consumed, four waiting
    items.close()


def test_early_stop_ends_the_threads(folder):
    frames = open_sequence(folder).frames(prefetch=2)
    next(frames)
    assert prefetch_threads() == 2
    frames.close()
    assert prefetch_threads() == 0


def test_early_stop_wastes_no_work():
    """Only the current item is finished; waiting ones are not begun."""
    begun_items, begun, go = [], threading.Event(), threading.Event()

    def work(index):
        begun_items.append(index)
        if index:
            begun.set()
            assert go.wait(5)

    items = prefetched(map(work, range(12)), 4)
    next(items)
    assert begun.wait(5)
    threading.Timer(0.05, go.set).start()
    items.close()
    assert begun_items == [0, 1]


def test_exceptions_are_passed_to_the_consumer():
    received = []
    with pytest.raises(ZeroDivisionError):
        for item in prefetched((6 // (3 - k) for k in range(12)), 4):
            received.append(item)
    assert received == [2, 3, 6]
    assert prefetch_threads() == 0


def test_order_of_lines_never_matters(folder):
    before = open_sequence(folder)
    for name in ("rgb.txt", "depth.txt"):
        lines = (folder / name).read_text().splitlines()
        (folder / name).write_text("\n".join(lines[::-1]) + "\n")
    after = open_sequence(folder)
    np.testing.assert_array_equal(after.timestamps_s, before.timestamps_s)
    assert after.pairs.rgb_files == before.pairs.rgb_files
    assert after.pairs.depth_files == before.pairs.depth_files


def test_a_clock_that_was_set_back_is_told_from_other_orders():
    stamps_s = 100 + np.arange(60) / 30
    rng = np.random.default_rng(0)
    others = {
        "sorted": stamps_s,
        "backward": stamps_s[::-1],
        "shuffled": rng.permutation(stamps_s),
        "two pieces in the other order": np.roll(stamps_s, 30),
        "one late line": np.append(np.delete(stamps_s, 5), stamps_s[5]),
    }
    for name, order in others.items():
        assert clock_set_back(Path("rgb.txt"), order) == "", name
    set_back = stamps_s - 0.81 * (np.arange(60) >= 30)
    text = clock_set_back(Path("rgb.txt"), set_back)
    assert "go back by 0.777 s behind 100.966667 s, and 24 images lie between earlier ones" in text


def test_pairs_by_time_not_by_line(folder):
    """Without the first depth image the first colour image has no pair; the others keep theirs."""
    lines = (folder / "depth.txt").read_text().splitlines()
    (folder / "depth.txt").write_text("\n".join(lines[1:]))
    sequence = open_sequence(folder)
    assert len(sequence) == 11
    assert sequence.pairs.unpaired_rgb == 1
    frame = sequence.load(0)
    assert frame.rgb[0, 0, 0] == 10
    np.testing.assert_allclose(frame.depth_m[1:], 0.2)


@pytest.mark.parametrize("depth_first", [False, True])
def test_associations(folder, depth_first):
    before = open_sequence(folder)
    lines = []
    for k in (3, 1, 2, 0):
        rgb, depth = f"{k / 10} rgb/{k}.png", f"{k / 10 + 0.004} depth/{k}.png"
        lines.append(f"{depth} {rgb}" if depth_first else f"{rgb} {depth}")
    (folder / "associations.txt").write_text("\n".join(lines))
    (folder / "rgb.txt").unlink()
    sequence = open_sequence(folder)
    np.testing.assert_allclose(sequence.timestamps_s, [0, 0.1, 0.2, 0.3])
    assert sequence.pairs.rgb_files == before.pairs.rgb_files[:4]
    assert sequence.pairs.depth_files == before.pairs.depth_files[:4]


def test_associations_of_depth_first_by_names_that_begin_with_the_folder_itself(folder):
    rows = (f"{k / 10} ./depth/{k}.png {k / 10} ./rgb/{k}.png" for k in range(4))
    (folder / "associations.txt").write_text("\n".join(rows))
    (folder / "rgb.txt").unlink()
    assert open_sequence(folder).pairs.rgb_files == tuple(folder / f"rgb/{k}.png" for k in range(4))


def test_grey_and_alpha_images_are_expanded(folder):
    cv2.imwrite(str(folder / "rgb/4.png"), np.full((24, 32), 77, np.uint8))
    cv2.imwrite(str(folder / "rgb/5.png"), np.full((24, 32, 4), (1, 2, 3, 128), np.uint8))
    sequence = open_sequence(folder)
    assert (sequence.load(4).rgb == 77).all()
    assert sequence.load(5).rgb[0, 0].tolist() == [3, 2, 1]


def test_groundtruth(folder):
    (folder / "groundtruth.txt").write_text("0.1 1 2 3 0 0 0 1\n0.0 0 2 3 0 0 0 1\n")
    truth = open_sequence(folder).groundtruth
    np.testing.assert_array_equal(truth.positions_world, [[0, 2, 3], [1, 2, 3]])
    (folder / "groundtruth.txt").write_text("0.1 1 2 3\n")
    with pytest.raises(InputError, match=r"groundtruth\.txt:1"):
        open_sequence(folder)


def test_with_a_delay_no_colour_image_is_left_out_between_depth_images(folder):
    for kind, jitter_s in ("rgb", 0.005), ("depth", 0.0):
        rows = [row for row in (folder / f"{kind}.txt").read_text().splitlines() if "#" not in row]
        stamped = (
            f"{k / 30 + jitter_s * (k % 2):.6f} {row.split()[1]}\n" for k, row in enumerate(rows)
        )
        (folder / f"{kind}.txt").write_text("".join(stamped))
    delayed = open_sequence(folder).with_delay(0.017)
    files = delayed.pairs.depth_files
    assert len(delayed) == len(rows) > len(set(files)) == len(rows) - delayed.pairs.unpaired_depth
    between = zip(files[1:-1], delayed.pairs.neighbour_files[1:-1], strict=True)
    assert all(neighbour not in (None, file) for file, neighbour in between)


def test_another_delay_pairs_anew_and_decodes_nothing_twice(folder, monkeypatch):
    sequence = open_sequence(folder)
    delayed = sequence.with_delay(0.1)
    again = sequence.with_camera(dataclasses.replace(sequence.camera, depth_time_offset_s=0.1))
    assert delayed.camera == again.camera
    assert delayed.pairs.depth_files == again.pairs.depth_files != sequence.pairs.depth_files
    decoded = []
    read = Recording.read_depth
    monkeypatch.setattr(
        Recording, "read_depth", lambda *about: decoded.append(about[1]) or read(*about)
    )
    file = delayed.pairs.depth_files[3]
    first = sequence.pairs.depth_files.index(file)
    np.testing.assert_array_equal(sequence.depth(first)[0], again.depth(3)[0])
    decoded.clear()
    np.testing.assert_array_equal(delayed.depth(3)[0], again.depth(3)[0])
    assert file not in decoded


def test_info(folder):
    """Frames 5 to 8 are removed; one colour image at 7 s has no pair."""
    for name in ("rgb.txt", "depth.txt"):
        lines = (folder / name).read_text().splitlines()
        lines = [line for line in lines if not re.search(r"/[5-8]", line)]
        lines += ["7.0 rgb/5.png"] * (name == "rgb.txt")
        (folder / name).write_text("\n".join(lines))
    (folder / "groundtruth.txt").write_text(
        "0 0 0 0 0 0 0 1\n0.1 0 3 0 0 0 0 1\n0.2 4 3 0 0 0 0 1\n50 99 0 0 0 0 0 1\n"
    )
    info = sequence_info(open_sequence(folder))
    assert info.frames == 8
    assert info.fps_hz == pytest.approx(10)
    assert info.duration_s == pytest.approx(1.1)
    ((start_s, length_s),) = info.gaps
    assert (start_s, length_s) == pytest.approx((0.4, 0.5))
    assert (info.unpaired_rgb, info.unpaired_depth, info.broken) == (1, 0, 0)
    assert info.depth_valid_share == pytest.approx(23 / 24)
    assert info.depth_percentiles_m[1] == pytest.approx(0.45)  # 0.1 to 0.5 and 1.0 to 1.2 m
    assert info.groundtruth_share == pytest.approx(3 / 8)
    assert info.groundtruth_length_m == pytest.approx(7)
    text = format_info(info)
    for words in ("8 in 1.10 s, 10.00 Hz", "32x24", "camera.yaml", "1000 to the metre", "37.5 %"):
        assert words in text


def test_what_one_frame_does_not_tell_is_unknown(folder):
    for name in ("rgb.txt", "depth.txt"):
        (folder / name).write_text((folder / name).read_text().splitlines()[-1])
    info = sequence_info(open_sequence(folder))
    assert (info.frames, info.gaps) == (1, ())

    def not_json(word: str) -> None:
        pytest.fail(f"{word} is not JSON")

    found = json.loads(info_as_json(info), parse_constant=not_json)
    assert found["fps_hz"] is None and found["camera"]["fx"] == info.camera.fx
    assert re.search(r"^frames +1 in 0.00 s, unknown Hz$", format_info(info), re.MULTILINE)


@pytest.mark.skipif(not KITCHEN.is_dir(), reason="no ../shared/data/redkitchen here")
def test_red_kitchen():
    """Real frames: a point of the first image is on the surface in the 30th."""
    sequence = open_sequence(KITCHEN)
    assert len(sequence) == 600
    assert sequence.camera.fx == pytest.approx(527.27)
    a, b = (frame for frame in sequence.frames(stop=11, stride=10))
    T_world_a, T_world_b = sequence.groundtruth.poses_world_camera[[0, 10]]
    v, u = np.mgrid[20:460:5, 20:620:5].reshape(2, -1)
    prepared = np.isfinite(a.depth_m[v, u])
    pixels = np.column_stack([u, v])[prepared]
    points_a = sequence.camera.backproject(
        pixels.astype(float), a.depth_m[v, u][prepared].astype(float)
    )
    T_b_a = np.linalg.inv(T_world_b) @ T_world_a
    points_b = points_a @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    projected = np.rint(sequence.camera.project(points_b)).astype(int)
    inside = ((projected >= 0) & (projected < (640, 480))).all(axis=1)
    measured_m = b.depth_m[projected[inside, 1], projected[inside, 0]]
    difference_m = np.abs(measured_m - points_b[inside, 2])
    assert np.nanmedian(difference_m) < 0.015
