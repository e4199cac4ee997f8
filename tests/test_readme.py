"""README.md and docs/ are right: links, paths, commands, options, functions, rooms, results."""

from __future__ import annotations

import argparse
import ast
import re
import shlex
from pathlib import Path

import pytest
from repository import ROOT
from test_layers import ROOMS

from bmask_slam.cli import make_parser

README = (ROOT / "README.md").read_text(encoding="utf-8")
ARCHITECTURE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
MAX_LINES = 150
MAX_ARCHITECTURE_LINES = 200
MAKE_TARGET = re.compile(r"\bmake ([a-z]+)\b")
LINK = re.compile(r"\]\(([^)]+)\)")
CODE = re.compile(r"```.*?\n(.*?)```|`([^`\n]+)`", re.DOTALL)
REPOSITORY_PATH = re.compile(
    r"^(?:slam|graph|semantics|mapping|data|tests|benchmarks|docs|examples)/[\w./]*$"
    r"|^[\w]+\.(?:md|toml)$"
)


def commands() -> argparse._SubParsersAction:
    (action,) = (a for a in make_parser()._actions if isinstance(a, argparse._SubParsersAction))
    return action


def code_lines(text: str) -> list[str]:
    """Every line of code in a page, from blocks and inline, without comments."""
    pieces = [block or inline for block, inline in CODE.findall(text)]
    return [line.split("#")[0].strip() for piece in pieces for line in piece.splitlines()]


def command_lines(text: str) -> list[list[str]]:
    """The arguments of every ``bmask-slam COMMAND ...`` in code."""
    lines = [line.removeprefix("$ ") for line in code_lines(text)]
    split = [shlex.split(line) for line in lines if line.startswith("bmask-slam ")]
    return [words[1:] for words in split]


def test_the_readme_is_short():
    assert len(README.splitlines()) <= MAX_LINES


def anchors(page: Path) -> set[str]:
    """The anchors of a page: its headings as GitHub writes them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_have_targets(page):
    for link in LINK.findall(page.read_text(encoding="utf-8")):
        if link.startswith("http"):
            continue
        target, _, anchor = link.partition("#")
        file = page.parent / target if target else page
        assert file.exists(), link
        assert not anchor or anchor in anchors(file), link


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_paths_in_code_exist(page):
    words = [w for line in code_lines(page.read_text(encoding="utf-8")) for w in line.split()]
    paths = {word for word in words if REPOSITORY_PATH.match(word)}
    missing = [path for path in sorted(paths) if not (ROOT / path).exists()]
    assert not missing


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_parse(page):
    """Whole command lines go through the real parser; --help and --version end it with 0."""
    lines = command_lines(page.read_text(encoding="utf-8"))
    for words in lines:
        try:
            make_parser().parse_args(words)
        except SystemExit as end:
            assert end.code == 0, f"bmask-slam {shlex.join(words)}"


def test_the_readme_shows_every_command():
    shown = {words[0] for words in command_lines(README)}
    assert shown == set(commands().choices)


def test_options_in_the_table_belong_to_their_command():
    rows = re.findall(r"^\| `bmask-slam ([\w-]+)[^`]*` \| (.*) \|$", README, re.MULTILINE)
    assert len(rows) == len(commands().choices)
    for name, cell in rows:
        known = commands().choices[name]._option_string_actions
        for option in re.findall(r"`(--[\w-]+)", cell):
            assert option in known, f"{name} {option}"


def test_make_targets_exist():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    named = {name for line in code_lines(README) for name in MAKE_TARGET.findall(line)}
    assert {"demo", "test", "bench", "check"} <= named
    for name in named:
        assert re.search(rf"^{name}:", makefile, re.MULTILINE), name


def test_configuration_keys_exist():
    from bmask_slam.config.configuration import resolve
    from bmask_slam.system_config import SystemConfig

    given = [
        words[i + 1]
        for page in PAGES
        for words in command_lines(page.read_text(encoding="utf-8"))
        for i, word in enumerate(words)
        if word == "--set"
    ]
    given += re.findall(r"`--set ([\w.]+=[\w.]+)`", README)
    assert given
    for setting in given:
        resolve(SystemConfig, None, [setting])


def block(text: str) -> str:
    """The text between the markers of the results table."""
    begin = "<!-- real: written by benchmarks/cameras/real_sequences.py -->"
    end = "<!-- end of real -->"
    assert text.count(begin) == text.count(end) == 1
    return text.partition(begin)[2].partition(end)[0]


def test_the_results_are_those_of_the_benchmark():
    report = (ROOT / "docs" / "results" / "real-cameras.md").read_text(encoding="utf-8")
    rows = [line for line in block(README).splitlines() if line.startswith("| ")][2:]
    assert rows, "no sequence was measured"
    for figure in re.findall(r"\d+\.\d\b", "".join(rows)):
        assert figure in report


def test_figures_of_results_are_only_in_the_results_table():
    """Nothing measured is typed by hand: units of results appear in written blocks only."""
    example = README.partition("<!-- example:")[2].partition("<!-- end of example -->")[0]
    rest = README.replace(block(README), "").replace(example, "")
    assert not re.search(r"\d+(?:\.\d+)? ?(?:mm|cm|ms|MB|fps|Hz|°)\b", rest)


def names_in(path: Path) -> set[str]:
    """Functions and classes of a module, methods as Class.method."""
    names = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, (ast.ClassDef, ast.FunctionDef)):
            names.add(node.name)
        if isinstance(node, ast.ClassDef):
            names |= {f"{node.name}.{m.name}" for m in node.body if isinstance(m, ast.FunctionDef)}
            fields = [m.target for m in node.body if isinstance(m, ast.AnnAssign)]
            names |= {f"{node.name}.{f.id}" for f in fields if isinstance(f, ast.Name)}
    return names


def test_the_functions_that_the_architecture_names_are_in_their_files():
    rows = re.findall(r"^\| (Where [^|]*\?) \|(.*)\|$", ARCHITECTURE, re.MULTILINE)
    assert len(rows) == 8
    for question, answer in rows:
        words = re.findall(r"`([^`]+)`", answer)
        files = [ROOT / word for word in words if "/" in word]
        known = set().union(*(names_in(file) for file in files))
        missing = [word for word in words if "/" not in word and word not in known]
        assert not missing, question


def test_the_architecture_draws_the_rooms_as_the_layer_test_has_them():
    picture = re.findall(r"```text\n(.*?)```", ARCHITECTURE, re.DOTALL)
    order = picture[0].replace("<-", " ").split()
    drawn = " ".join(picture[1].split())
    assert order == ROOMS["the layers"].split()
    for folder, rooms in ROOMS.items():
        if folder != "the layers":
            assert f"{folder} {' '.join(rooms.split())}" in drawn, folder


def test_the_architecture_is_short():
    assert len(ARCHITECTURE.splitlines()) <= MAX_ARCHITECTURE_LINES
