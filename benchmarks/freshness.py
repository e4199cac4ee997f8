"""How old the figures in README.md and docs/ are: whether what measured them has changed since.

    python benchmarks/freshness.py        # every section, and what has changed in the system since

Each section ends in a line with the date, the commit and a fingerprint of the benchmark: of its
script and what it imports or calls of this folder, without comments, docstrings and layout. A
section whose fingerprint is another today is stale, and tests/test_docs_fresh.py fails.
"""

from __future__ import annotations

import ast
import hashlib
import io
import re
import subprocess
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
ROOT = FOLDER.parent
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
PACKAGES = ("graph", "semantics", "mapping", "slam")
LAYOUT = ("report", "section_report", "machine", "freshness")
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
        code: the fingerprint of the benchmark then, "" where none was noted.
    """

    page: Path
    title: str
    script: str
    commit: str
    date: str
    code: str

    @property
    def stale(self) -> bool:
        """Whether the benchmark is another today."""
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
    """The fingerprint of a benchmark; comments, docstrings and layout do not change it."""
    digest = hashlib.sha256()
    for path in sorted(_modules(script)):
        digest.update(f"{path.name}\n{_bare(path.read_text(encoding='utf-8'))}\n".encode())
    return digest.hexdigest()[:DIGITS]


def commits_since(date: str) -> int | None:
    """Commits to the system since a date (UTC); None without its history."""
    command = ["git", "rev-list", "--count", f"--since={date} +0000", "HEAD", "--", *PACKAGES]
    shallow = ["git", "rev-parse", "--is-shallow-repository"]
    try:
        if _output(shallow) != "false":
            return None
        return int(_output(command))
    except (FileNotFoundError, subprocess.CalledProcessError):
        return None


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


def _output(command: list[str]) -> str:
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def main() -> None:
    """Print all sections."""
    for page in PAGES:
        for section in sections(page):
            since = commits_since(section.date)
            state = "STALE" if section.stale else "current"
            age = "history unknown" if since is None else f"{since} commits to the system since"
            name = f"{page.relative_to(ROOT)}: {section.title}"
            print(f"{state:<8}{name:<64}{section.script:<22}{section.date}  {age}")


if __name__ == "__main__":
    main()
