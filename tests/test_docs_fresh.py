"""No figure in README.md and docs/ is older than the code that made it."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import pytest

from benchmarks import freshness
from benchmarks.freshness import PAGES, ROOT, Section, changed_since, code_print, sections
from benchmarks.section_report import REPORTS
from benchmarks.subjects import SUBJECTS, UNMEASURED

PACKAGES = ("graph", "semantics", "mapping", "slam")

SECTIONS = [section for page in PAGES for section in sections(page)]


def how_to_renew(section: Section) -> str:
    for name, report in REPORTS.items():
        for key, (title, _) in report.sections.items():
            if report.path == section.page and title == section.title:
                return f"python benchmarks/section_report.py {name} --only {key}"
    return "make bench"


@pytest.mark.parametrize("section", SECTIONS, ids=lambda s: f"{s.page.stem}-{s.title}")
def test_a_section_is_as_new_as_the_code_that_made_it(section):
    assert section.script, f"{section.page.name}: {section.title}: names no command"
    assert section.code, f"{section.page.name}: {section.title}: no fingerprint of its code"
    assert not section.stale, (
        f"{section.page.name}: {section.title}: what {section.script} measures has changed since "
        f"{section.date} UTC ({section.commit}): {changed_since(section)}; "
        f"run {how_to_renew(section)}"
    )


@pytest.mark.parametrize("report", REPORTS.values(), ids=lambda r: r.path.stem)
def test_a_page_holds_only_sections_that_its_report_knows(report):
    """Each heading has a command that the report knows, and what it printed."""
    titles = re.findall(r"^## (.+)$", report.path.read_text(encoding="utf-8"), re.MULTILINE)
    known = {title: command.split()[0] for title, command in report.sections.values()}
    written = {section.title: section.script for section in sections(report.path)}
    assert set(titles) == set(written)
    assert written.items() <= known.items()


def test_every_benchmark_that_writes_into_a_page_has_a_subject():
    written = {section.script for section in SECTIONS}
    known = {command.split()[0] for r in REPORTS.values() for _, command in r.sections.values()}
    assert written | known == set(SUBJECTS)


def files(patterns: Iterable[str]) -> set[Path]:
    found = {pattern: set(ROOT.glob(pattern)) for pattern in patterns}
    nothing = [pattern for pattern, paths in found.items() if not paths]
    assert not nothing, f"no file is named so: {nothing}"
    return set().union(*found.values())


def test_every_module_is_measured_or_said_not_to_be():
    """A module that is forgotten could change and leave old figures standing."""
    measured = files(pattern for patterns in SUBJECTS.values() for pattern in patterns)
    outside = files(UNMEASURED)
    modules = {path for name in PACKAGES for path in (ROOT / name).rglob("*.py")}
    assert modules - measured == {path for path in outside if path not in measured}
    assert {path.name for path in measured & outside} <= {"__init__.py"}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(freshness, "FOLDER", tmp_path)
    monkeypatch.setattr(freshness, "ROOT", tmp_path)
    monkeypatch.setattr(freshness, "SUBJECTS", {"run.py": ("graph/*.py", "data/*.bin")})
    for file in ("graph/part.py", "data/weights.bin"):
        (tmp_path / file).parent.mkdir()
        (tmp_path / file).write_text("X = 1\n")
    (tmp_path / "run.py").write_text('"""What."""\nfrom helper import f\nX = f(1)  # one\n')
    (tmp_path / "helper.py").write_text('def f(x):\n    """Twice."""\n    return 2 * x\n')
    return tmp_path


@pytest.mark.parametrize(
    ("file", "text", "same"),
    [
        ("run.py", '"""Other."""\n\nfrom helper import f\n\nX = f(\n    1,\n)\n', True),
        ("helper.py", 'def f(x):\n    """Two."""\n    return 2 * x  # "#"\n', True),
        ("helper.py", "def f(x):\n    return 3 * x\n", False),
        ("run.py", "from helper import f\nX = f('# 1')\n", False),
        ("graph/part.py", '"""One."""\n\nX = 1  # one\n', True),
        ("graph/part.py", "X = 2\n", False),
        ("graph/added.py", "", False),
        ("data/weights.bin", "X = 1 # 1\n", False),
    ],
    ids=[
        *("layout", "comments", "what it imports", "itself"),
        *("comments of the subject", "the subject", "a file more", "weights"),
    ],
)
def test_only_what_can_change_a_figure_changes_the_fingerprint(folder, file, text, same):
    before = code_print(folder / "run.py")
    (folder / file).write_text(text)
    assert (code_print(folder / "run.py") == before) == same


def test_a_script_that_is_called_belongs_to_it(folder):
    before = code_print(folder / "run.py")
    (folder / "called.py").write_text("print(1)\n")
    (folder / "helper.py").write_text('def f(x):\n    return call(["benchmarks/called.py"])\n')
    with_call = code_print(folder / "run.py")
    (folder / "called.py").write_text("print(2)\n")
    assert len({before, with_call, code_print(folder / "run.py")}) == 3


def test_a_stale_section_is_found(folder):
    page = folder / "page.md"
    line = f"CPU; commit 0123abcd; code {code_print(folder / 'run.py')}; 2026-01-02 03:04 UTC; 5 s."
    page.write_text(f"## Speed\n\n`python benchmarks/run.py --all`\n\n```\n1\n```\n\n{line}\n")
    (section,) = sections(page)
    assert (section.title, section.script, section.date) == ("Speed", "run.py", "2026-01-02 03:04")
    assert not section.stale
    (folder / "helper.py").write_text("def f(x):\n    return 3 * x\n")
    assert section.stale
