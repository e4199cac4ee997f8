"""A report as one self-contained web page, by the template page.html.j2 and the style page.css."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jinja2
from markupsafe import Markup

from bmask_slam.reporting.parts import Section, Tile

TEMPLATES = Path(__file__).parent


@dataclass(frozen=True)
class Page:
    """What a page shows: title, a lead, sentences below it, sections, and tiles of figures."""

    title: str
    lead: str
    summary: Sequence[str]
    sections: Sequence[Section]
    tiles: Sequence[Tile] = ()


def page_text(page: Page) -> str:
    """The page as HTML; every text is escaped, pictures and style are in it."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )
    css = (TEMPLATES / "page.css").read_text(encoding="utf-8")
    style = Markup(css)  # nosec B704 # the project's own file
    return environment.get_template("page.html.j2").render(page=page, style=style)
