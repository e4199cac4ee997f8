"""The parts of a report: sections of text, tables, pictures and listings."""

from __future__ import annotations

import base64
import re
from dataclasses import dataclass

from bmask_slam.comparison.report.table import Table


@dataclass(frozen=True)
class Picture:
    """A picture as the bytes of a file.

    Attributes:
        title: also its alternative text.
        caption: how to read it.
        data, mime: the file and its type.
        size_px: width and height, at 96 px an inch.
        pdf: the same as a page of PDF if it is a drawing.
    """

    title: str
    caption: str
    data: bytes
    mime: str
    size_px: tuple[float, float]
    pdf: bytes | None = None

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
class Section:
    """A part of the report under one heading."""

    title: str
    text: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()
    listings: tuple[Listing, ...] = ()

    @property
    def anchor(self) -> str:
        """The name of the heading for links."""
        return slug(self.title)

    @property
    def empty(self) -> bool:
        return not (self.text or self.tables or self.pictures or self.listings)


def slug(text: str) -> str:
    """A text as a name for files and links: lower case letters, digits and hyphens."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-") or "x"
