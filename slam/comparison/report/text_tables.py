"""Tables as CSV, Markdown and LaTeX."""

from __future__ import annotations

import csv
import io
import re

from slam.comparison.metric_table import BY_NAME
from slam.comparison.report.table import Entry, Table, TableRow
from slam.comparison.result import Comparison

CSV_COLUMNS = ("sequence", "method", "kind", "with_scale", "seed", "status", "metric", "value",
               "unit", "error", "source")  # fmt: skip
STORED_UNITS = {"cm": "m", "mm": "m", "%": "1", "°": "deg"}
LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
    "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", '"': r"\textquotedbl{}",
    "–": "--", "—": "---", "°": r"\textdegree{}", "±": r"\(\pm\)", "×": r"\(\times\)",
    "σ": r"\(\sigma\)", "\n": " ",
}  # fmt: skip


def csv_text(comparison: Comparison) -> str:
    """A line for each cell and metric, values as stored (SI); a cell without has one empty line."""
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
    """Text with every character that LaTeX would read as its own escaped."""
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
    return "\n".join([*lines, ""])


def _markdown_entry(entry: Entry) -> str:
    text = _markdown(entry.plain)
    return f"**{text}**" if entry.best else text


def _latex_table(table: Table) -> str:
    rows = [" & ".join([latex(table.corner), *map(latex, table.columns)]) + r" \\"]
    for row in table.rows:
        entries = [_latex_entry(entry) for entry in row.entries]
        rows.append(" & ".join([latex(_label(row)), *entries]) + r" \\")
    head, *body = rows
    lines = [
        r"\begin{table}", r"\centering", rf"\caption{{{latex(table.caption)}}}",
        rf"\label{{tab:{re.sub(r'[^a-zA-Z0-9]+', '-', table.name)}}}",
        rf"\begin{{tabular}}{{l{'r' * len(table.columns)}}}", r"\toprule", head, r"\midrule",
        *body, r"\bottomrule", r"\end{tabular}", r"\end{table}", "",
    ]  # fmt: skip
    return "\n".join(lines)


def _latex_entry(entry: Entry) -> str:
    return rf"\textbf{{{latex(entry.plain)}}}" if entry.best else latex(entry.plain)


def _label(row: TableRow) -> str:
    return f"{row.label} ({', '.join(row.tags)})" if row.tags else row.label
