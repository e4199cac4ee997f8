"""The report of a comparison: a web page, tables as CSV, Markdown and LaTeX, figures as PDF."""

from bmask_slam.comparison.report.report import write_report

__all__ = ["write_report"]
