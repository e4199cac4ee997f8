"""A file that is written appears whole, or the old one stays."""

from __future__ import annotations

import pytest

from bmask_slam.graph.whole_file import whole_file


def test_the_file_appears_at_the_end_of_the_block(tmp_path):
    path = tmp_path / "map.ply"
    path.write_text("old")
    with whole_file(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
        assert temporary.suffix == ".ply"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_the_old_file_stays_when_the_block_fails(tmp_path):
    path = tmp_path / "map.ply"
    path.write_text("old")
    with pytest.raises(OSError, match="full"), whole_file(path) as temporary:
        temporary.write_text("ne")
        raise OSError("disk full")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
