"""Files are written completely or not at all; links in the folder are not followed."""

from __future__ import annotations

import resource
import shutil
import sys
from contextlib import ExitStack
from pathlib import Path
from subprocess import PIPE, Popen

import pytest

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files import whole_file as whole_file_module
from bmask_slam.graph.files.whole_file import check_target, whole_file, whole_folder


def test_a_link_is_replaced_and_its_target_kept(tmp_path: Path) -> None:
    outside, path = tmp_path / "outside", tmp_path / "trajectory.txt"
    outside.write_text("precious")
    for name in (path.name, f"{path.name}.tmp", f".part-{path.name}"):
        (tmp_path / name).symlink_to(outside)
    with whole_file(path) as temporary:
        temporary.write_text("poses")
    assert outside.read_text() == "precious"
    assert not path.is_symlink()
    assert path.read_text() == "poses"


def test_a_linked_folder_is_replaced_and_its_target_kept(tmp_path: Path) -> None:
    outside, path = tmp_path / "outside", tmp_path / "dense"
    outside.mkdir()
    (outside / "a").write_text("precious")
    path.symlink_to(outside)
    with whole_folder(path) as temporary:
        (temporary / "b").write_text("")
    assert (outside / "a").read_text() == "precious"
    assert [p.name for p in path.iterdir()] == ["b"]


def test_after_an_error_the_old_content_is_there(tmp_path: Path) -> None:
    file, folder = tmp_path / "a.txt", tmp_path / "b"
    file.write_text("old")
    folder.mkdir()
    (folder / "old").write_text("")
    with pytest.raises(ZeroDivisionError), whole_file(file) as temporary:
        temporary.write_text("half")
        raise ZeroDivisionError
    with pytest.raises(ZeroDivisionError), whole_folder(folder) as temporary:
        raise ZeroDivisionError
    assert file.read_text() == "old"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.txt", "b"]
    assert (folder / "old").exists()


def test_an_error_names_the_file_and_not_the_temporary_one(tmp_path: Path) -> None:
    """As of a folder in which nothing may be written, which root cannot try."""
    missing = tmp_path / "missing" / "a.txt"
    for make in (whole_file, whole_folder):
        with pytest.raises(FileNotFoundError) as caught, make(missing):
            pass
        assert caught.value.filename == str(missing)
    with pytest.raises(NotADirectoryError) as caught, whole_folder(tmp_path / "b") as temporary:
        (temporary / "file").write_text("")
        (temporary / "file" / "c").write_text("")
    assert caught.value.filename == str(tmp_path / "b" / "file" / "c")


def test_a_full_disk_names_the_file_that_it_did_not_take(tmp_path: Path) -> None:
    """The system does not say it when it writes, and copying names the file that is read."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    path, source = tmp_path / "a", tmp_path / "source"
    source.write_bytes(bytes(2000))
    for make in (Path.write_bytes, lambda to, data: shutil.copyfile(source, to)):
        with pytest.raises(OSError, match="File too large") as caught, whole_file(path) as part:
            resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
            try:
                make(part, bytes(2000))
            finally:
                resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert str(path) in (caught.value.filename, caught.value.filename2)


def test_a_refusal_names_the_file_and_not_the_temporary_one(tmp_path: Path) -> None:
    path = tmp_path / "map"
    with pytest.raises(InputError, match=rf"^{path}: cannot be written"), whole_file(path) as part:
        raise InputError(f"{part}: cannot be written")


def test_permissions_are_those_of_any_new_file(tmp_path: Path) -> None:
    (tmp_path / "plain").write_text("")
    with whole_file(tmp_path / "whole") as temporary:
        temporary.write_text("")
    assert (tmp_path / "whole").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_folder_in_the_place_of_a_file_is_refused_and_kept(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    with (
        pytest.raises(InputError, match="a: is a folder; give the name of a file"),
        whole_file(tmp_path / "a"),
    ):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
    with pytest.raises(InputError, match="none is not there; make it first"):
        check_target(tmp_path / "none" / "a")


LEAVE = """
import os, sys
from pathlib import Path
from bmask_slam.graph.files.whole_file import folder_beside
with folder_beside(Path(sys.argv[1])) as made:
    (made / "rgb").mkdir()
    print(made, flush=True)
    sys.stdin.read()
"""


def test_what_killed_processes_left_is_removed_by_the_next_for_the_same_target(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What another process works on stays, and what is of another target."""
    path = tmp_path / "converted"
    command = [sys.executable, "-c", LEAVE]
    made: list[Path] = []
    with ExitStack() as stack:
        for target in (path, path, tmp_path / "other"):
            process = Popen([*command, str(target)], stdin=PIPE, stdout=PIPE, text=True)
            stack.enter_context(process)
            stack.callback(process.kill)
            assert process.stdout is not None
            made.append(Path(process.stdout.readline().strip()))
            if len(made) != 2:
                process.kill()
                process.wait()
        assert all(folder.is_dir() for folder in made)
        with whole_folder(path):
            assert made[0].is_dir()  # too young
        monkeypatch.setattr(whole_file_module, "UNLOCKED_S", 0.0)
        with whole_folder(path):
            assert [folder.is_dir() for folder in made] == [False, True, True]
    assert path.is_dir()
