"""A dense map that cannot be made leaves the merged run whole."""

from __future__ import annotations

import errno
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from bmask_slam.dense.folder import DenseFolder
from bmask_slam.graph.errors import InputError
from bmask_slam.merging.dense_maps import merge_dense_maps
from bmask_slam.world.landmark_table import LandmarkTable


@pytest.mark.parametrize(
    "error", [OSError(errno.ENOSPC, "No space left on device"), InputError("settings: broken")]
)
def test_a_full_disk_is_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: Any, error: Exception
) -> None:
    def refused(path: Path) -> DenseFolder:
        raise error

    (tmp_path / "dense").mkdir()
    (tmp_path / "dense" / "settings.json").write_text("{}")
    monkeypatch.setattr(DenseFolder, "reading", refused)
    source: Any = SimpleNamespace(path=tmp_path)
    assert merge_dense_maps(tmp_path / "out", [source, source], LandmarkTable()) is None
    assert f"no dense map: {error}; make it by: bmask-slam map" in caplog.text
