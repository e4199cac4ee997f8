"""The run folder: errors, remaining files, and complete files only."""

from __future__ import annotations

import logging
import os
import shutil
from pathlib import Path

import pytest
from small_layouts import SMALL_LAYOUTS, write_small

from bmask_slam.events import Event, EventKind
from bmask_slam.graph.errors import InputError
from bmask_slam.run_folder import folder as folder_module
from bmask_slam.run_folder.folder import FILES, RunFolder, trajectory_files
from bmask_slam.run_folder.open_files import free_run_path
from bmask_slam.tracking.results import FrameResult, TrackingStatus

RESULT = FrameResult(3, 0.1, TrackingStatus.OK, None, stage_ms={"tracking": 1.5})


@pytest.mark.parametrize("name", FILES)
def test_a_folder_that_holds_a_run_is_refused_untouched(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("earlier")
    with pytest.raises(InputError, match=f"already holds a run .{name}.; .* add --overwrite"):
        RunFolder(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "earlier"


@pytest.mark.parametrize("name", ["frames.csv", "events.csv", "log.txt"])
def test_a_run_that_began_in_the_meantime_is_kept(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another process makes its file after this one found the folder free."""
    monkeypatch.setattr(folder_module, "_clear", lambda path, _: (path / name).write_text("theirs"))
    with pytest.raises(InputError, match="File exists"):
        RunFolder(tmp_path / "run")
    assert [p.name for p in (tmp_path / "run").iterdir()] == [name]
    assert (tmp_path / "run" / name).read_text() == "theirs"


def test_overwrite_removes_only_the_run(tmp_path: Path) -> None:
    (tmp_path / "graph").mkdir()
    (tmp_path / "graph/values").write_text("earlier")
    (tmp_path / "metrics.json").write_text("earlier")
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "trajectory_run_2.txt").write_text("of a merged run")
    (tmp_path / "trajectory_segment_1.txt").write_text("of another segment")
    (tmp_path / "dense").mkdir()
    (tmp_path / "dense/cloud.ply").write_text("of the earlier map")
    with RunFolder(tmp_path, overwrite=True):
        pass
    names = ["events.csv", "frames.csv", "log.txt", "notes.txt"]
    assert sorted(p.name for p in tmp_path.iterdir()) == names


def test_of_two_that_overwrite_a_run_at_once_one_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second one comes while the first removes the files of before."""
    (tmp_path / "frames.csv").write_text("earlier")
    remove, refused = folder_module.remove, list[InputError]()

    def slowly(path: Path) -> None:
        monkeypatch.setattr(folder_module, "remove", remove)
        with pytest.raises(InputError, match="a process is writing a run there") as caught:
            RunFolder(tmp_path, overwrite=True)
        refused.append(caught.value)
        remove(path)

    monkeypatch.setattr(folder_module, "remove", slowly)
    with RunFolder(tmp_path, overwrite=True) as folder:
        folder.write_frame(RESULT)
    assert len((tmp_path / "frames.csv").read_text().splitlines()) == 2
    assert len(refused) == 1


def test_a_file_at_the_run_folders_path(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"file: is a file; choose another folder with --out"):
        RunFolder(tmp_path / "file")
    with pytest.raises(InputError, match=r"run: cannot be written \(Not a directory\); choose"):
        RunFolder(tmp_path / "file/run")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match=r"cannot be written \(Permission denied\)"):
        RunFolder(tmp_path / "run")


def test_a_folder_that_cannot_be_written() -> None:
    with pytest.raises(InputError, match=r"/proc/run: cannot be written"):
        RunFolder(Path("/proc/run"))


def test_frames_are_on_disk_at_once(tmp_path: Path) -> None:
    with RunFolder(tmp_path) as folder:
        folder.write_frame(RESULT)
        header, row = (tmp_path / "frames.csv").read_text().splitlines()
        assert dict(zip(header.split(","), row.split(","), strict=True))["tracking_ms"] == "1.500"


def test_a_file_that_is_replaced_is_left_as_it_is(tmp_path: Path) -> None:
    """As by an adjusted run, which copies the frames of another one."""
    with RunFolder(tmp_path) as folder:
        (tmp_path / "new").write_text("replaced")
        (tmp_path / "new").rename(folder.path / "frames.csv")
        assert folder.path == tmp_path
    assert (tmp_path / "frames.csv").read_text() == "replaced"


def test_an_unknown_stage_is_a_bug(tmp_path: Path) -> None:
    result = FrameResult(3, 0.1, TrackingStatus.OK, None, stage_ms={"tea": 1.5})
    with RunFolder(tmp_path) as folder, pytest.raises(ValueError, match="tea_ms"):
        folder.write_frame(result)


def test_a_path_that_is_no_text_is_written_in_log_and_events(
    tmp_path: Path, capsys, monkeypatch
) -> None:
    """A name in Latin-1, as old systems wrote it, of a map or a folder that was given."""
    name = os.fsdecode(b"caf\xe9")
    monkeypatch.setattr(logging.getLogger("bmask_slam"), "propagate", False)  # xdist cannot send it
    with RunFolder(tmp_path / name) as folder:
        for _ in range(2):
            folder.write_events([Event(0, 0.0, EventKind.CALIBRATION, f"found by {name}")])
            logging.getLogger("bmask_slam").info("found by %s", name)
            shutil.rmtree(tmp_path / name, ignore_errors=True)
            path = folder.path
    for file in ("log.txt", "events.csv"):
        assert (path / file).read_text().count("found by caf\\udce9") == 2
    assert "Traceback" not in capsys.readouterr().err


def test_a_file_is_replaced_completely_or_not_at_all(tmp_path: Path) -> None:
    with RunFolder(tmp_path) as folder:
        folder.write_text("metrics.json", "old")
        with pytest.raises(TypeError):
            folder.write_text("metrics.json", None)  # type: ignore[arg-type]
        assert (tmp_path / "metrics.json").read_text() == "old"
    assert [p.name for p in tmp_path.glob(".*")] == []


def test_what_a_killed_process_left_is_removed(tmp_path: Path) -> None:
    (tmp_path / ".part-0123.ply").write_text("half")
    with RunFolder(tmp_path):
        assert not list(tmp_path.glob(".part-*"))


@pytest.mark.parametrize("name", ["frames.csv", "log.txt"])
def test_a_resumed_run_writes_through_no_link(tmp_path: Path, name: str) -> None:
    run, outside = tmp_path / "run", tmp_path / "outside"
    with RunFolder(run) as folder:
        size = folder.synced_bytes()
    (run / name).rename(outside)
    before = outside.read_bytes()
    (run / name).symlink_to(outside)
    with pytest.raises(InputError, match=rf"{name}: is a link"):
        RunFolder(run, resume_bytes=size)
    assert outside.read_bytes() == before


def test_an_input_error_after_frames_keeps_them(tmp_path: Path) -> None:
    with pytest.raises(InputError), RunFolder(tmp_path / "run") as folder:
        folder.write_frame(RESULT)
        raise InputError("broken")
    assert "stopped: broken" in (tmp_path / "run/log.txt").read_text()


def test_an_input_error_before_frames_keeps_foreign_files(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError), RunFolder(tmp_path):
        raise InputError("broken")
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


def test_free_paths_are_numbered(tmp_path: Path) -> None:
    assert free_run_path("a", tmp_path) == tmp_path / "a"
    (tmp_path / "a").mkdir()
    (tmp_path / "a-2").write_text("")
    assert free_run_path("a", tmp_path) == tmp_path / "a-3"


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_sequence_is_not_overwritten(tmp_path: Path, overwrite: bool) -> None:
    for name in ("rgb.txt", "camera.yaml", "depth.txt"):
        (tmp_path / name).write_text("mine")
    with pytest.raises(InputError, match="is a sequence"):
        RunFolder(tmp_path, overwrite=overwrite)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["camera.yaml", "depth.txt", "rgb.txt"]


@pytest.mark.parametrize("layout", SMALL_LAYOUTS, ids=lambda layout: layout.name)
def test_a_recording_in_another_layout_is_not_overwritten(layout, tmp_path: Path) -> None:
    folder = write_small(layout, tmp_path)
    if not folder.is_dir():
        return
    (folder / "camera.yaml").write_text("mine")
    before = sorted(folder.rglob("*"))
    with pytest.raises(InputError, match="is a sequence"):
        RunFolder(folder, overwrite=True)
    assert sorted(folder.rglob("*")) == before


def test_files_of_others_with_names_like_those_of_a_run_stay(tmp_path: Path) -> None:
    own, foreign = ("trajectory_segment_2.txt", "trajectory_run_1.txt"), "trajectory_of_mocap.txt"
    for name in ("trajectory.txt", *own, foreign):
        (tmp_path / name).write_text("")
    with RunFolder(tmp_path, overwrite=True):
        assert [p.name for p in tmp_path.glob("trajectory*")] == [foreign]


def test_files_of_segments_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    names = ["trajectory.txt", *(f"trajectory_segment_{k}.txt" for k in (1, 2, 10, 11))]
    for name in reversed(names):
        (tmp_path / name).touch()
    assert [file.name for file in trajectory_files(tmp_path)] == names
