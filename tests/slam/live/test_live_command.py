"""``bmask-slam live``: its files after every kind of end, those by a signal as a process."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from faults import frames_written
from scipy.spatial import cKDTree

from bmask_slam.cli import main
from bmask_slam.graph.files.ply import read_ply
from bmask_slam.graph.trajectory import read_tum
from bmask_slam.live.start import LiveOptions

FRAMES, ALL_FRAMES = 24, 60
SHORT = ("--max-frames", str(FRAMES))
UNCALIBRATED = ("--segmenter", "none", "--calibrate", "off")
COARSE = ("--mesh-voxel", "0.02")


def start(recording: Path, out: Path, *options: str) -> subprocess.Popen[str]:
    command = [
        sys.executable,
        "-m",
        "bmask_slam",
        "live",
        str(recording),
        "--out",
        str(out),
        *options,
    ]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_masks_from_another_process_label_the_map(slow_office, tmp_path, capsys) -> None:
    out = tmp_path / "run"
    assert main(["live", str(slow_office), "--out", str(out), "--segmenter", "truth", *SHORT]) == 0
    assert "latency_ms_median" in capsys.readouterr().out
    health = json.loads((out / "health.json").read_text())
    assert health["frames"] == FRAMES == len(read_tum(out / "trajectory.txt"))
    assert health["segmenter_deaths"] == health["map_deaths"] == 0
    assert len((out / "labels.csv").read_text().splitlines()) > 100
    assert json.loads((out / "objects.json").read_text())["objects"]


@pytest.mark.parametrize("most", ["-1", "nan", "inf"])
def test_a_number_of_frames_that_is_none_is_named_as_it_was_given(office, most, capsys) -> None:
    assert main(["live", str(office), "--map", "--map-frames", most]) == 1
    said = capsys.readouterr().err
    assert f"error: --map-frames {most}: must be 0 or more frames a second" in said


def test_a_live_dense_map_equals_the_offline_one_and_can_be_continued(
    slow_office, tmp_path, capsys
) -> None:
    """After a dropped frame, keyframe numbers differ from image numbers."""
    out, offline, some = tmp_path / "live", tmp_path / "offline", ("--max-frames", "16")
    words = ["live", str(slow_office), "--out", str(out), "--realtime", "--map"]
    assert main([*words, *COARSE, *UNCALIBRATED, *some]) == 0
    assert "Dense map" in capsys.readouterr().out
    common = [str(slow_office), "--segmenter", "none", "--out", str(offline), "--quiet", *some]
    assert main(["run", *common]) == 0
    assert main(["map", str(offline), *COARSE, "--quiet"]) == 0
    clouds = [read_ply(path / "dense" / "cloud.ply") for path in (out, offline)]
    live_points, offline_points = (np.stack([c[axis] for axis in "xyz"], axis=1) for c in clouds)
    for found, other in ((live_points, offline_points), (offline_points, live_points)):
        distances_m = cKDTree(other).query(found[::5])[0]
        assert (distances_m < 0.03).mean() > 0.9
        assert distances_m[distances_m < 0.05].mean() < 0.01
    fused = sorted((out / "dense" / "depth").iterdir())
    fused[0].unlink()
    capsys.readouterr()
    assert main(["map", str(out), *COARSE]) == 0
    summary = capsys.readouterr().out
    assert f"1 fused, {len(fused) - 1} were finished" in summary
    assert "left out" not in summary


@pytest.mark.parametrize(
    ("number", "options"),
    [(signal.SIGINT, ["--map", *COARSE]), (signal.SIGTERM, [])],
    ids=["INT", "TERM"],
)
def test_a_signal_ends_it_with_everything_saved(slow_office, tmp_path, number, options) -> None:
    out = tmp_path / "run"
    live = start(slow_office, out, "--realtime", *options, *UNCALIBRATED)
    deadline_s = time.monotonic() + 300
    while frames_written(out) < 8 and time.monotonic() < deadline_s:
        time.sleep(0.05)
    live.send_signal(number)
    _, errors = live.communicate(timeout=300)
    assert live.returncode == 128 + number, errors
    tracked = len(read_tum(out / "trajectory.txt"))
    assert 8 <= tracked == frames_written(out) < ALL_FRAMES
    assert {"map", "metrics.json", "landmarks.ply"} <= {path.name for path in out.iterdir()}
    if options:
        assert read_ply(out / "dense" / "cloud.ply")["x"].size > 1000


def test_config_yaml_of_a_live_run_names_its_folder_by_the_absolute_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert f", sequence {tmp_path / 'hall'}, stride 1" in str(
        LiveOptions(images=Path("hall")).origin
    )
    assert str(LiveOptions().origin).endswith(", live")
