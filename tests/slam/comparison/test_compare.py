"""A whole comparison: run, killed, resumed, evaluated, reported."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from repository import ROOT
from small_comparison import unsaved

from bmask_slam.cli import main
from bmask_slam.comparison import CellStatus, CompareOptions, Comparison, compare, read_results
from bmask_slam.comparison.jobs.job import environment
from bmask_slam.comparison.report import figures
from bmask_slam.comparison.text import format_comparison
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.graph.trajectory import read_tum, write_tum

EXPERIMENT = """\
sequences: {office: office}
configurations:
  default: {segmenter: none}
  broken: {segmenter: precomputed}
systems:
  other: {trajectories: {office: moved.txt}}
published:
  - {method: paper, source: Table 1, ate_rmse: {office: 0.02}}
"""
SEEDS = EXPERIMENT.partition("  broken")[0] + "seeds: [0, 1]\n"
DONE, FAILED = CellStatus.DONE, CellStatus.FAILED


@pytest.fixture(scope="module")
def data(office, tmp_path_factory) -> Path:
    """A small sequence, its truth in another world frame, and experiments on it."""
    folder = tmp_path_factory.mktemp("data")
    (folder / "office").symlink_to(office)
    truth = read_tum(folder / "office" / "groundtruth.txt")
    write_tum(folder / "moved.txt", truth.moved(se3_exp([1, -2, 0.5, 3, 2, 1])))
    (folder / "mine.yaml").write_text(EXPERIMENT)
    (folder / "seeds.yaml").write_text(SEEDS)
    return folder


def run_again(data: Path, out: Path) -> Comparison:
    options = CompareOptions(configurations=("default",), quiet=True)
    return compare(data / "mine.yaml", out, options)


def test_a_comparison_end_to_end(data, tmp_path, monkeypatch):
    out = tmp_path / "out"
    found = compare(data / "mine.yaml", out, CompareOptions(quiet=True))
    cells = {cell.method: cell for cell in found.cells}
    assert [m.name for m in found.methods] == ["default", "broken", "other", "paper"]
    status = {name: cell.status for name, cell in cells.items()}
    assert status == {"default": DONE, "broken": FAILED, "other": DONE, "paper": DONE}
    own = cells["default"].metrics
    assert 0 < own["ate_rmse"] < 0.02
    assert own["tracked_share"] == own["evaluated_share"] == 1
    assert {"rpe_rot_rmse_frame", "ate_rot_rmse", "tracking_ms_median", "peak_rss_mb"} <= set(own)
    assert cells["other"].metrics["ate_rmse"] == pytest.approx(0, abs=1e-6)
    assert "rpe_trans_rmse_frame" in cells["other"].metrics
    assert cells["other"].metrics["tracked_share"] == 1
    assert cells["paper"].metrics == {"ate_rmse": 0.02}
    assert "masks" in cells["broken"].error
    assert cells["broken"].error in (out / cells["broken"].log).read_text()
    assert (out / cells["default"].trajectory).is_file()
    assert read_results(out) == found
    assert {"report.html", "tables.csv"} <= {path.name for path in out.iterdir()}
    assert {"commit", "machine", "packages", "date"} <= set(found.provenance)
    text = format_comparison(found)
    assert "failed: office: broken" in text
    assert "2.00" in text

    monkeypatch.setattr(figures, "as_picture", unsaved)
    record = out / "cells/office/default/0/cell.json"
    before = record.stat().st_mtime_ns
    assert run_again(data, out).cells[0] == found.cells[0]
    assert record.stat().st_mtime_ns == before, "a finished cell was run again"
    changed = json.loads(record.read_text())
    changed["depends"]["code"] = "another"
    record.write_text(json.dumps(changed))
    run_again(data, out)
    assert json.loads(record.read_text())["depends"]["code"] != "another"


def test_a_failed_rendering_fails_only_its_cells(data, tmp_path, monkeypatch):
    """The office has fewer frames; a rendered room's trajectory is evaluated against its truth."""
    monkeypatch.setattr(figures, "as_picture", unsaved)
    text = EXPERIMENT.partition("  broken")[0].replace(
        "sequences: {office: office}",
        "sequences: {office: office, long: {render: {name: office, frames: 9999, width: 160}}}",
    )
    (data / "long.yaml").write_text(text)
    found = compare(data / "long.yaml", tmp_path / "out", CompareOptions(quiet=True))
    office, long = found.cells
    assert (office.status, long.status) == (DONE, FAILED)
    assert long.error.startswith("rendering failed: frames=9999: the path of 'office' has")
    assert "9999" in (tmp_path / "out" / long.log).read_text()


def start(data: Path, out: Path) -> subprocess.Popen:
    words = ["compare", str(data / "seeds.yaml"), "--out", str(out), "--jobs", "1"]
    return subprocess.Popen(
        [sys.executable, "-m", "bmask_slam", *words],
        cwd=ROOT,
        env=environment(1),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        preexec_fn=_heeds_interrupts,  # noqa: PLW1509 - no threads are held here
    )


def _heeds_interrupts() -> None:
    """Whether SIGINT is not ignored, as it is in background jobs of a shell."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def wait_for(path: Path, process: subprocess.Popen) -> None:
    end_s = time.monotonic() + 300
    while not path.exists():
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < end_s
        time.sleep(0.02)


def processes_on(folder: Path) -> list[str]:
    """Processes other than zombies whose command line names a folder."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                words = (entry / "cmdline").read_bytes()
            except OSError:
                continue
            if os.fsencode(str(folder)) in words:
                found.append(entry.name)
    return found


@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="looks into /proc")
def test_a_killed_and_an_interrupted_comparison_are_resumed(data, tmp_path):
    """Killed in its second cell, interrupted there again, then run to its end."""
    out = tmp_path / "out"
    records = [out / f"cells/office/default/{seed}/cell.json" for seed in range(2)]
    logs = [record.with_name("log.txt") for record in records]
    with start(data, out) as process:
        wait_for(logs[1], process)
        process.send_signal(signal.SIGKILL)
    assert not records[1].exists()
    first = records[0].stat().st_mtime_ns
    logs[1].unlink()
    with start(data, out) as process:
        wait_for(logs[1], process)
        process.send_signal(signal.SIGINT)
        process.wait(60)
    assert process.returncode == 130
    assert not processes_on(out)
    with start(data, out) as process:
        process.wait(60)
    assert process.returncode == 0
    assert [cell.status for cell in read_results(out).cells] == [DONE] * 2
    assert records[0].stat().st_mtime_ns == first


def test_a_missing_sequence_does_not_affect_the_others(tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "as_picture", unsaved)
    monkeypatch.chdir(tmp_path)
    truth = "".join(f"{k} {k % 3} {k % 5} {k % 7} 0 0 0 1\n" for k in range(10))
    (tmp_path / "freiburg1_xyz-groundtruth.txt").write_text(truth)
    (tmp_path / "freiburg1_xyz-rgbdslam.txt").write_text(truth)
    found = compare("paper", tmp_path / "out", CompareOptions((tmp_path,), quiet=True))
    cells = {(cell.sequence, cell.method): cell for cell in found.cells}
    missing = cells["freiburg1_xyz", "default"]
    assert missing.status is CellStatus.PENDING
    assert "bmask-slam download tum/freiburg1_xyz" in missing.error
    assert cells["freiburg1_xyz", "RGB-D SLAM (run)"].metrics["ate_rmse"] == pytest.approx(0)


SHARED = ROOT / "../shared/data/trajectories"


@pytest.mark.skipif(not SHARED.is_dir(), reason="no ../shared/data/trajectories here")
@pytest.mark.parametrize("given", ["data", "trajectory"])
def test_rgbd_slam_on_freiburg1_xyz(given, tmp_path, monkeypatch):
    """The shipped experiment prints 1.35 cm; truth is found beside the trajectory."""
    monkeypatch.setattr(figures, "as_picture", unsaved)
    monkeypatch.chdir(tmp_path)
    row = "RGB-D SLAM (run)"
    file = SHARED / "freiburg1_xyz-rgbdslam.txt"
    options = CompareOptions(trajectories={(row, "freiburg1_xyz"): file}, quiet=True)
    if given == "data":
        options = CompareOptions(data=(SHARED,), quiet=True)
    found = compare("paper", tmp_path / "out", options)
    (line,) = (t for t in format_comparison(found).splitlines() if t.startswith(row))
    assert "1.35" in line


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (CompareOptions(sequences=("attic",)), "--sequences attic: .* there are: office"),
        (CompareOptions(configurations=("x",)), "--configurations x: .* there are: default"),
        (CompareOptions(references={"x": Path("y")}), "--reference x"),
        (CompareOptions(references={"office": Path("y")}), "--reference y: no such file"),
        (CompareOptions(trajectories={("a", "attic"): Path("y")}), "a:attic: no such sequence"),
        (CompareOptions(trajectories={("a", "office"): Path("y")}), "y: no such file"),
        (CompareOptions(trajectories={("default", "office"): Path("y")}), "another row's name"),
    ],
)
def test_names_outside_the_experiment_are_rejected(data, tmp_path, options, message):
    with pytest.raises(InputError, match=message):
        compare(data / "mine.yaml", tmp_path / "out", options)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["rendred"], "no such file; there are: bonn"),
        (["rendered", "--seeds", "0,x"], "--seeds 0,x: write whole numbers"),
        (["rendered", "--seeds", "\N{SUPERSCRIPT TWO}"], ": write whole numbers, as 0,1,2"),
        (["rendered", "--reference", "x"], "--reference x: write it as SEQUENCE=FILE"),
        (["rendered", "--trajectory", "x"], "--trajectory x: write it as METHOD:SEQUENCE=FILE"),
        (["rendered", "--jobs", "0"], "--jobs 0: must be at least 1"),
        (["rendered", "--sequences", "attic"], "--sequences attic: not in"),
    ],
)
def test_a_wrong_command_line_is_one_line(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["compare", *words]) == 1
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_impossible_options_are_refused():
    for wrong in ({"workers": 0}, {"seeds": ()}, {"seeds": (-1,)}):
        with pytest.raises(InputError):
            CompareOptions(**wrong)
