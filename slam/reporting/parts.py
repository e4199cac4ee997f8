"""The parts of a report: sections of text, tables, pictures and listings; tiles of figures."""

from __future__ import annotations

import base64
import re
from dataclasses import dataclass


@dataclass(frozen=True)
class Entry:
    """One cell of a table.

    Attributes:
        text: the figure, or a word without one.
        spread: range over seeds; "" with one seed.
        note: a remark on the figure, such as "1 of 3 failed".
        best: whether it is the best measured here in its column.
        failed: whether a run of it failed.
    """

    text: str
    spread: str = ""
    note: str = ""
    best: bool = False
    failed: bool = False

    @property
    def plain(self) -> str:
        """Text, spread and note."""
        spread = f" ({self.spread})" if self.spread else ""
        return f"{self.text}{spread}{f' {self.note}' if self.note else ''}"


@dataclass(frozen=True)
class TableRow:
    """A row: its name, entries, tags after the name, and the source of its figures."""

    label: str
    entries: tuple[Entry, ...]
    tags: tuple[str, ...] = ()
    note: str = ""


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        name: file-safe.
        title, caption: above and below it.
        columns: the headings, without that of the first column, which is ``corner``.
        rows: one entry each for each of the columns.
        prose: its entries are words, which are wrapped, and no numbers.
    """

    name: str
    title: str
    caption: str
    columns: tuple[str, ...]
    rows: tuple[TableRow, ...]
    corner: str = "method"
    prose: bool = False


@dataclass(frozen=True)
class Picture:
    """A picture as the bytes of a file.

    Attributes:
        title: also its alternative text.
        caption: how to read it.
        data, mime: the file and its type.
        size_px: width and height, at 96 px an inch.
        pdf: the same as a page of PDF if it is a drawing.
        wide: over the whole width of the page.
    """

    title: str
    caption: str
    data: bytes
    mime: str
    size_px: tuple[float, float]
    pdf: bytes | None = None
    wide: bool = False

    @property
    def uri(self) -> str:
        """The file as a data URI."""
        return f"data:{self.mime};base64,{base64.b64encode(self.data).decode('ascii')}"

    @property
    def width_px(self) -> int:
        return round(self.size_px[0])

    @property
    def height_px(self) -> int:
        return round(self.size_px[1])


@dataclass(frozen=True)
class Listing:
    """Preformatted text, such as a log."""

    title: str
    text: str


@dataclass(frozen=True)
class Tile:
    """A figure at the top of a report; ``failed``: one that says that something went wrong."""

    name: str
    value: str
    unit: str = ""
    failed: bool = False


@dataclass(frozen=True)
class Section:
    """A part of the report under one heading.

    ``items`` are the points of a list; what is not ``printed`` is left out on paper.
    """

    title: str
    text: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()
    listings: tuple[Listing, ...] = ()
    items: tuple[str, ...] = ()
    printed: bool = True

    @property
    def anchor(self) -> str:
        """The name of the heading for links."""
        return slug(self.title)

    @property
    def empty(self) -> bool:
        return not (self.text or self.items or self.tables or self.pictures or self.listings)


def slug(text: str) -> str:
    """A text as a name for files and links: lower case letters, digits and hyphens."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-") or "x"
