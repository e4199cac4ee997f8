"""The core runs without the libraries of the extras; what needs one says how to install it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.extras import import_extra

LIBRARIES = (
    "torch",
    "numba",
    "open3d",
    "safetensors",
    "libusb_package",
    "rerun",
    "ray",
    "rosbags",
    "shtab",
    "foxglove",
)
CALLS = """
import contextlib, io, json, sys
for name in LIBRARIES:
    sys.modules[name] = None  # as if it were not installed
import bmask_slam.cli
print(json.dumps(sorted({"numpy", "scipy", "cv2", "gtsam", "faiss", "yaml"} & set(sys.modules))))
import bmask_slam.comparison.comparing, bmask_slam.live.live_slam
for words in json.loads(sys.stdin.read()):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = bmask_slam.cli.main(words)
    print(json.dumps([status, out.getvalue(), err.getvalue()]))
"""


@pytest.fixture(scope="module")
def answers(office: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list]:
    """Exit status, stdout and stderr of commands, by their first words, without the libraries."""
    folder = tmp_path_factory.mktemp("core")
    run, sequence = str(folder / "run"), str(office)
    commands = {
        "run": ["run", sequence, "--segmenter", "none", "--out", run, "--quiet"],
        "evaluate": ["evaluate", run, "--reference", sequence],
        "optimise": ["optimise", run, "--out", str(folder / "better"), "--quiet"],
        "export": ["export", run, "--format", "g2o", "--out", str(folder / "run.g2o")],
        "info": ["info", sequence, "--json"],
        "live": ["live", sequence, "--segmenter", "none", "--out", str(folder / "live"), "--quiet"],
        "live --map-frames": ["live", sequence, "--map-frames", "3", "--out", f"{run}3"],
        "run light": ["run", sequence, "--out", str(folder / "light"), "--quiet"],
        "run --map": ["run", sequence, "--segmenter", "none", "--map", "--out", f"{run}2"],
        "map": ["map", run],
        "train": ["train", "--data", "a.json", "--images", "a", "--out", str(folder / "w")],
        "render": ["render", "office", "--out", str(folder / "office"), "--quiet"],
        "view": ["view", run, "--record", str(folder / "run.rrd")],
        "view foxglove": ["view", run, "--foxglove", str(folder / "run.mcap")],
    }
    done = subprocess.run(
        [sys.executable, "-c", f"LIBRARIES = {LIBRARIES}\n{CALLS}"],
        input=json.dumps(list(commands.values())),
        capture_output=True,
        text=True,
        check=True,
    )
    loaded, *answers = map(json.loads, done.stdout.splitlines())
    return {"import": loaded, **dict(zip(commands, answers, strict=True))}


def test_the_command_line_loads_no_heavy_library(answers: dict[str, list]) -> None:
    """So its help comes at once: each command loads what it needs."""
    assert answers["import"] == []


@pytest.mark.parametrize("name", ["run", "live", "evaluate", "optimise", "export", "info"])
def test_the_core_needs_no_extra(answers: dict[str, list], name: str) -> None:
    status, output, errors = answers[name]
    assert status == 0, errors
    assert output


def test_an_option_of_a_dense_map_that_is_not_made_asks_for_no_extra(
    answers: dict[str, list],
) -> None:
    status, _, errors = answers["live --map-frames"]
    assert status == 1
    assert "--map-frames 3: is for the dense map; give --map too" in errors


@pytest.mark.parametrize(
    ("name", "library", "extra"),
    [
        ("run light", "torch", "semantics"),
        ("run --map", "torch", "dense"),
        ("map", "torch", "dense"),
        ("train", "torch", "semantics"),
        ("render", "libusb_package", "render"),
        ("view", "rerun", "view"),
        ("view foxglove", "foxglove", "foxglove"),
    ],
)
def test_what_is_missing_is_one_line_with_its_cure(
    answers: dict[str, list], name: str, library: str, extra: str
) -> None:
    status, _, errors = answers[name]
    assert status == 1
    (line,) = errors.splitlines()
    assert f"needs {library}, which is not installed" in line
    assert f"pip install 'bmask-slam[{extra}]'" in line


@pytest.mark.parametrize(
    ("code", "what"),
    [
        ("raise ImportError('libx.so.1: cannot open\\n shared object')", "libx.so.1: cannot open"),
        ("raise OSError('libx.so.1: no such file')", "libx.so.1: no such file"),
        ("import no_such_part_of_it", "No module named 'no_such_part_of_it'"),
    ],
)
def test_a_library_that_cannot_be_loaded_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, what: str
) -> None:
    (tmp_path / "broken_library.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(InputError, match="needs broken_library, which cannot be loaded") as caught:
        import_extra("broken_library", "a test", "some")
    assert what in str(caught.value)
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="needs no_such_library, which is not installed"):
        import_extra("no_such_library.part", "a test", "some")


def test_info_as_json(answers: dict[str, list], office: Path) -> None:
    found = json.loads(answers["info"][1])
    assert (found["frames"], found["camera"]["width"], found["folder"]) == (15, 160, str(office))


def test_a_run_without_torch_can_go_without_labels(answers: dict[str, list]) -> None:
    assert "or take --segmenter none" in answers["run light"][2]
