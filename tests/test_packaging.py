"""The wheel: what is in it, and that it works on its own, outside the checkout."""

from __future__ import annotations

import configparser
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from repository import ROOT

PACKAGES = ("graph", "semantics", "mapping", "slam")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel of the checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    code = f"from hatchling.build import build_wheel; build_wheel({str(folder)!r})"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel unpacked, as an installation has it, far from the checkout."""
    folder = tmp_path_factory.mktemp("site")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def run_installed(installed: Path, *arguments: str) -> str:
    """Output of Python with the unpacked wheel ahead of everything else."""
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    command = [sys.executable, *arguments]
    done = subprocess.run(
        command, cwd=installed.parent, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_wheel_holds_every_module_and_all_data(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    modules = {str(p.relative_to(ROOT)) for k in PACKAGES for p in (ROOT / k).rglob("*.py")}
    data = {
        f"slam/{path.relative_to(ROOT)}"
        for path in (ROOT / "data").rglob("*")
        if path.is_file() and not path.name.startswith(".")
    }
    assert modules <= names
    assert data <= names
    strangers = {
        n for n in names if not n.startswith((*(f"{k}/" for k in PACKAGES), "bmask_slam-"))
    }
    assert strangers == set()
    assert not any("__pycache__" in name for name in names)


def test_the_licence_and_the_command_are_in_the_wheel(installed: Path) -> None:
    (information,) = installed.glob("bmask_slam-*.dist-info")
    assert "Redistribution" in (information / "licenses/LICENSE").read_text()
    assert "License-Expression: BSD-3-Clause" in (information / "METADATA").read_text()
    points = configparser.ConfigParser()
    points.read(information / "entry_points.txt")
    assert points["console_scripts"]["bmask-slam"] == "bmask_slam.cli:main"


def test_the_wheel_works_outside_the_checkout(installed: Path) -> None:
    found = run_installed(
        installed, "-c", "import slam, graph; print(slam.__file__, graph.__file__)"
    )
    assert found.split() == [str(installed / f"{k}/__init__.py") for k in ("slam", "graph")]
    assert "usage: bmask-slam" in run_installed(installed, "-m", "bmask_slam", "--help")


def test_every_shipped_configuration_is_found_in_the_wheel(installed: Path) -> None:
    code = "from bmask_slam.graph.data_files import data_path; print(data_path('configs'))"
    assert run_installed(installed, "-c", code).strip() == str(installed / "slam/data/configs")
    for path in (ROOT / "data/configs").glob("*.yaml"):
        run_installed(
            installed, "-m", "bmask_slam", "run", "-", "--config", path.stem, "--print-config"
        )


def _constraints() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [line.split("==") for line in lines if line and not line.startswith("#")]
    assert all(len(pin) == 2 for pin in pins)
    return {_canonical(name): version for name, version in pins}


def _canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_every_requirement_is_a_range_that_its_constraint_is_in() -> None:
    from packaging.requirements import Requirement

    pins = _constraints()
    for text in PROJECT["dependencies"] + PROJECT["optional-dependencies"]["dev"]:
        requirement = Requirement(text)
        assert requirement.specifier.contains(pins[_canonical(requirement.name)]), text
    for text in PROJECT["dependencies"]:
        operators = {s.operator for s in Requirement(text).specifier}
        assert operators == {">=", "<"}, f"{text}: give a lower and an upper bound"


def test_every_import_is_a_declared_dependency() -> None:
    import ast

    distributions = {
        "cv2": "opencv-python-headless",
        "yaml": "pyyaml",
        "faiss": "faiss-cpu",
        "mpl_toolkits": "matplotlib",
        "rerun": "rerun-sdk",
    }
    optional = [t for k, v in PROJECT["optional-dependencies"].items() if k != "dev" for t in v]
    declared, extras = (
        {_canonical(re.split(r"[><=]", text)[0]) for text in texts}
        for texts in (PROJECT["dependencies"], optional)
    )
    needed = set()
    for path in (p for k in PACKAGES for p in (ROOT / k).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                needed |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                needed.add(str(node.module).partition(".")[0])
    needed -= {*sys.stdlib_module_names, *PACKAGES}
    assert {_canonical(distributions.get(name, name)) for name in needed} - extras == declared
