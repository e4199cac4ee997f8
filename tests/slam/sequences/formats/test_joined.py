"""Several recordings as one."""

from __future__ import annotations

from pathlib import Path

import pytest
from fake_run import make_sequence

from bmask_slam.evaluation.recordings import JOINED, Part, read_parts, write_parts
from bmask_slam.graph.errors import InputError
from bmask_slam.sequences.sequence import open_sequence


def part(folder: Path, begin_s: float, end_s: float, shift_s: float) -> Part:
    return Part(sequence=str(folder), begin_s=begin_s, end_s=end_s, shift_s=shift_s)


def test_frames_of_all_recordings_come_with_shifted_stamps(tmp_path: Path) -> None:
    first = make_sequence(tmp_path / "first", 6)
    second = make_sequence(tmp_path / "second", 4)
    path = tmp_path / JOINED
    parts = [part(first, 0.1, 0.3, 0.0), part(second, 0.0, 0.3, 12.0)]
    write_parts(path, parts)
    assert read_parts(path) == parts
    sequence = open_sequence(path)
    expected = [0.1, 0.2, 0.3, 12.0, 12.1, 12.2, 12.3]
    assert sequence.timestamps_s == pytest.approx(expected)
    assert [int(frame.rgb[0, 0, 0]) for frame in sequence.frames()] == [1, 2, 3, 0, 1, 2, 3]
    assert sequence.load(5).depth_m[0, 0] == pytest.approx(1.5)
    assert sequence.groundtruth is None


def test_broken_lists_are_refused(tmp_path: Path) -> None:
    path, folder = tmp_path / JOINED, make_sequence(tmp_path / "first", 3)
    for parts, text in (
        ([], "lists no recording"),
        ([part(path, 0, 1, 0)], "lists another list"),
        ([part(folder, 5, 6, 0)], "no image of its recordings is within its stamps"),
        ([part(folder, 0, 1e300, 0)], "are no seconds"),
        ([part(tmp_path / "gone", 0, 1, 0)], "gone: no such folder"),
    ):
        write_parts(path, parts)
        with pytest.raises(InputError, match=text):
            open_sequence(path)
