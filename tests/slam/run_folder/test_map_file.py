"""A finished run read back with its whole graph."""

from __future__ import annotations

from pathlib import Path

import pytest
from fake_run import make_sequence

from bmask_slam.api import run
from bmask_slam.graph.errors import InputError
from bmask_slam.run_folder.map_file import read_run


def test_a_run_on_blank_images_has_metrics_but_no_poses(tmp_path: Path) -> None:
    found = run(make_sequence(tmp_path / "seq", 4), tmp_path / "run")
    assert found.frames.status == ("LOST",) * 4
    assert found.metrics["tracked_share"].value == 0
    assert len(found.landmarks) == 0
    with pytest.raises(InputError, match=r"trajectory\.txt: no pose in the file"):
        read_run(found.path)


def test_a_run_without_a_graph_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no graph; give the folder of a run that came to"):
        read_run(tmp_path)
