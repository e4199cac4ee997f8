"""The sequence of a run by its config.yaml."""

from __future__ import annotations

from pathlib import Path

import pytest

from bmask_slam.graph.errors import InputError
from bmask_slam.run_folder.origin import Origin, find_sequence, read_origin


@pytest.fixture
def run(tmp_path: Path) -> Path:
    (tmp_path / "hall").mkdir()
    made = tmp_path / "runs" / "hall"
    made.mkdir(parents=True)
    return made


def write(run: Path, sequence: object) -> None:
    (run / "config.yaml").write_text(f"# bmask-slam 0.1.0, sequence {sequence}, stride 3\n{{}}\n")


def test_the_sequence_path_is_absolute_and_read_back(run, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    (run / "config.yaml").write_text(f"# {Origin(Path('hall'), 3)}\n{{}}\n")
    monkeypatch.chdir("/")
    assert read_origin(run) == Origin(tmp_path / "hall", 3)
    assert find_sequence(run) == tmp_path / "hall"


def test_a_relative_sequence_of_an_older_run_is_found_from_elsewhere(
    run, tmp_path, monkeypatch
) -> None:
    """The run was started in the folder that holds runs/."""
    write(run, "hall")  # the run's folder has the same name
    monkeypatch.chdir("/")
    assert find_sequence(run) == tmp_path / "hall"
    (tmp_path / "elsewhere/hall").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert find_sequence(run) == tmp_path / "elsewhere/hall", "the working directory comes first"


@pytest.mark.parametrize("sequence", ["/nowhere", "nowhere"])
def test_a_missing_sequence_is_reported_with_the_cure(run, sequence) -> None:
    write(run, sequence)
    with pytest.raises(
        InputError, match=f"names '{sequence}', which is not there; give the folder"
    ):
        find_sequence(run)


def test_a_live_run_and_a_missing_configuration_name_no_sequence(run) -> None:
    with pytest.raises(InputError, match=r"names no sequence; give the folder .* as --sequence"):
        find_sequence(run)
    (run / "config.yaml").write_text(f"# {Origin(None)}\n{{}}\n")
    with pytest.raises(InputError, match="names no sequence"):
        find_sequence(run)


def test_a_sequence_with_a_name_that_no_file_can_have_is_not_there(run: Path) -> None:
    write(run, "/" + "nowhere" * 60 + ".mcap")
    with pytest.raises(InputError, match="which is not there"):
        find_sequence(run)
