"""No figure in README.md and docs/ is older than the benchmark that made it."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import pytest

from benchmarks import freshness
from benchmarks.freshness import PAGES, ROOT, Section, code_print, commits_since, sections
from benchmarks.section_report import REPORTS

SECTIONS = [section for page in PAGES for section in sections(page)]


def how_to_renew(section: Section) -> str:
    for name, report in REPORTS.items():
        for key, (title, _) in report.sections.items():
            if report.path == section.page and title == section.title:
                return f"python benchmarks/section_report.py {name} --only {key}"
    return "make bench"


@pytest.mark.parametrize("section", SECTIONS, ids=lambda s: f"{s.page.stem}-{s.title}")
def test_a_section_is_as_new_as_its_benchmark(section):
    assert section.script, f"{section.page.name}: {section.title}: names no command"
    assert section.code, f"{section.page.name}: {section.title}: no fingerprint of its benchmark"
    assert not section.stale, (
        f"{section.page.name}: {section.title}: {section.script} has changed since "
        f"{section.date} UTC ({section.commit}); run {how_to_renew(section)}"
    )


@pytest.mark.parametrize("report", REPORTS.values(), ids=lambda r: r.path.stem)
def test_a_page_holds_only_sections_that_its_report_knows(report):
    """Each heading has a command that the report knows, and what it printed."""
    titles = re.findall(r"^## (.+)$", report.path.read_text(encoding="utf-8"), re.MULTILINE)
    known = {title: command.split()[0] for title, command in report.sections.values()}
    written = {section.title: section.script for section in sections(report.path)}
    assert set(titles) == set(written)
    assert written.items() <= known.items()


def test_how_far_the_system_has_gone_on_is_said():
    """Figures cannot be new after each commit; how old the oldest are is said, not judged."""
    ages = {section: commits_since(section.date) for section in SECTIONS}
    if None in ages.values():
        pytest.skip("no git history, or a shallow one")
    oldest = max(SECTIONS, key=lambda section: ages[section] or 0)
    page = oldest.page.relative_to(ROOT)
    warnings.warn(
        f"oldest figures: {page}, {oldest.title}: {ages[oldest]} commits to the system since; "
        "python benchmarks/freshness.py lists all",
        stacklevel=1,
    )


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(freshness, "FOLDER", tmp_path)
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
    ],
    ids=["layout", "comments", "what it imports", "itself"],
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
