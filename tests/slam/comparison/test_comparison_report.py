"""The report holds every figure, does not average failures, and escapes texts."""

from __future__ import annotations

import csv
import html.parser
import io
import re
import shutil
import subprocess
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_comparison import HOSTILE, WAVE_M, make_comparison

from bmask_slam.comparison.experiment.result import Cell, CellStatus, Comparison, Kind, Method
from bmask_slam.comparison.jobs.errors import Rules, trajectory_errors
from bmask_slam.comparison.report import write_report
from bmask_slam.comparison.report.figures import common_scales, error_picture, read_errors
from bmask_slam.comparison.report.sections import make_sections, summary
from bmask_slam.comparison.report.table import ATE, metric_table
from bmask_slam.comparison.report.verdict_tables import ablation_table
from bmask_slam.graph.metrics import ErrorStatistics
from bmask_slam.graph.trajectory import Trajectory, read_tum, write_tum
from bmask_slam.reporting.metric_table import BY_NAME

RULES = Rules(0.02)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("comparison")


@pytest.fixture(scope="module")
def comparison(folder: Path) -> Comparison:
    return make_comparison(folder)


@pytest.fixture(scope="module")
def written(comparison: Comparison, folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in write_report(comparison, folder)}


class Page(html.parser.HTMLParser):
    """Text, tags and loaded addresses of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.words: list[str] = []
        self.feed(text)
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.addresses += [value for name, value in attrs if name in ("src", "href")]

    def handle_data(self, data):
        self.words.append(data)


@pytest.fixture(scope="module")
def page(written: dict[str, bytes]) -> Page:
    return Page(written["report.html"].decode())


def test_every_figure_of_every_cell_is_in_the_page_and_the_csv(comparison, written, page):
    rows = list(csv.DictReader(io.StringIO(written["tables.csv"].decode())))
    for cell in comparison.cells:
        if cell.status is not CellStatus.DONE:
            continue
        for name, value in cell.metrics.items():
            metric = BY_NAME[name]
            assert f"{metric.scale * value:.{metric.digits}f}" in page.text
            assert any(
                (row["sequence"], row["method"], row["metric"])
                == (cell.sequence, cell.method, name)
                and float(row["value"]) == value
                for row in rows
            )


def test_a_failed_run_is_listed_with_its_log_and_not_averaged(comparison, written, page):
    table = metric_table(comparison, ATE)
    entry = table.rows[1].entries[0]
    assert (entry.text, entry.note, entry.failed) == ("0.77", "1 of 2 failed", True)
    assert not entry.best, "a method that failed is not the best"
    assert table.rows[0].entries[0].text == "1.33", "median of 1.11 and 1.55"
    assert "999" not in page.text
    assert "Killed <b>here</b> & there" in page.text
    assert "first line" not in page.text
    assert "1 of 2 failed" in page.text


def judged(comparison: Comparison, ratio: float) -> Comparison:
    """Ten sequences, two methods, the second with errors larger by a factor."""
    names = tuple(f"room {k}" for k in range(10))
    errors_m = {name: 0.01 * (1 + k / 10) for k, name in enumerate(names)}
    methods = (Method("default", Kind.RUN), Method(HOSTILE, Kind.RUN))
    cells = tuple(
        Cell(name, method.name, 0, CellStatus.DONE, {"ate_rmse": value * (ratio if k else 1)})
        for name, value in errors_m.items()
        for k, method in enumerate(methods)
    )
    return replace(comparison, sequences=names, methods=methods, cells=cells, provenance={})


def test_a_significant_difference_is_reported(comparison, tmp_path):
    sections = make_sections(judged(comparison, 1.5), tmp_path)
    tables = {table.name: table for section in sections for table in section.tables}
    (row,) = tables["verdict-ate_rmse"].rows
    judgement, difference, interval, counts, _ = (entry.text for entry in row.entries)
    assert float(difference) == pytest.approx(0.5 * 1.45, abs=1e-3), "0.5 times the mean, in cm"
    low, high = (float(limit) for limit in interval.split(" to "))
    assert 0 < low < float(difference) < high
    assert counts == "0 / 10 of 10"
    assert judgement == "worse"
    assert {entry.text for entry in tables["ablation"].rows[0].entries} == {"+50"}
    (counted, verdict) = summary(judged(comparison, 1.5))
    assert "20 cells, all done" in counted
    assert verdict == f"ATE: {HOSTILE} is worse than default by 0.72 cm on the mean of 10 pairs."


def test_no_significant_difference_is_reported_as_none(comparison, tmp_path):
    same = judged(comparison, 1.0)
    assert summary(same)[1] == "ATE: no difference from default is shown."
    page = Page(next(p for p in write_report(same, tmp_path)).read_text(encoding="utf-8"))
    assert "no difference shown" in page.text


def test_a_failed_method_is_not_in_the_ablation_table(comparison):
    assert ablation_table(comparison) is None, "failed once, pending once"


def test_the_provenance_is_complete_without_empty_values(comparison, tmp_path):
    given = {
        "commit": "abc",
        "workers": 2,
        "experiment": {"seeds": [0], "note": "", "render": None},
    }
    *_, made = make_sections(replace(comparison, provenance=given), tmp_path)
    listings = {listing.title: listing.text for listing in made.listings}
    assert listings == {"Run": "commit: abc\nworkers: 2", "Experiment": "seeds: [0]"}


def test_pending_cells_and_partial_truth_are_reported(comparison):
    first, second = metric_table(comparison, ATE).rows[:2]
    assert first.entries[1].note == "1 of 2 pending"
    assert second.entries[1].note == "over 62 %"


def test_only_measured_se3_results_are_compared_for_the_best(comparison):
    table = metric_table(comparison, ATE)
    best = [row.label for row in table.rows for entry in row.entries if entry.best]
    assert best == [HOSTILE]
    tags = {row.label: row.tags for row in table.rows}
    assert tags["other"] == ("trajectory file", "Sim(3)")
    assert tags["paper"] == ("published",)


def test_a_trajectory_that_covers_little_is_shown_but_never_the_best(comparison):
    def covering(cell: Cell) -> Cell:
        lost = cell.sequence == "two_x" and cell.method == HOSTILE
        return replace(cell, metrics=cell.metrics | {"tracked_share": 0.17 if lost else 1.0})

    cells = tuple(map(covering, comparison.cells))
    table = metric_table(replace(comparison, cells=cells), ATE)
    (entry,) = (row.entries[1] for row in table.rows if row.label == HOSTILE)
    assert entry.text == "1.94"
    assert entry.note.startswith("covers 17 %")
    assert not any(row.entries[1].best for row in table.rows)


def test_published_rows_have_their_source(page):
    assert "Table 3 of X & Y" in page.text


def test_the_page_is_escaped_and_loads_nothing(page):
    assert "script" not in page.tags
    assert "b" not in page.tags
    assert HOSTILE in page.text
    assert page.addresses
    assert all(address.startswith(("data:", "#")) for address in page.addresses)


def test_latex_holds_no_bare_special_character(written):
    text = written["tables.tex"].decode()
    body = "\n".join(line for line in text.splitlines() if not line.startswith("%"))
    assert r"\textless{}script\textgreater{}" in body
    assert r"50\%\_\{\textbackslash{}input\{a\}\}" in body
    assert not re.search(r"(?<!\\)[%#_$^~]", body)
    for row in re.findall(r"^.* & .*$", body, re.MULTILINE):
        assert row.endswith(r"\\")


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no pdflatex on this machine")
def test_latex_compiles(written, tmp_path):
    begin = "\\documentclass{article}\\usepackage{booktabs}\\begin{document}\n"
    source = begin + written["tables.tex"].decode() + "\\end{document}\n"
    (tmp_path / "paper.tex").write_text(source, encoding="utf-8")
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:]


def test_a_report_with_wide_tables_and_long_names(comparison, folder, tmp_path):
    """Forty sequences, names that cannot be wrapped, a log of one long line."""
    names = tuple(f"freiburg3_walking_halfsphere_validation_{k}" for k in range(40))
    log = tmp_path / "log.txt"
    log.write_text("x" * 100_000, encoding="utf-8")
    method = "m" * 300
    cells = tuple(
        Cell(name, method, 0, CellStatus.FAILED, log="log.txt", error="e" * 3000) if k == 3 else
        Cell(name, method, 0, CellStatus.DONE, dict.fromkeys(BY_NAME, 12345.678))
        for k, name in enumerate(names)
    )  # fmt: skip
    wide = replace(comparison, sequences=names, methods=(Method(method, Kind.RUN),), cells=cells)
    assert all(path.stat().st_size for path in write_report(wide, tmp_path))


def test_a_report_without_finished_cells(comparison, tmp_path):
    cells = tuple(replace(c, status=CellStatus.PENDING, metrics={}) for c in comparison.cells)
    page = next(p for p in write_report(replace(comparison, cells=cells), tmp_path))
    assert "10 pending" in page.read_text(encoding="utf-8")


def test_markdown_tables_keep_their_columns(written):
    tables = written["tables.md"].decode().split("\n## ")[1:]
    assert len(tables) > 2
    for table in tables:
        rows = [line for line in table.splitlines() if line.startswith("|")]
        assert len({len(re.findall(r"(?<!\\)\|", row)) for row in rows}) == 1, table


def test_the_same_comparison_gives_the_same_bytes(comparison, written, folder):
    again = {path.name: path.read_bytes() for path in write_report(comparison, folder)}
    assert again == written


def test_drawn_errors_equal_those_of_the_trajectories(comparison, folder):
    """The height swings by 5 cm: an RMSE of 5 cm / sqrt(2), which alignment does not remove."""
    errors = read_errors(comparison.cells[0], folder, RULES)
    assert errors.absolute.translation_m.rmse == pytest.approx(WAVE_M / np.sqrt(2), rel=0.01)
    step_m = 2 * WAVE_M * np.sin(3 * np.pi / 10)  # amplitude of a swing's difference over a second
    assert errors.per_second.translation_m.max == pytest.approx(step_m, rel=0.02)


@pytest.mark.parametrize("with_scale", [False, True])
def test_drawn_errors_equal_those_of_the_tables(comparison, folder, with_scale):
    """A path half as large: its scale must be found for relative errors too."""
    small = read_tum(folder / "bad.txt")
    poses = small.poses_world_camera.copy()
    poses[:, :3, 3] *= 0.5
    write_tum(folder / "small.txt", Trajectory(small.timestamps_s, poses))
    rules = Rules(0.02, with_scale)
    drawn = read_errors(replace(comparison.cells[0], trajectory="small.txt"), folder, rules)
    table = trajectory_errors(folder / "small.txt", folder / "truth.txt", rules)
    assert drawn.absolute.translation_m.rmse == pytest.approx(table["ate_rmse"])
    assert drawn.per_second.translation_m.rmse == pytest.approx(table["rpe_trans_rmse_second"])
    assert (table["rpe_trans_rmse_second"] < 0.2) == with_scale


def test_figures_of_a_sequence_share_their_scales(comparison, folder):
    good, bad = (read_errors(comparison.cells[k], folder, RULES) for k in (0, 2))
    together = common_scales([good, bad])
    assert together.top_cm == common_scales([bad]).top_cm > common_scales([good]).top_cm
    assert together.enlarged == common_scales([bad]).enlarged <= common_scales([good]).enlarged


def test_a_trajectory_without_any_error_is_drawn_without_a_warning(comparison, folder):
    errors = read_errors(comparison.cells[0], folder, RULES)
    relative = replace(errors.per_second, translation_m=ErrorStatistics(np.zeros(3)))
    scales = common_scales([replace(errors, per_second=relative)])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        error_picture(comparison.methods[0], errors, scales)


def test_a_missing_trajectory_has_no_figure(comparison, folder, caplog):
    assert read_errors(comparison.cells[-1], folder, RULES) is None
    assert "missing.txt" in caplog.text
