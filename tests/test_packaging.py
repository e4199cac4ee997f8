"""The wheel: its contents, and that it works with user modules of the same names."""

from __future__ import annotations

import configparser
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from dataclasses import dataclass
from pathlib import Path

import pytest
from repository import ROOT
from source_tree import SOURCES, imported_names

PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = PYPROJECT["project"]
EXTRAS: dict[str, list[str]] = PROJECT["optional-dependencies"]
FOLDERS: dict[str, str] = PYPROJECT["tool"]["setuptools"]["package-dir"]
USERS_OWN = ("graph.py", "slam.py", "mapping.py", "semantics.py")
PUBLIC_NAMES = "SlamSystem, SystemConfig, Camera, Frame, open_sequence, run, evaluate, Run"


def packages_of_the_tree() -> dict[str, Path]:
    """Import name and folder of every package of the checkout."""
    found = {}
    for name, folder in FOLDERS.items():
        for path in (ROOT / folder).rglob("__init__.py"):
            inner = path.parent.relative_to(ROOT / folder).parts
            found[".".join((name, *inner))] = path.parent
    return found


def installed_path(path: Path) -> str:
    """The path of a file of the checkout in the wheel."""
    top, *inner = path.relative_to(ROOT).parts
    (name,) = (name for name, folder in FOLDERS.items() if folder == top)
    return "/".join((*name.split("."), *inner))


def files_of_the_tree() -> set[str]:
    """Path in the wheel of every module, template and style, of all data, and of py.typed."""
    kinds = ("*.py", "*.j2", "*.css")
    modules = {p for k in FOLDERS.values() for kind in kinds for p in (ROOT / k).rglob(kind)}
    data = {path for path in (ROOT / "data").rglob("*") if path.is_file()}
    chosen = {path for path in modules | data if "__pycache__" not in path.parts}
    return {installed_path(path) for path in (*chosen, ROOT / "slam/py.typed")}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel of a copy of the checkout, so that no build folders are made in it."""
    copy, folder = tmp_path_factory.mktemp("checkout"), tmp_path_factory.mktemp("wheel")
    for name in ("pyproject.toml", "README.md", *PROJECT["license-files"]):
        shutil.copy(ROOT / name, copy)
    for name in FOLDERS.values():
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / name, copy / name, ignore=ignored)
    code = f"from setuptools.build_meta import build_wheel; build_wheel({str(folder)!r})"
    _run([sys.executable, "-c", code], copy)
    (path,) = folder.glob("*.whl")
    return path


@dataclass(frozen=True)
class Environment:
    """A virtual environment with the wheel alone: its folder, and a folder of the user's."""

    path: Path
    users_folder: Path

    @property
    def site_packages(self) -> Path:
        """Where the wheel is installed."""
        (path,) = self.path.glob("lib/python3*/site-packages")
        return path

    def run(self, program: str, *arguments: str) -> str:
        """Output of a program of the environment, run in the user's folder."""
        return _run([str(self.path / "bin" / program), *arguments], self.users_folder)


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Environment:
    """The wheel installed; dependencies are those of the running environment.

    A line of a ``.pth`` file adds their folder behind the new one, but does not process the
    ``.pth`` files in it, so that an editable installation of the checkout has no effect.
    """
    environment = Environment(*(tmp_path_factory.mktemp(name) for name in ("env", "user")))
    _run([sys.executable, "-m", "venv", "--without-pip", str(environment.path)], wheel.parent)
    pip = [sys.executable, "-m", "pip", "--python", str(environment.path / "bin/python")]
    _run([*pip, "install", "--no-deps", "--no-index", str(wheel)], wheel.parent)
    dependencies = sorted({sysconfig.get_path(key) for key in ("purelib", "platlib")})
    pth = environment.site_packages / "dependencies.pth"
    pth.write_text("\n".join(dependencies) + "\n", encoding="utf-8")
    for name in USERS_OWN:
        text = f"raise ImportError('the user\\'s own {name} was imported')\n"
        (environment.users_folder / name).write_text(text, encoding="utf-8")
    return environment


def _run(command: list[str], folder: Path) -> str:
    variables = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    done = subprocess.run(
        command, cwd=folder, env=variables, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_listed_packages_are_those_of_the_tree() -> None:
    listed = PYPROJECT["tool"]["setuptools"]["packages"]
    assert len(listed) == len(set(listed))
    assert set(listed) == {*packages_of_the_tree(), "bmask_slam.data"}


def test_every_folder_with_modules_is_a_package() -> None:
    folders = {path.parent for k in FOLDERS.values() for path in (ROOT / k).rglob("*.py")}
    assert folders == set(packages_of_the_tree().values())


def test_the_wheel_holds_every_module_all_data_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if not name.endswith("/")}
    assert {name for name in names if not name.startswith("bmask_slam-")} == files_of_the_tree()
    assert "bmask_slam/py.typed" in names
    assert "bmask_slam/graph/geometry.py" in names
    for weights in ("light", "stuff"):
        assert f"bmask_slam/data/weights/{weights}.safetensors" in names


def test_the_licence_and_the_command_are_in_the_wheel(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        texts = {
            path.partition(".dist-info/")[2]: archive.read(path).decode()
            for path in archive.namelist()
            if path.startswith("bmask_slam-")
        }
    assert "Redistribution" in texts["licenses/LICENSE"]
    assert "Apache License" in texts["licenses/LICENSE.Apache-2.0"]
    assert "YOLOX-Nano" in texts["licenses/NOTICE"]  # whose weights are in the wheel
    assert "License-Expression: BSD-3-Clause AND Apache-2.0\n" in texts["METADATA"]
    points = configparser.ConfigParser()
    points.read_string(texts["entry_points.txt"])
    assert points["console_scripts"]["bmask-slam"] == "bmask_slam.cli:main"


def test_only_one_import_name_is_installed(installed: Environment) -> None:
    names = {path.name for path in installed.site_packages.iterdir()}
    (information,) = (name for name in names if name.endswith(".dist-info"))
    assert information.startswith("bmask_slam-")
    assert names - {"__pycache__"} == {"bmask_slam", information, "dependencies.pth"}


def test_it_works_with_user_modules_of_the_same_names(installed: Environment) -> None:
    assert set(USERS_OWN) <= {path.name for path in installed.users_folder.iterdir()}
    code = f"import bmask_slam; from bmask_slam import {PUBLIC_NAMES}; print(bmask_slam.__file__)"
    file = installed.run("python", "-c", code).strip()
    assert file == str(installed.site_packages / "bmask_slam/__init__.py")
    version = installed.run("bmask-slam", "--version")
    assert version == installed.run("python", "-m", "bmask_slam", "--version")
    assert re.fullmatch(r"bmask-slam \d+\.\d+\.\d+\n", version)


def test_every_shipped_configuration_is_in_the_wheel(installed: Environment) -> None:
    code = "from bmask_slam.graph.files.data_files import data_path; print(data_path('configs'))"
    folder = installed.run("python", "-c", code).strip()
    assert folder == str(installed.site_packages / "bmask_slam/data/configs")
    for path in (ROOT / "data/configs").glob("*.yaml"):
        installed.run("bmask-slam", "run", "-", "--config", path.stem, "--print-config")


TUTORIAL = ROOT / "docs/tutorials/bag_to_nav2.md"
COMMANDS = re.compile(r"^```\n(.*?)^```", re.DOTALL | re.MULTILINE)


def make_bag(sequence: Path, path: Path) -> None:
    """A recording as a ROS 2 bag, with the topics of a RealSense."""
    import numpy as np
    from recorded_bags import BagMaker, camera_info, image

    from bmask_slam.sequences.sequence import open_sequence

    recording, info = open_sequence(sequence), camera_info((0.0,) * 5)
    camera = recording.camera
    info.width, info.height, info.k = camera.width, camera.height, camera.K.ravel()
    with BagMaker(path) as bag:
        for frame in recording.frames():
            stamp_s = 1000 + frame.timestamp_s
            stored = np.nan_to_num(1000 * frame.depth_m).round().astype(np.uint16)
            bag.write("/camera/color/camera_info", stamp_s, info)
            bag.write("/camera/color/image_raw", stamp_s, image("rgb8", frame.rgb))
            bag.write("/camera/aligned_depth_to_color/image_raw", stamp_s, image("16UC1", stored))


def test_a_newcomers_path_from_pip_install_to_a_map_for_nav2(
    installed: Environment, office: Path, tmp_path: Path
) -> None:
    """The tutorial's commands as they stand, by a shell, in the environment with the wheel alone.

    ``pip`` finds the dependencies in the running environment and loads nothing.
    """
    from drive_map_files import load_nav2

    from bmask_slam.mapping.products.occupancy import FREE, OCCUPIED, UNKNOWN

    make_bag(office, tmp_path / "drive.mcap")
    pip = installed.path / "bin" / "pip"
    python = f'"{sys.executable}" -m pip --python "{installed.path}/bin/python"'
    pip.write_text(f'#!/bin/sh\nexec {python} "$@" --no-index\n', encoding="utf-8")
    pip.chmod(0o755)
    commands = COMMANDS.findall(TUTORIAL.read_text(encoding="utf-8"))
    assert commands[0] == "pip install 'bmask-slam[ros2,view,dense]'\n"
    words = ("info", "run", "map", "export", "view")
    assert [text.split()[1] for text in commands[1:]] == list(words)
    script = f'PATH="{installed.path}/bin:$PATH"\nset -e\n{"".join(commands)}'
    told = _run(["sh", "-c", script], tmp_path)
    assert "/camera/color/image_raw" in told
    grid = load_nav2(tmp_path / "drive.yaml")
    assert grid.resolution_m == 0.05
    assert min((grid.cells == kind).sum() for kind in (FREE, OCCUPIED, UNKNOWN)) > 50
    assert (tmp_path / "drive.rrd").stat().st_size > 10_000


def _constraints() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [line.split("==") for line in lines if line and not line.startswith("#")]
    assert all(len(pin) == 2 for pin in pins)
    return {_canonical(name): version for name, version in pins}


def _libraries_of_extras() -> list[str]:
    extras = (v for k, v in EXTRAS.items() if k not in ("all", "dev", "docs"))
    return [text for texts in extras for text in texts]


def _canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_every_requirement_is_a_range_that_its_constraint_is_in() -> None:
    from packaging.requirements import Requirement

    pins = _constraints()
    alone = ("realsense", "record3d", "oak", "azure")  # which are in no other extra
    extras = {k: v for k, v in EXTRAS.items() if k not in alone}
    for text in [*PROJECT["dependencies"], *(t for texts in extras.values() for t in texts)]:
        requirement = Requirement(text)
        if requirement.name != PROJECT["name"]:
            assert requirement.specifier.contains(pins[_canonical(requirement.name)]), text
    for text in [*PROJECT["dependencies"], *_libraries_of_extras()]:
        operators = {s.operator for s in Requirement(text).specifier}
        assert operators == {">=", "<"}, f"{text}: give a lower and an upper bound"


def test_every_import_is_a_declared_dependency() -> None:
    distributions = {
        "cv2": "opencv-python-headless",
        "yaml": "pyyaml",
        "faiss": "faiss-cpu",
        "mpl_toolkits": "matplotlib",
        "rerun": "rerun-sdk",
        "rerun_cli": "rerun-sdk",
        "foxglove": "foxglove-sdk",
        "PIL": "pillow",
        "ruamel": "ruamel.yaml",
    }
    declared, extras = (
        {_canonical(re.split(r"[><=]", text)[0]) for text in texts}
        for texts in (PROJECT["dependencies"], _libraries_of_extras())
    )
    needed = {name.partition(".")[0] for path in SOURCES for name, _ in imported_names(path)}
    needed -= {*sys.stdlib_module_names, *FOLDERS}
    assert {_canonical(distributions.get(name, name)) for name in needed} - extras == declared


def test_what_all_installs_has_the_packages_that_the_project_is_fixed_to() -> None:
    from packaging.requirements import Requirement

    (text,) = EXTRAS["all"]
    named = Requirement(text).extras
    assert named == set(EXTRAS) - {
        "all",
        "dev",
        "docs",
        "realsense",
        "record3d",
        "oak",
        "azure",
        "ros2",
    }
    assert f"{PROJECT['name']}[all]" in EXTRAS["dev"]  # which make demo installs
    texts = [*PROJECT["dependencies"], *(text for name in named for text in EXTRAS[name])]
    installed = {_canonical(Requirement(text).name) for text in texts}
    assert {"gtsam", "numpy", "opencv-python-headless", "filterpy", "torch", "open3d"} <= installed
