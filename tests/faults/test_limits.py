"""Limits of the machine: memory, descriptors, permissions, a full disk. One line with the cure."""

from __future__ import annotations

import errno
import logging
import os
import re
import resource
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
from fake_run import FakeSystem, make_sequence
from faults import fill

from bmask_slam import cli
from bmask_slam.graph.errors import InputError
from bmask_slam.offline.runner import RunOptions, run
from bmask_slam.run_folder.folder import RunFolder
from bmask_slam.runtime.progress import console_log

COMMAND = [sys.executable, "-m", "bmask_slam"]


def limited(limit: str, words: list[str]) -> tuple[int, str]:
    """Exit status and error lines of a command under a limit of the shell."""
    shell = ["sh", "-c", f'ulimit {limit}; exec "$@"', "sh", *COMMAND, *words]
    done = subprocess.run(shell, capture_output=True, text=True, timeout=600, check=False)
    return done.returncode, done.stderr


@pytest.mark.parametrize("name", ["run", "live"])
def test_too_little_memory_is_refused_before_libraries_hang(office: Path, name: str) -> None:
    """OpenBLAS asks for memory again and again where a limit leaves none."""
    code, errors = limited("-v 1000000", [name, str(office)])
    assert code == 1
    assert re.fullmatch(r"error: memory is limited to 1 GB .*: ulimit -v unlimited\n", errors)


ERRORS = {
    "a library": ImportError("libaom.so: failed to map segment from shared object"),
    "an array": MemoryError("Unable to allocate 9 GiB"),
    "a file": OSError(errno.ENOMEM, os.strerror(errno.ENOMEM), "map"),
    "a thread": RuntimeError("can't start new thread"),
}


@pytest.mark.parametrize("what", ERRORS)
def test_memory_that_runs_out(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def handler(arguments: object) -> None:
        with RunFolder(tmp_path / "run"):
            raise ERRORS[what]

    parser = SimpleNamespace(
        parse_args=lambda argv: SimpleNamespace(handler=handler, verbose=False, command="run")
    )
    monkeypatch.setattr(cli, "make_parser", lambda: parser)
    assert cli.main([]) == 1
    assert capsys.readouterr().err.splitlines() == [f"error: {cli.MEMORY}"]
    assert not (tmp_path / "run").exists()


def test_a_bug_before_the_first_frame_leaves_the_log(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), RunFolder(tmp_path / "run"):
        raise ZeroDivisionError("a bug")
    assert "ZeroDivisionError: a bug" in (tmp_path / "run" / "log.txt").read_text()


@pytest.mark.parametrize(("command", "limit"), [("live", 16), ("run", 12), ("run", 10)])
def test_too_few_descriptors(office: Path, tmp_path: Path, command: str, limit: int) -> None:
    out = tmp_path / "a" / "run"
    words = [command, str(office), "--segmenter", "none", "--out", str(out)]
    code, errors = limited(f"-n {limit}", words)
    assert code == 1
    lines = [line for line in errors.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1 and lines[0].endswith("raise the limit of open files: ulimit -n 4096")
    assert "Traceback" not in errors
    assert not out.parent.exists() or (out / "trajectory.txt").is_file()  # all that was tracked


@contextmanager
def no_file_larger_than(size: int) -> Iterator[None]:
    """As on a disk that is nearly full, for this process; Python ignores the signal of it."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("size", [0, 16, 200])
def test_a_disk_that_is_full_from_the_beginning(tmp_path: Path, size: int) -> None:
    """No room for the table's header, or for that only, but not for config.yaml."""
    sequence, out = make_sequence(tmp_path / "seq"), tmp_path / "a" / "run"
    with pytest.raises(InputError, match="File too large"), no_file_larger_than(size):
        run(RunOptions(sequence, out=out, quiet=True), FakeSystem)
    assert not out.parent.exists()


@pytest.mark.parametrize("words", [("convert", "seq", "out"), ("segment", "seq", "--out", "out")])
def test_images_that_do_not_fit_on_the_disk(
    tmp_path: Path, words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    """OpenCV's own writer leaves the half of an image and says nothing."""
    make_sequence(tmp_path / "seq")
    given = [str(tmp_path / word) if word in ("seq", "out") else word for word in words]
    more = ["--segmenter", "none"] if "segment" in words else []
    with no_file_larger_than(60):
        assert cli.main([*given, *more]) == 1
    assert re.search("error: .*File too large; free some", capsys.readouterr().err)
    assert not list((tmp_path / "out").rglob("*.png"))


def test_a_line_is_short_whatever_the_name(capsys: pytest.CaptureFixture[str]) -> None:
    """Of errors, of wrong words of a command, and of warnings."""
    long = "x" * 3000
    assert cli.main(["info", f"/{long}"]) == 1
    with pytest.raises(SystemExit):
        cli.main(["run", "a", f"--{long}"])
    with console_log():
        logging.getLogger("bmask_slam").warning("%s: left out", long)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) >= 3
    assert max(map(len, lines)) <= 500


def test_a_file_system_that_is_full_from_the_beginning(small_disk: Path) -> None:
    sequence = make_sequence(small_disk.parent / "seq")
    ballast = fill(small_disk)
    for free in (0, 4096, 8192):  # nothing, the headers of one table, of both
        os.truncate(ballast, ballast.stat().st_size - free)
        with pytest.raises(InputError, match="No space left on device"):
            run(RunOptions(sequence, out=small_disk / "a" / "run", quiet=True), FakeSystem)
        assert [path.name for path in small_disk.iterdir()] == ["ballast"]


FORBIDDEN = """
import contextlib, io, os, sys
from pathlib import Path
from bmask_slam import cli
folder = Path(sys.argv[1])
for line in sys.stdin:
    name, mode, *words = line.split()
    path = folder / name
    before = path.stat().st_mode
    path.chmod(int(mode, 8))
    there, errors = sorted(folder.iterdir()), io.StringIO()
    with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
        code = cli.main([word.replace("DIR", str(folder)) for word in words])
    path.chmod(before)
    written = errors.getvalue().splitlines()
    lines = [text for text in written if text.strip() and "frame/s" not in text]
    assert code == 1 and len(lines) == 1, (line, code, lines)
    assert lines[0].startswith("error: ") and name in lines[0], (line, lines)
    assert "Permission denied" in lines[0] and "; " in lines[0], (line, lines)
    assert sorted(folder.iterdir()) == there, line
"""
READ = "seq/rgb.txt seq/camera.yaml seq/groundtruth.txt seq/depth/0.000000.png seq"
CASES = [
    *(f"{name} 0 run DIR/seq --segmenter none --out DIR/new" for name in READ.split()),
    "seq/annotations.json 0 run DIR/seq --segmenter truth --out DIR/new",
    "c.yaml 0 run DIR/seq --config DIR/c.yaml --out DIR/new",
    "run/map 0 run DIR/seq --continue DIR/run --segmenter none --out DIR/new",
    "run/map 0 run DIR/seq --localise DIR/run --segmenter none --out DIR/new",
    "locked 500 run DIR/seq --segmenter none --out DIR/locked/new",
    "locked 500 live DIR/seq --segmenter none --out DIR/locked/new",
    "locked 500 live DIR/seq --segmenter none --out DIR/locked",
    "locked 500 render office --frames 1 --out DIR/locked/new",
    "locked 500 segment DIR/seq --segmenter truth --out DIR/locked/new",
    "locked 500 download tum/freiburg1_xyz --to DIR/locked",
    "locked 500 export DIR/run --format euroc --out DIR/locked/a.csv",
    "run/trajectory.txt 0 evaluate DIR/run --reference DIR/seq",
    "run/graph 0 optimise DIR/run --out DIR/new",
    "run/map 0 map DIR/run",
    "run/objects.json 0 query DIR/run chair",
    "c.yaml 0 compare DIR/c.yaml --out DIR/new",
]


def test_files_without_permission(office: Path, tmp_path: Path) -> None:
    """As root, in a process without the right to read and write everything."""
    shutil.copytree(office, tmp_path / "seq")
    for name in ("run", "locked"):
        (tmp_path / name).mkdir()
    for name in ("run/map", "run/graph", "run/objects.json", "c.yaml"):
        (tmp_path / name).touch()
    shutil.copy(office / "groundtruth.txt", tmp_path / "run" / "trajectory.txt")
    command = [sys.executable, "-c", FORBIDDEN, str(tmp_path)]
    if os.geteuid() == 0:
        if shutil.which("setpriv") is None:
            pytest.skip("root may read and write everything, and setpriv is not there")
        dropped = ("--inh-caps=-all", "--bounding-set=-dac_override,-dac_read_search")
        command = ["setpriv", *dropped, *command]
    given = "\n".join(CASES)
    done = subprocess.run(command, input=given, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
