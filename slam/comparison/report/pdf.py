"""The report as PDF, with drawings as drawings and page numbers."""

from __future__ import annotations

import io
from collections.abc import Iterable
from pathlib import Path
from typing import TypeAlias
from xml.sax.saxutils import escape

import matplotlib
from pypdf import PdfReader, PdfWriter, Transformation
from reportlab.lib.colors import HexColor
from reportlab.lib.enums import TA_RIGHT
from reportlab.lib.pagesizes import A4
from reportlab.lib.styles import ParagraphStyle
from reportlab.lib.units import mm
from reportlab.pdfbase import pdfmetrics
from reportlab.pdfbase.ttfonts import TTFont
from reportlab.pdfgen.canvas import Canvas
from reportlab.platypus import (
    Flowable,
    Image,
    KeepTogether,
    LongTable,
    Paragraph,
    Preformatted,
    SimpleDocTemplate,
    Spacer,
)  # fmt: skip

from bmask_slam.comparison.report.section import Listing, Picture, Section
from bmask_slam.comparison.report.table import Entry, Table, TableRow

MARGIN = 16 * mm
WIDTH = A4[0] - 2 * MARGIN
GAP = 5 * mm
PICTURES_A_ROW = 2
LISTING_COLUMNS = 104
SANS, BOLD, MONO = "DejaVuSans", "DejaVuSans-Bold", "DejaVuSansMono"
INK, SOFT, LINE = HexColor("#1c1c1a"), HexColor("#5f5f5a"), HexColor("#d8d8d2")
BEST, FAILED = "#0b4a8f", "#9c2a1a"
TEXT = ParagraphStyle("text", fontName=SANS, fontSize=9, leading=13, textColor=INK, spaceAfter=4)
SMALL = ParagraphStyle("small", TEXT, fontSize=7, leading=9, textColor=SOFT, spaceBefore=4)
HEADINGS = {
    1: ParagraphStyle("h1", TEXT, fontName=BOLD, fontSize=17, leading=22, spaceAfter=6),
    2: ParagraphStyle("h2", TEXT, fontName=BOLD, fontSize=12.5, leading=16, spaceBefore=16,
                      keepWithNext=1),
    3: ParagraphStyle("h3", TEXT, fontName=BOLD, fontSize=9.5, leading=13, spaceBefore=8,
                      keepWithNext=1),
}  # fmt: skip
CODE = ParagraphStyle("code", fontName=MONO, fontSize=7, leading=9, textColor=INK, spaceAfter=6)


Placed: TypeAlias = list[tuple[int, float, float, float, bytes]]
"""Drawings by page from 1, left, bottom and width in points."""


class Drawing(Flowable):
    """A place on the page for a drawing, which `merge_drawings` puts there afterwards."""

    def __init__(self, picture: Picture, width: float, placed: Placed) -> None:
        super().__init__()
        self._picture, self._placed = picture, placed
        self.width, self.height = width, width * picture.size_px[1] / picture.size_px[0]

    def wrap(self, *_: float) -> tuple[float, float]:
        return self.width, self.height

    def draw(self) -> None:
        assert self._picture.pdf is not None
        x, y = self.canv.absolutePosition(0, 0)
        self._placed.append((self.canv.getPageNumber(), x, y, self.width, self._picture.pdf))


def pdf_bytes(title: str, description: str, sentences: list[str], sections: list[Section]) -> bytes:
    """The report; the same sections give the same bytes."""
    _register_fonts()
    placed: Placed = []
    flow: list[Flowable] = [_paragraph(title, HEADINGS[1])]
    flow += [_paragraph(text, TEXT) for text in (description, *sentences) if text]
    for section in sections:
        flow += _section(section, placed)
    out = io.BytesIO()
    document = SimpleDocTemplate(
        out, pagesize=A4, leftMargin=MARGIN, rightMargin=MARGIN, topMargin=MARGIN,
        bottomMargin=MARGIN + 4 * mm, title=title, author="bmask-slam", invariant=1,
    )  # fmt: skip
    document.build(flow, onFirstPage=_foot, onLaterPages=_foot)
    return merge_drawings(out.getvalue(), placed)


def merge_drawings(report: bytes, placed: Placed) -> bytes:
    """The report with each drawing at its place."""
    writer = PdfWriter(clone_from=PdfReader(io.BytesIO(report)))
    for number, x, y, width, drawing in placed:
        page = PdfReader(io.BytesIO(drawing)).pages[0]
        fit = Transformation().scale(width / float(page.mediabox.width)).translate(x, y)
        writer.pages[number - 1].merge_transformed_page(page, fit)
    for page in writer.pages:
        page.compress_content_streams()
    out = io.BytesIO()
    writer.write(out)
    return out.getvalue()


def _section(section: Section, placed: Placed) -> list[Flowable]:
    flow: list[Flowable] = [_paragraph(section.title, HEADINGS[2])]
    flow += [_paragraph(text, TEXT) for text in section.text]
    for table in section.tables:
        flow += _table(table)
    pictures = section.pictures
    for k in range(0, len(pictures), PICTURES_A_ROW):
        flow.append(_picture_row(pictures[k : k + PICTURES_A_ROW], placed))
    for listing in section.listings:
        flow += _listing(listing)
    if len(flow) > 1 and pictures and not section.text and not section.tables:
        flow[:2] = [KeepTogether(flow[:2])]
    return flow


def _table(table: Table) -> list[Flowable]:
    count = len(table.columns)
    size = 7.5 if count <= 6 else 6.0 if count <= 12 else 5.0
    left = ParagraphStyle("left", TEXT, fontSize=size, leading=1.3 * size, spaceAfter=0)
    right = ParagraphStyle("right", left, alignment=TA_RIGHT)
    heads = [_paragraph(f"<b>{escape(table.corner)}</b>", left, markup=True)]
    heads += [_paragraph(f"<b>{escape(c)}</b>", right, markup=True) for c in table.columns]
    rows = [[_row_head(row, left), *(_entry(e, right) for e in row.entries)] for row in table.rows]
    first = WIDTH * (0.3 if count <= 6 else 0.2)
    drawn = LongTable(
        [heads, *rows], [first] + [(WIDTH - first) / max(count, 1)] * count, repeatRows=1,
        hAlign="LEFT",
    )  # fmt: skip
    drawn.setStyle([
        ("VALIGN", (0, 0), (-1, -1), "TOP"), ("VALIGN", (0, 0), (-1, 0), "BOTTOM"),
        ("LINEABOVE", (0, 0), (-1, 0), 0.8, INK), ("LINEBELOW", (0, -1), (-1, -1), 0.8, INK),
        ("LINEBELOW", (0, 0), (-1, -2), 0.3, LINE),
        ("LEFTPADDING", (0, 0), (-1, -1), 2), ("RIGHTPADDING", (0, 0), (-1, -1), 2),
        ("TOPPADDING", (0, 0), (-1, -1), 2), ("BOTTOMPADDING", (0, 0), (-1, -1), 2.5),
    ])  # fmt: skip
    return [_paragraph(table.title, HEADINGS[3]), drawn, _paragraph(table.caption, SMALL)]


def _row_head(row: TableRow, style: ParagraphStyle) -> Paragraph:
    tags = "".join(f" [{escape(tag)}]" for tag in row.tags)
    note = (
        f'<br/><font size="{0.85 * style.fontSize}">{escape(row.note)}</font>' if row.note else ""
    )
    return _paragraph(f"{escape(row.label)}{tags}{note}", style, markup=True)


def _entry(entry: Entry, style: ParagraphStyle) -> Paragraph:
    text = escape(entry.text)
    if entry.best:
        text = f'<font color="{BEST}"><b>{text}</b></font>'
    for note in filter(None, (entry.spread, entry.note)):
        text += f'<br/><font size="{0.85 * style.fontSize}">{escape(note)}</font>'
    if entry.failed:
        text = f'<font color="{FAILED}">{text}</font>'
    return _paragraph(text, style, markup=True)


def _picture_row(pictures: Iterable[Picture], placed: Placed) -> Flowable:
    width = (WIDTH - (PICTURES_A_ROW - 1) * GAP) / PICTURES_A_ROW
    cells = [
        [_drawn(p, width, placed), Spacer(0, 2), _paragraph(p.caption, SMALL)] for p in pictures
    ]
    row = LongTable([cells], [width + GAP] * (len(cells) - 1) + [width], hAlign="LEFT")
    row.setStyle([
        ("VALIGN", (0, 0), (-1, -1), "TOP"), ("LEFTPADDING", (0, 0), (-1, -1), 0),
        ("RIGHTPADDING", (0, 0), (-2, -1), GAP), ("RIGHTPADDING", (-1, 0), (-1, -1), 0),
    ])  # fmt: skip
    return row


def _drawn(picture: Picture, width: float, placed: Placed) -> Flowable:
    if picture.pdf is not None:
        return Drawing(picture, width, placed)
    height = width * picture.size_px[1] / picture.size_px[0]
    return Image(io.BytesIO(picture.data), width, height)


def _listing(listing: Listing) -> list[Flowable]:
    wrapped = Preformatted(listing.text, CODE, maxLineLength=LISTING_COLUMNS, newLineChars="  ")
    return [_paragraph(listing.title, HEADINGS[3]), wrapped]


def _paragraph(text: str, style: ParagraphStyle, markup: bool = False) -> Paragraph:
    return Paragraph(text if markup else escape(text), style)


def _foot(canvas: Canvas, document: SimpleDocTemplate) -> None:
    canvas.saveState()
    canvas.setFont(SANS, 7)
    canvas.setFillColor(SOFT)
    canvas.drawString(MARGIN, MARGIN - 2 * mm, document.title[:110])
    canvas.drawRightString(A4[0] - MARGIN, MARGIN - 2 * mm, str(canvas.getPageNumber()))
    canvas.restoreState()


def _register_fonts() -> None:
    """DejaVu, which comes with matplotlib: it has the letters of most languages."""
    folder = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    for name in (SANS, BOLD, MONO):
        pdfmetrics.registerFont(TTFont(name, folder / f"{name}.ttf"))
    pdfmetrics.registerFontFamily(SANS, normal=SANS, bold=BOLD, italic=SANS, boldItalic=BOLD)
