"""A finished run read back with its whole graph."""

from __future__ import annotations

from pathlib import Path

import pytest
from fake_run import make_sequence

from bmask_slam import cli
from bmask_slam.api import run
from bmask_slam.graph.errors import InputError
from bmask_slam.run_folder.map_file import read_map, read_run


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


def test_a_run_that_was_killed_is_to_be_resumed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "checkpoint").write_bytes(b"state")
    cure = rf"is not finished, and has no map yet; finish .* run --resume {tmp_path}$"
    for read in (read_run, read_map):
        with pytest.raises(InputError, match=cure):
            read(tmp_path)
    for words in (
        ["optimise", str(tmp_path), "--out", str(tmp_path / "out")],
        ["export", str(tmp_path), "--format", "g2o", "--out", str(tmp_path.parent / "a")],
        ["export", str(tmp_path), "--format", "ply", "--out", str(tmp_path.parent / "a")],
    ):
        assert cli.main(words) == 1
        assert f"run --resume {tmp_path}\n" in capsys.readouterr().err
