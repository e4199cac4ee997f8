"""The report of a comparison: a page, a PDF, and the tables as CSV, Markdown and LaTeX."""

from bmask_slam.comparison.report.report import write_report

__all__ = ["write_report"]
