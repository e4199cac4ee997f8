"""Write all formats of a comparison's report."""

from __future__ import annotations

from pathlib import Path

from bmask_slam.comparison.experiment.result import Comparison
from bmask_slam.comparison.report.sections import make_sections, summary
from bmask_slam.comparison.report.table import metric_tables
from bmask_slam.comparison.report.text_tables import csv_text, latex_text, markdown_text
from bmask_slam.comparison.report.verdict_tables import ablation_table, verdict_tables
from bmask_slam.graph.files.file_names import refuse_link
from bmask_slam.graph.files.whole_file import whole_file
from bmask_slam.reporting.page import Page, page_text
from bmask_slam.reporting.parts import Section, slug

PAGE = "report.html"
FIGURES = "figures"


def write_report(comparison: Comparison, folder: Path) -> list[Path]:
    """Write report.html, tables.csv, .md, .tex and figures/*.pdf to the comparison's folder.

    Returns the paths. The figure of a cell with missing or broken files is skipped, with a
    warning. The same comparison and files give the same bytes.
    """
    refuse_link(folder / FIGURES)  # before anything is drawn
    sections, sentences = make_sections(comparison, folder), summary(comparison)
    ablation = ablation_table(comparison)
    tables = [*metric_tables(comparison), *([ablation] if ablation else [])]
    tables += verdict_tables(comparison)
    title = comparison.title or comparison.name
    texts = {
        PAGE: page_text(Page(title, comparison.description, sentences, sections)),
        "tables.csv": csv_text(comparison),
        "tables.md": markdown_text(tables, title),
        "tables.tex": latex_text(tables),
    }
    written = [
        _write(folder / name, text.encode("utf-8", "replace")) for name, text in texts.items()
    ]
    return written + _write_figures(folder / FIGURES, sections)


def _write_figures(folder: Path, sections: list[Section]) -> list[Path]:
    """Write every drawing as a PDF for a paper, and remove earlier ones."""
    folder.mkdir(exist_ok=True)
    drawn = [p for section in sections for p in section.pictures if p.pdf is not None]
    files = {}
    for k, picture in enumerate(drawn):
        name = slug(picture.title)
        files[f"{name}-{k}.pdf" if f"{name}.pdf" in files else f"{name}.pdf"] = picture.pdf
    for old in folder.glob("*.pdf"):
        if old.name not in files:
            old.unlink()
    return [_write(folder / name, data) for name, data in files.items() if data is not None]


def _write(path: Path, data: bytes) -> Path:
    with whole_file(path) as temporary:
        temporary.write_bytes(data)
    return path
