"""What ``export --format nav2`` and ``octomap`` refuse before any work."""

from __future__ import annotations

from pathlib import Path

import pytest

from bmask_slam.dense.drive_map import DriveFormat, DriveMapOptions, export_drive_map
from bmask_slam.graph.errors import InputError


@pytest.mark.parametrize(
    ("form", "name", "written"), [("nav2", "a.txt", ".yaml"), ("octomap", "a.ot", ".bt")]
)
def test_a_file_of_another_name_is_not_written(
    tmp_path: Path, form: DriveFormat, name: str, written: str
) -> None:
    with pytest.raises(InputError, match=rf"{name}: .* let --out end with it") as found:
        export_drive_map(tmp_path, form, tmp_path / "out" / name, DriveMapOptions())
    assert written in str(found.value)
