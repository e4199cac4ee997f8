"""The report as one page that needs no other file."""

from __future__ import annotations

from pathlib import Path

import jinja2
from markupsafe import Markup

from bmask_slam.comparison.report.section import Section

TEMPLATES = Path(__file__).parent


def html_text(title: str, description: str, sentences: list[str], sections: list[Section]) -> str:
    """The page; every text is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )
    style = Markup((TEMPLATES / "page.css").read_text(encoding="utf-8"))  # our own file
    page = environment.get_template("page.html.j2")
    return page.render(
        title=title, description=description, summary=sentences, sections=sections, style=style
    )
