"""The public Python API: names, loaded modules, and the examples of the docs."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import os
import re
import subprocess
import sys
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest
from repository import ROOT

import bmask_slam
from bmask_slam.api import MapKeywords, RunKeywords
from bmask_slam.dense.options import MapOptions
from bmask_slam.offline.options import RunOptions

REFERENCE = (ROOT / "docs/python.md").read_text(encoding="utf-8")
README = (ROOT / "README.md").read_text(encoding="utf-8")
PYTHON = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
FRAMES = 14
MAX_QUICK_START_LINES = 12


def output(code: str, folder: Path = ROOT) -> str:
    """What a program prints in a process of its own."""
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def loaded_by(code: str) -> list[str]:
    """What a program prints, and the names of the heavy packages that are loaded after it."""
    heavy = {"gtsam", "torch", "open3d", "matplotlib", "cv2", "scipy", "yaml"}
    return output(f"{code}\nimport sys; print(*({heavy} & set(sys.modules)))").split()


@pytest.mark.parametrize("name", bmask_slam.__all__)
def test_a_public_name_is_importable_described_and_documented(name: str) -> None:
    value = getattr(bmask_slam, name)
    assert name in dir(bmask_slam)
    assert name == "__version__" or inspect.getdoc(value)
    assert f"`{name}`" in REFERENCE


@pytest.mark.parametrize("kind", [RunKeywords, MapKeywords, bmask_slam.Run])
def test_each_keyword_and_each_part_of_a_run_is_documented(kind: type) -> None:
    parts = {n for n, v in vars(kind).items() if isinstance(v, (property, cached_property))}
    names = parts or set(kind.__annotations__)
    assert not [n for n in names if not n.startswith("_") and f"`{n}`" not in REFERENCE]


def test_type_checkers_find_each_name_where_it_is_loaded_from() -> None:
    tree = ast.parse((ROOT / "slam/__init__.py").read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    typed = {alias.name: node.module for node in imports for alias in node.names}
    loaded = {name: f"bmask_slam.{module}" for name, module in bmask_slam._MODULES.items()}
    assert typed == loaded
    assert {*typed, "__version__"} == set(bmask_slam.__all__)


def test_another_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="module 'bmask_slam' has no attribute 'Rum'"):
        bmask_slam.Rum  # noqa: B018


def test_the_import_loads_nothing_else() -> None:
    """So it takes milliseconds."""
    assert loaded_by("import bmask_slam") == []
    assert loaded_by("import bmask_slam, bmask_slam.graph.geometry") == []


def test_a_trajectory_is_read_without_heavy_packages(tmp_path: Path) -> None:
    (tmp_path / "trajectory.txt").write_text("0.0 0 0 0 0 0 0 1\n0.1 1 2 3 0 0 0 1\n")
    code = f"import bmask_slam; print(len(bmask_slam.Run({str(tmp_path)!r}).trajectory))"
    number, *loaded = loaded_by(code)
    assert number == "2" and set(loaded) <= {"cv2", "scipy"}


@pytest.mark.parametrize(
    ("keywords", "options", "named"),
    [
        (RunKeywords, RunOptions, {"sequence", "config", "config_name", "out"}),
        (MapKeywords, MapOptions, {"run", "masks", "mesh", "plan"}),
    ],
)
def test_every_option_has_a_keyword(keywords: type, options: type, named: set[str]) -> None:
    fields = {field.name for field in dataclasses.fields(options)}
    assert set(keywords.__annotations__) | named == fields | {"quiet"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"strid": 3}, r"run\(\): unknown key strid; did you mean stride\?"),
        ({"stride": "3"}, r"run\(\): stride = .*3.* is not a whole number"),
        ({"stride": 0}, "stride 0: must be a whole number of at least 1"),
        ({"max_frames": 2.5}, r"max_frames = 2.5 is not a whole number"),
        ({"overwrite": "yes"}, r"overwrite = .*yes.* is not true or false"),
        ({"out": 7}, r"run\(\): out = 7 is not a"),
        (
            {"camera": bmask_slam.Camera(640, 480, 525.0, 525.0, 319.5, 239.5)},
            r"run\(\): camera: a Camera; give a .* file",
        ),
        ({"settings": {"covariances": object()}}, "settings: covariances: a object; give a"),
        ({"segmenter": "lite"}, "'lite': not known; there are: light, .*none"),
        ({"segmenter": object()}, "segmenter: a object; give a name"),
        ({"config": "no/such.yaml"}, r"no/such\.yaml: "),
        ({"settings": {"tracking.min_inliers": "x"}}, r"tracking\.min_inliers = .*whole number"),
        (
            {"config": bmask_slam.SystemConfig(), "settings": {"covariances": True}},
            "settings beside a SystemConfig",
        ),
    ],
)
def test_arguments_of_run_are_checked(
    recording: Path, tmp_path: Path, options: dict, message: str
) -> None:
    with pytest.raises(bmask_slam.InputError, match=message):
        bmask_slam.run(recording, **{"out": tmp_path / "out", **options})
    assert not (tmp_path / "out").exists()


def test_numbers_of_numpy_are_numbers(recording: Path, tmp_path: Path) -> None:
    settings = {"tracking.min_inliers": np.int64(30), "features.layer_shares": np.ones(2) / 2}
    whole = {"stride": np.int32(2), "max_frames": np.int64(1)}
    out = tmp_path / "out"
    run = bmask_slam.run(recording, out, segmenter="none", settings=settings, **whole)
    assert len(run.frames) == 1
    assert run.config.tracking.min_inliers == 30
    assert run.config.features.layer_shares == (0.5, 0.5)


def test_folders_of_a_live_run_may_be_texts() -> None:
    options = bmask_slam.LiveOptions(out="runs/x", images="path/to/recording")
    assert (options.out, options.images) == (Path("runs/x"), Path("path/to/recording"))
    assert bmask_slam.LiveOptions().out is None
    with pytest.raises(bmask_slam.InputError, match="LiveOptions: out is a int; give a path"):
        bmask_slam.LiveOptions(out=7)


def test_a_camera_and_a_frame_of_open_sequence_are_checked(recording: Path) -> None:
    with pytest.raises(bmask_slam.InputError, match="nowhere: no such file; give a camera"):
        bmask_slam.open_sequence(str(recording), camera="nowhere")
    sequence = bmask_slam.open_sequence(str(recording), camera=str(recording / "camera.yaml"))
    for index in (-1, len(sequence)):
        with pytest.raises(bmask_slam.InputError, match=f"no frame {index}; there are 0 to"):
            sequence.load(index)


def test_arguments_of_map_run_are_checked(tmp_path: Path) -> None:
    with pytest.raises(bmask_slam.InputError, match=r"map_run\(\): voxel_m = .* is not a number"):
        bmask_slam.map_run(tmp_path, voxel_m="1 cm")


def test_a_signal_is_raised_again_once_the_run_is_saved(recording: Path, tmp_path: Path) -> None:
    code = (
        "import os, signal, bmask_slam; from bmask_slam.system import SlamSystem\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "process = SlamSystem.process\n"
        "def stop(self, frame, features=None):\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "    return process(self, frame, features)\n"
        "SlamSystem.process = stop\n"
        f"paths = {str(recording)!r}, {str(tmp_path / 'out')!r}\n"
        "try:\n    bmask_slam.run(*paths, segmenter='none')\n"
        "except KeyboardInterrupt:\n    print('interrupted')\n"
    )
    assert output(code) == "interrupted\n"
    assert bmask_slam.Run(tmp_path / "out").metrics["tracked_share"].value == 1.0


@pytest.fixture(scope="module")
def recording(slow_office: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short rendered sequence, as path/to/recording from a working directory."""
    folder = tmp_path_factory.mktemp("user") / "path/to"
    path = folder / "recording"
    path.mkdir(parents=True)
    for name in ("rgb", "depth", "depth.txt", "camera.yaml", "groundtruth.txt"):
        os.symlink(slow_office / name, path / name)
    lines = (slow_office / "rgb.txt").read_text().splitlines(keepends=True)
    listed = [line for line in lines if not line.startswith("#")]
    (path / "rgb.txt").write_text("".join(listed[:FRAMES]))
    os.symlink(path / "groundtruth.txt", folder / "groundtruth.txt")
    return path


def test_the_quick_start_runs_as_it_stands(recording: Path) -> None:
    (code,) = PYTHON.findall(README)
    assert len(code.splitlines()) <= MAX_QUICK_START_LINES
    lines = output(code, recording.parents[2]).splitlines()
    assert re.fullmatch(rf"{FRAMES} poses, \d{{3,}} landmarks", lines[0])
    value, unit = lines[-1].split()
    assert float(value) < 0.01 and unit == "m"
    run = bmask_slam.Run(recording.parents[2] / "runs/first")
    assert len(lines) == 2 + len(run.objects)
    assert (run.path / "dense/mesh.ply").is_file()
    assert len(run.dense_cloud) > 1000


def test_the_examples_of_the_reference_run_as_they_stand(recording: Path) -> None:
    (code,) = PYTHON.findall(REFERENCE)
    *frames, shapes = output(code, recording.parents[2]).splitlines()
    assert len(frames) == FRAMES
    assert shapes.startswith(f"({FRAMES}, 3) (")
