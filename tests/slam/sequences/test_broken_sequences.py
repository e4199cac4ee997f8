"""Broken input: one clear line for each case; a single broken frame is skipped."""

import os
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from bmask_slam.graph.errors import InputError
from bmask_slam.sequences.bags.topics import BagTopics
from bmask_slam.sequences.sequence import SequenceConfig, open_sequence


def break_missing(folder, k):
    (folder / f"rgb/{k}.png").unlink()


def break_truncated_png(folder, k):
    path = folder / f"depth/{k}.png"
    path.write_bytes(path.read_bytes()[:-30])


def break_truncated_jpeg(folder, k):
    image = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)
    data = cv2.imencode(".jpg", image)[1].tobytes()
    (folder / f"rgb/{k}.png").write_bytes(data[: len(data) // 2])


def break_damaged_png(folder, k):
    path = folder / f"depth/{k}.png"
    data = bytearray(path.read_bytes())
    data[50:60] = b"\x00" * 10
    path.write_bytes(data)


def break_empty(folder, k):
    (folder / f"rgb/{k}.png").write_bytes(b"")


def break_text(folder, k):
    (folder / f"rgb/{k}.png").write_text("404 not found")


def break_size(folder, k):
    cv2.imwrite(str(folder / f"depth/{k}.png"), np.full((12, 16), 100, np.uint16))


def break_rgb_size(folder, k):
    cv2.imwrite(str(folder / f"rgb/{k}.png"), np.zeros((48, 64, 3), np.uint8))


def break_8_bit(folder, k):
    cv2.imwrite(str(folder / f"depth/{k}.png"), np.full((24, 32), 100, np.uint8))


def break_colour(folder, k):
    cv2.imwrite(str(folder / f"depth/{k}.png"), np.full((24, 32, 3), 100, np.uint8))


def break_depth_as_rgb(folder, k):
    (folder / f"rgb/{k}.png").write_bytes((folder / f"depth/{k}.png").read_bytes())


BREAKS = [
    (break_missing, "no such image"),
    (break_truncated_png, "truncated"),
    (break_truncated_jpeg, "truncated"),
    (break_damaged_png, "not a readable image"),
    (break_empty, "0 bytes"),
    (break_text, "not a readable image"),
    (break_size, "16x12 pixels.*32x24"),
    (break_rgb_size, "64x48 pixels.*32x24"),
    (break_8_bit, "8-bit depth"),
    (break_colour, "3 channels where depth"),
    (break_depth_as_rgb, "16 bits a channel where colour"),
]


@pytest.mark.parametrize(("damage", "words"), BREAKS)
def test_a_broken_frame_in_the_middle_is_skipped(folder, caplog, damage, words):
    damage(folder, 5)
    sequence = open_sequence(folder)
    for _ in range(2):  # a second pass counts nothing twice
        assert [f.index for f in sequence.frames()] == [0, 1, 2, 3, 4, 6, 7, 8, 9, 10, 11]
    ((index, reason),) = sequence.skipped
    assert index == 5
    assert re.search(rf"5\.png: .*{words}", reason)
    assert caplog.text.count("frame 5 skipped") == 1


@pytest.mark.parametrize(("damage", "words"), BREAKS)
def test_a_broken_first_frame_is_an_error(folder, damage, words):
    damage(folder, 0)
    with pytest.raises(InputError, match=rf"0\.png: .*{words}"):
        open_sequence(folder)


def test_many_missing_files_are_an_error_at_opening(folder):
    for k in (3, 5, 7):
        break_missing(folder, k)
    with pytest.raises(InputError, match=r"3 of 12 frames are broken.*7\.png"):
        open_sequence(folder)


def test_many_broken_files_are_an_error_on_the_way(folder):
    for k in (3, 5, 7):
        break_text(folder, k)
    indices = []
    with pytest.raises(InputError, match="3 of 12 frames are broken"):
        for frame in open_sequence(folder).frames():
            indices.append(frame.index)
    assert indices == [0, 1, 2, 4, 6]
    relaxed = open_sequence(folder, SequenceConfig(max_broken_share=0.5))
    assert len(list(relaxed.frames())) == 9


def test_no_depth_at_all(folder):
    blank = np.zeros((24, 32), np.uint16)
    cv2.imwrite(str(folder / "depth/0.png"), blank)
    assert np.isnan(open_sequence(folder).load(0).depth_m).all()  # the others have depth
    for k in range(12):
        cv2.imwrite(str(folder / f"depth/{k}.png"), blank)
    with pytest.raises(InputError, match=r"depth/0\.png: no depth at all"):
        open_sequence(folder)


def append(name: str, line: str):
    def change(folder: Path) -> None:
        with (folder / name).open("a") as file:
            file.write(line + "\n")

    return change


def restamp(name: str, factor: float, shift_s: float = 0.0):
    def change(folder: Path) -> None:
        rows = [r.split() for r in (folder / name).read_text().splitlines() if r[0] != "#"]
        lines = [f"{float(stamp) * factor + shift_s:.6f} {file}" for stamp, file in rows]
        (folder / name).write_text("\n".join(lines))

    return change


def put(name: str, text: str):
    return lambda folder: (folder / name).write_text(text)


def remove(name: str):
    return lambda folder: (folder / name).unlink()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (remove("rgb.txt"), r"rgb\.txt: no such list.*associations\.txt"),
        (remove("depth.txt"), r"depth\.txt: no such list"),
        (put("rgb.txt", "# nothing\n"), r"rgb\.txt: the list is empty"),
        (put("rgb.txt", "0.1\n"), r"rgb\.txt:1: '0\.1' is not of the form"),
        (append("rgb.txt", "nan rgb/3.png"), r"rgb\.txt:14: 'nan' is not a finite"),
        (append("depth.txt", "one depth/3.png"), r"depth\.txt:13: 'one' is not a fin"),
        (restamp("rgb.txt", 1000), r"rgb\.txt: timestamps are 100 apart.*milliseconds.*1000"),
        (restamp("depth.txt", 1e9), r"depth\.txt: .*nanoseconds"),
        (restamp("depth.txt", 1, 0.05), r"no colour and depth image within 0\.02 s.*same clock"),
    ],
)
def test_bad_lists(folder, change, words):
    change(folder)
    with pytest.raises(InputError, match=words) as caught:
        open_sequence(folder)
    assert str(folder) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_folder(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        open_sequence(tmp_path / "none")


def test_topics_of_what_is_no_bag(folder):
    given = BagTopics("/camera/rgb").of_path(folder)
    with pytest.raises(InputError, match=f"^{folder}: is no ROS bag.*; leave .*--rgb-topic.* out$"):
        open_sequence(given)


def test_a_name_that_is_no_text(folder):
    """As old systems wrote it, in Latin-1: neither config.yaml nor the log can hold it."""
    named = folder.rename(folder.with_name(os.fsdecode(b"caf\xe9")))
    with pytest.raises(InputError, match=r"caf.udce9': .* not UTF-8; rename it"):
        open_sequence(named)
