"""Pages under docs/results/: tables in Markdown, and the line on how a section was measured.

Every section ends with one line: machine, commit, date in UTC, how long it took. The command stands
above it. `written_sections` reads them back.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

WRITTEN = ("docs/results", "docs/images", "README.md")
"""Files that benchmarks write; changes of these do not count as changes of the code."""
STAMP = re.compile(
    r"^(?P<machine>[^;\n|]+); commit (?P<commit>[0-9a-f]{7,40})[^;\n]*; "
    r"(?P<date>\d{4}-\d\d-\d\d \d\d:\d\d) UTC",
    re.MULTILINE,
)
COMMAND = re.compile(r"^`python -m (?P<module>benchmarks\.[\w.]+)[^`\n]*`$", re.MULTILINE)


@dataclass(frozen=True)
class WrittenSection:
    """A section of a page that a benchmark wrote; empty text where something is missing.

    Attributes:
        title: the heading.
        module: the benchmark, such as "benchmarks.graph.long_session".
        machine, commit, date: of the measurement, the date in UTC.
    """

    title: str
    module: str
    machine: str
    commit: str
    date: str


def written_sections(page: Path) -> list[WrittenSection]:
    """The sections of a page, one a heading of level two, in order."""
    parts = re.split(r"(?m)^## ", page.read_text(encoding="utf-8"))[1:]
    return [_section(part) for part in parts]


def _section(text: str) -> WrittenSection:
    command, stamp = COMMAND.search(text), STAMP.search(text)
    found = stamp.groupdict("") if stamp else dict.fromkeys(("machine", "commit", "date"), "")
    return WrittenSection(text.partition("\n")[0], command["module"] if command else "", **found)


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table; ValueError if a row has another length than the header."""
    lines = [header, ["---"] * len(header), *rows]
    for line in lines:
        if len(line) != len(header):
            raise ValueError(f"{len(line)} cells under {len(header)} headings: {line}")
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def fill_block(path: Path, block: str) -> None:
    """Replace what stands between the first and the last line of a block in a page.

    Raises:
        SystemExit: the page lacks one of these lines.
    """
    text = path.read_text(encoding="utf-8")
    begin, end = block.partition("\n")[0], block.rpartition("\n")[2]
    before, found, rest = text.partition(begin)
    _, closed, after = rest.partition(end)
    if not (found and closed):
        raise SystemExit(f"error: {path}: lacks the lines '{begin}' and '{end}'")
    path.write_text(before + block + after, encoding="utf-8")
