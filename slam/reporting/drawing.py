"""Style of the report's figures, and their bytes as SVG (for the page) and PDF (for a paper)."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from bmask_slam.reporting.parts import Picture

SVG = "image/svg+xml"
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")
"""Colours of Okabe and Ito, which colour-blind readers can distinguish."""
DASHES = ("-", "--", "-.", ":")
STYLE: dict[Any, Any] = {
    "svg.fonttype": "none", "svg.hashsalt": "bmask-slam", "pdf.fonttype": 42, "font.size": 9.0,
    "font.family": "sans-serif", "axes.spines.top": False, "axes.spines.right": False,
    "axes.linewidth": 0.6, "xtick.major.width": 0.6, "ytick.major.width": 0.6,
    "grid.alpha": 0.25, "grid.linewidth": 0.5, "legend.frameon": False, "legend.fontsize": 8.0,
}  # fmt: skip


@contextmanager
def figure(width_in: float, height_in: float) -> Iterator[Figure]:
    """An empty figure in the style of the report, within a context manager."""
    with matplotlib.rc_context(STYLE):
        yield Figure(figsize=(width_in, height_in), layout="constrained")


def as_picture(drawn: Figure, title: str, caption: str, for_paper: bool = False) -> Picture:
    """The figure as SVG, and for a paper also as PDF; the same figure gives the same bytes."""
    svg, pdf = io.BytesIO(), io.BytesIO()
    with matplotlib.rc_context(STYLE):
        drawn.savefig(svg, format="svg", metadata={"Date": None}, transparent=True)
        if for_paper:
            drawn.set_layout_engine(None)  # the layout of the SVG; "none" would draw it twice
            drawn.savefig(pdf, format="pdf", metadata={"CreationDate": None})
    width_in, height_in = drawn.get_size_inches()
    size_px = (96 * width_in, 96 * height_in)
    return Picture(title, caption, svg.getvalue(), SVG, size_px, pdf.getvalue() or None)
