"""The site's pages are complete and right: parameters, public names, messages, tutorials."""

from __future__ import annotations

import ast
import re
import runpy
import subprocess
import sys
from pathlib import Path

from repository import ROOT
from source_tree import SOURCES, nodes

import bmask_slam
from bmask_slam.config.configuration import _paths, dump
from bmask_slam.system_config import SystemConfig

DOCS = ROOT / "docs"
TUTORIALS = [DOCS / "index.md", *sorted((DOCS / "tutorials").glob("*.md"))]
PYTHON = re.compile(r"```python\n(.*?)```", re.DOTALL)


def test_every_parameter_is_described() -> None:
    """Each has a default and a meaning on the page that `make docs` writes."""
    script = runpy.run_path(str(DOCS / "parameters.py"))
    page = script["page"]()
    rows = {
        row[0]: row[1:]
        for row in re.findall(r"^\| `([\w.]+)` \| `(.*?)` \| .* \| (.*) \|$", page, re.M)
    }
    groups = set(re.findall(r"^## `([\w.]+)`$", page, re.MULTILINE))
    assert set(_paths(SystemConfig)) == {*rows, *groups}
    nameless = [name for name, (_, what) in rows.items() if not what]
    assert not nameless, "say in the class's docstring what ``name`` is"
    assert rows["tracking.min_inliers"][0] == "30"
    assert "min_inliers: 30" in dump(SystemConfig())


def test_units_are_read_from_names() -> None:
    unit = runpy.run_path(str(DOCS / "parameters.py"))["unit"]
    assert unit("max_depth_m", float) == "m"
    assert unit("enabled", bool) == "true, false"
    assert unit("min_inliers", int) == ""


def test_every_public_name_is_in_the_reference() -> None:
    page = (DOCS / "api.md").read_text(encoding="utf-8")
    shown = re.findall(r"^::: bmask_slam\.([\w.]+)\.(\w+)$", page, re.MULTILINE)
    modules = bmask_slam._MODULES
    assert {name: module for module, name in shown} == modules
    assert set(modules) == set(bmask_slam.__all__) - {"__version__"}


def test_the_messages_of_the_catalogue_are_in_the_code() -> None:
    page = (DOCS / "errors.md").read_text(encoding="utf-8").partition("## By what")[2]
    cells = [line.split("|")[1] for line in page.splitlines() if line.startswith("| `")]
    quoted = [
        part
        for cell in cells
        for text in re.findall(r"`(.+?)`", cell)
        for part in text.split(" ... ")
    ]
    code = "".join(_texts(path) for path in SOURCES)
    assert len(quoted) > 20
    assert not [text for text in quoted if text not in code]


def _texts(path: Path) -> str:
    constants = (node.value for node in nodes(path) if isinstance(node, ast.Constant))
    return "\n".join(value for value in constants if isinstance(value, str))


def test_every_page_is_in_the_site() -> None:
    listed = re.findall(r"^      - ([\w/-]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    assert sorted(listed) == sorted(str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md"))


def test_the_python_of_the_tutorials_runs(office: Path, tmp_path: Path) -> None:
    """In a folder where the names of the tutorials' recordings are a small one; one process."""
    for name in ("office", "mine", "rec"):
        (tmp_path / name).symlink_to(office)
    blocks = [block for page in TUTORIALS for block in PYTHON.findall(page.read_text("utf-8"))]
    assert len(blocks) >= 3
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(blocks)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "red things" in done.stdout
    assert done.stdout.count(" m\n") == 3
