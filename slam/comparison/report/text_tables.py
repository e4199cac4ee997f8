"""Tables as CSV, Markdown and LaTeX."""

from __future__ import annotations

import csv
import io
import re

from bmask_slam.comparison.experiment.result import Comparison
from bmask_slam.comparison.report.table import RANGE
from bmask_slam.reporting.metric_table import BY_NAME
from bmask_slam.reporting.parts import Entry, Table, TableRow, slug

CSV_COLUMNS = ("sequence", "method", "kind", "with_scale", "seed", "status", "metric", "value",
               "unit", "error", "source")  # fmt: skip
NARROW = 4  # columns of a table in which ranges have room
HEAD_LETTERS = 12
STORED_UNITS = {"cm": "m", "mm": "m", "%": "1", "°": "deg", "°/m": "deg/m"}
LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
    "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", '"': r"\textquotedbl{}",
    "–": "--", "—": "---", "°": r"\textdegree{}", "±": r"\(\pm\)", "×": r"\(\times\)",
    "σ": r"\(\sigma\)", "\n": " ",
}  # fmt: skip


def csv_text(comparison: Comparison) -> str:
    """A line for each cell and metric, values as stored (SI); an empty line for a cell without."""
    methods = {method.name: method for method in comparison.methods}
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(CSV_COLUMNS)
    for cell in comparison.cells:
        method = methods[cell.method]
        begin = (cell.sequence, cell.method, method.kind.value, int(method.with_scale),
                 "" if cell.seed is None else cell.seed, cell.status.value)  # fmt: skip
        for name, value in cell.metrics.items() or [("", "")]:
            writer.writerow((*begin, name, value, _stored_unit(name), cell.error, cell.source))
    return out.getvalue()


def markdown_text(tables: list[Table], title: str) -> str:
    """All tables as a page of Markdown."""
    return "\n".join([f"# {_markdown(title)}\n", *(_markdown_table(table) for table in tables)])


def latex_text(tables: list[Table]) -> str:
    """All tables as floats for a document with the package booktabs."""
    head = "% Needs \\usepackage{booktabs}, and a TeX of 2020 or later (UTF-8, \\textdegree).\n"
    return head + "\n".join(_latex_table(table) for table in tables)


def latex(text: str) -> str:
    """Text with LaTeX's special characters escaped."""
    return "".join(LATEX.get(character, character) for character in text)


def _stored_unit(name: str) -> str:
    metric = BY_NAME.get(name)
    return STORED_UNITS.get(metric.unit, metric.unit) if metric else ""


def _markdown(text: str) -> str:
    return re.sub(r"([\\`*_<>|\[\]#~])", r"\\\1", " ".join(text.split()))


def _markdown_table(table: Table) -> str:
    lines = [f"## {_markdown(table.title)}\n", f"{_markdown(table.caption)}\n"]
    heads = [_markdown(text) for text in (table.corner, *table.columns)]
    lines += [f"| {' | '.join(heads)} |", f"|{' --- |' * len(heads)}"]
    for row in table.rows:
        entries = [_markdown_entry(entry) for entry in row.entries]
        lines.append(f"| {' | '.join([_markdown(_label(row)), *entries])} |")
    notes = [f"- {_markdown(f'{row.label}: {row.note}')}" for row in table.rows if row.note]
    return "\n".join([*lines, "", *notes, *([""] if notes else [])])


def _markdown_entry(entry: Entry) -> str:
    text = _markdown(entry.plain)
    return f"**{text}**" if entry.best else text


def _latex_table(table: Table) -> str:
    """A small table with wrapped headings; ranges only in narrow tables."""
    narrow = len(table.columns) <= NARROW
    heads = [latex(table.corner), *map(_latex_head, table.columns)]
    rows = [
        [_latex_label(row), *(_latex_entry(e, narrow) for e in row.entries)] for row in table.rows
    ]
    notes = " ".join(f"{row.label}: {row.note}." for row in table.rows if row.note and row.tags)
    caption = table.caption if narrow else table.caption.replace(RANGE, "")
    lines = [
        r"\begin{table}", r"\centering\small\setlength{\tabcolsep}{3pt}",
        rf"\caption{{{latex(f'{caption} {notes}'.strip())}}}\par\smallskip",
        rf"\label{{tab:{slug(table.name)}}}",
        rf"\begin{{tabular}}{{l{'r' * len(table.columns)}}}", r"\toprule",
        *_latex_rows([heads]), r"\midrule", *_latex_rows(rows), r"\bottomrule",
        r"\end{tabular}", r"\end{table}", "",
    ]  # fmt: skip
    return "\n".join(lines)


def _latex_rows(rows: list[list[str]]) -> list[str]:
    return [" & ".join(row) + r" \\" for row in rows]


def _latex_head(text: str) -> str:
    """A heading in lines of about twelve letters, broken after _ or at spaces."""
    lines = [""]
    for piece in re.findall(r"[^_ ]+[_ ]?", text):
        if lines[-1] and len(lines[-1]) + len(piece) > HEAD_LETTERS + 1:
            lines.append("")
        lines[-1] += piece
    stacked = r" \\ ".join(latex(line.strip()) for line in lines)
    return rf"\shortstack[r]{{{stacked}}}" if len(lines) > 1 else stacked


def _latex_label(row: TableRow) -> str:
    tags = rf" {{\scriptsize ({latex(', '.join(row.tags))})}}" if row.tags else ""
    return latex(row.label) + tags


def _latex_entry(entry: Entry, with_spread: bool) -> str:
    text = rf"\textbf{{{latex(entry.text)}}}" if entry.best else latex(entry.text)
    small = [entry.spread.replace(" to ", "–")] * with_spread + [entry.note]
    return text + "".join(rf" {{\scriptsize {latex(note)}}}" for note in small if note)


def _label(row: TableRow) -> str:
    return f"{row.label} ({', '.join(row.tags)})" if row.tags else row.label
