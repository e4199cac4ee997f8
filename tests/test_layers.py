"""The rules that keep the code readable, checked on the source: layers, imports, sizes."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from repository import ROOT

LAYERS = ("graph", "semantics", "mapping", "slam")  # each imports only from its left
NUMPY_ONLY = ("geometry", "camera", "errors", "trajectory", "metrics", "updates", "ply")
MAX_LINES = 330
MAX_FUNCTION_LINES = 60
SOURCES = [path for layer in LAYERS for path in sorted((ROOT / layer).rglob("*.py"))]


@cache
def parse(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def imports(path: Path) -> Iterator[str]:
    """Every dotted name that a module imports, also inside its functions; fails on relative."""
    for node in ast.walk(parse(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: write imports in full"
            yield str(node.module)


def offenders(package: str) -> set[str]:
    """Modules that import a package, by path from the root."""
    return {
        str(path.relative_to(ROOT))
        for path in SOURCES
        if package in {name.partition(".")[0] for name in imports(path)}
    }


def test_there_is_something_to_check() -> None:
    assert {path.relative_to(ROOT).parts[0] for path in SOURCES} == set(LAYERS)
    assert "graph/smoother/smoother.py" in offenders("numpy")


@pytest.mark.parametrize("layer", LAYERS)
def test_a_layer_imports_only_from_its_left(layer: str) -> None:
    forbidden = LAYERS[LAYERS.index(layer) + 1 :]
    found = {name: paths for name in forbidden if (paths := _within(layer, offenders(name)))}
    assert found == {}


def _within(folder: str, paths: set[str]) -> set[str]:
    return {path for path in paths if path.startswith(f"{folder}/")}


def test_gtsam_stays_in_graph() -> None:
    assert offenders("gtsam") - _within("graph", offenders("gtsam")) == set()


def test_graph_knows_no_images_and_no_networks() -> None:
    for package in ("cv2", "torch", "open3d", "matplotlib"):
        assert _within("graph", offenders(package)) == set()


def test_torch_stays_in_semantics_and_mapping() -> None:
    assert _within("slam", offenders("torch")) == set()


def test_open3d_is_imported_only_by_its_loader() -> None:
    assert {Path(path).name for path in offenders("open3d")} <= {"open3d_loader.py"}


def test_no_module_of_ours_needs_a_development_tool() -> None:
    for package in ("pytest", "hypothesis", "evo", "tests"):
        assert offenders(package) == set()


def test_numpy_only_modules_import_without_anything_else() -> None:
    modules = ", ".join(f"graph.{name}" for name in NUMPY_ONLY)
    code = (
        f"import sys, {modules}\n"
        "heavy = {'gtsam', 'scipy', 'cv2', 'torch', 'open3d', 'matplotlib', 'yaml'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout == "[]\n"


def test_every_package_and_module_says_what_it_is() -> None:
    silent = [p for p in SOURCES if not ast.get_docstring(parse(p))]
    assert silent == []


def test_files_are_short() -> None:
    lengths = {str(p.relative_to(ROOT)): len(p.read_text("utf-8").splitlines()) for p in SOURCES}
    assert {path: n for path, n in lengths.items() if n > MAX_LINES} == {}


def test_functions_are_short() -> None:
    found = {}
    for path in SOURCES:
        for node in ast.walk(parse(path)):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                lines = (node.end_lineno or node.lineno) - node.lineno + 1
                if lines > MAX_FUNCTION_LINES:
                    found[f"{path.relative_to(ROOT)}:{node.name}"] = lines
    assert found == {}


def test_only_the_command_line_prints() -> None:
    found = set()
    for path in SOURCES:
        for node in ast.walk(parse(path)):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "print":
                found.add(str(path.relative_to(ROOT)))
    assert {path for path in found if not path.startswith("slam/commands/")} <= {"slam/cli.py"}
