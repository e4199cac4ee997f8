"""How old the figures in README.md and docs/ are: whether what makes them has changed since.

    python benchmarks/freshness.py        # every section, and what has changed since

Each section ends in a line with the date, the commit and a fingerprint of the code: of the
benchmark's script, of what it imports or calls of this folder, and of its subject in the system
(subjects.py), without comments, docstrings and layout. A section whose fingerprint is another today
is stale, and tests/test_docs_fresh.py fails.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
ROOT = FOLDER.parent
sys.path.insert(0, str(ROOT))

from benchmarks.subjects import SUBJECTS  # noqa: E402

PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
LAYOUT = ("report", "section_report", "machine", "freshness", "subjects")
"""Modules that measure nothing: they write pages, or say what they were measured on."""
DIGITS = 12
LAST_LINE = re.compile(
    r"^(?P<machine>[^;\n|]+); commit (?P<commit>[0-9a-f]{7,40})[^;\n]*;"
    r"(?: code (?P<code>[0-9a-f]+);)? (?P<date>\d{4}-\d\d-\d\d \d\d:\d\d) UTC",
    re.MULTILINE,
)
COMMAND = re.compile(r"`(?:python benchmarks/(?P<script>\w+\.py)|make bench)\b")


@dataclass(frozen=True)
class Section:
    """A part of a page that a benchmark wrote.

    Attributes:
        page: its file.
        title: the heading above it.
        script: of the benchmark, in this folder.
        commit, date: when it was measured, UTC.
        code: the fingerprint of the code then, "" where none was noted.
    """

    page: Path
    title: str
    script: str
    commit: str
    date: str
    code: str

    @property
    def stale(self) -> bool:
        """Whether the benchmark or its subject is another today."""
        return self.code != code_print(FOLDER / self.script)


def sections(page: Path) -> list[Section]:
    """The written sections of a page, in order."""
    text = page.read_text(encoding="utf-8")
    found = []
    for line in LAST_LINE.finditer(text):
        above = text[: text.find("\n", line.start())]
        title = re.findall(r"^#+ (.+)$", above, re.MULTILINE)[-1]
        named = list(COMMAND.finditer(above))
        script = (named[-1]["script"] or "run.py") if named else ""
        found.append(Section(page, title, script, line["commit"], line["date"], line["code"] or ""))
    return found


def code_print(script: Path) -> str:
    """The fingerprint of a benchmark and its subject; comments and layout do not change it."""
    digest = hashlib.sha256()
    for path in sorted(_modules(script)) + subject(script):
        text = _bare(path.read_text(encoding="utf-8")).encode() if path.suffix == ".py" else None
        digest.update(b"%s\n%s\n" % (path.name.encode(), text or path.read_bytes()))
    return digest.hexdigest()[:DIGITS]


def subject(script: Path) -> list[Path]:
    """The files of the system that make a benchmark's figures."""
    return sorted(
        {path for pattern in SUBJECTS.get(script.name, ()) for path in ROOT.glob(pattern)}
    )


def changed_since(section: Section) -> list[str] | None:
    """Files of a section's code that differ from its commit's; None without git and its history."""
    script = FOLDER / section.script
    files = [str(path.relative_to(ROOT)) for path in sorted(_modules(script)) + subject(script)]
    command = ["git", "diff", "--name-only", section.commit, "--", *files]
    try:
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    except (FileNotFoundError, subprocess.CalledProcessError):
        return None
    return done.stdout.split()


def _modules(script: Path) -> set[Path]:
    """The script and what it imports or calls of this folder, all the way down."""
    found, waiting = set(), [script]
    while waiting:
        path = waiting.pop()
        if path in found:
            continue
        found.add(path)
        names = {name.removeprefix("benchmarks.").partition(".")[0] for name in _names(path)}
        waiting += [
            FOLDER / f"{n}.py" for n in names - set(LAYOUT) if (FOLDER / f"{n}.py").is_file()
        ]
    return found


def _names(path: Path) -> Iterator[str]:
    """Modules that a file imports, and scripts that it names in order to call them."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (alias.name for alias in node.names if node.module == "benchmarks")
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield from re.findall(r"benchmarks/(\w+)\.py", node.value)


@functools.cache
def _bare(source: str) -> str:
    """The source without docstrings, comments, white space and trailing commas.

    Syntax trees would say the same, but differently in each version of Python.
    """
    lines = source.splitlines(keepends=True)
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(
            node
        ):
            first = node.body[0]
            lines[first.lineno - 1 : first.end_lineno] = [""] * (
                first.end_lineno - first.lineno + 1
            )
    return re.sub(r",(?=[)\]}])", "", re.sub(r"\s+", "", "".join(lines)))


def main() -> None:
    """Print all sections."""
    for page in PAGES:
        for section in sections(page):
            state = "STALE" if section.stale else "current"
            name = f"{page.relative_to(ROOT)}: {section.title}"
            print(f"{state:<8}{name:<72}{section.script:<20}{section.date}")
            if section.stale:
                changed = changed_since(section)
                print("       ", "history unknown" if changed is None else " ".join(changed))


if __name__ == "__main__":
    main()
