"""File names from untrusted files."""

from __future__ import annotations

from pathlib import Path

import pytest

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.file_names import check_name, target_below


@pytest.mark.parametrize("name", ["rgb/1.png", "./rgb/a b.png", "..hidden", "rgb/..x/1.png"])
def test_names_inside_the_folder(name: str) -> None:
    assert check_name(name, "rgb.txt:1") == name


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        ("../../victim/x.png", "leads out"),
        ("rgb/../../x.png", "leads out"),
        ("/etc/passwd", "leads out"),
        ("..\\x.png", "leads out"),
        ("C:\\x.png", "leads out"),
        ("a\0b.png", "no file name"),
        ("", "no file name"),
        ("x" * 300, "too long"),
        ("/".join(["ab"] * 600), "too long"),
    ],
)
def test_names_that_lead_elsewhere_are_refused(name: str, fault: str) -> None:
    with pytest.raises(InputError, match=fault) as caught:
        check_name(name, "rgb.txt:7")
    assert str(caught.value).startswith("rgb.txt:7: ")
    assert len(str(caught.value)) < 500


def test_no_folder_on_the_way_to_a_target_is_a_link(tmp_path: Path) -> None:
    out, outside = tmp_path / "out", tmp_path / "outside"
    outside.mkdir()
    assert target_below(out, "a/b/c.png") == out / "a/b/c.png"
    assert (out / "a/b").is_dir()
    (out / "d").symlink_to(outside)
    with pytest.raises(InputError, match="is a link"):
        target_below(out, "d/e/c.png")
    assert not list(outside.iterdir())
