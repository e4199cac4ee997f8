"""A hook of mkdocs: what a page links to outside docs/ is shown as plain text on the site."""

from __future__ import annotations

import re
from typing import Any


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Markdown of a page without links to files of the repository that the site does not have."""
    up = page.file.src_uri.count("/")
    outside = re.escape("../" * (up + 1))
    pattern = re.compile(rf"\[([^\]]+)\]\({outside}[^)]*\)")
    return re.sub(r"\[([^\]]+)\]\(notebooks/[^)]*\)", r"\1", pattern.sub(r"\1", markdown))
