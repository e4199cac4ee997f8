"""Results are read back from their file; other files are rejected."""

import math
from dataclasses import replace

import pytest

from bmask_slam.comparison.experiment.result import (
    RESULTS,
    Cell,
    CellStatus,
    Comparison,
    Kind,
    Method,
    read_results,
    write_results,
)
from bmask_slam.graph.errors import InputError

COMPARISON = Comparison(
    name="small",
    title="A small one",
    description="two cells",
    sequences=("office",),
    methods=(Method("default", Kind.RUN), Method("other", Kind.PUBLISHED, "a paper", True)),
    cells=(
        Cell("office", "default", 0, CellStatus.DONE, {"ate_rmse": 0.0123}, folder="cells/a"),
        Cell("office", "default", 1, CellStatus.FAILED, error="killed"),
        Cell("office", "other", None, CellStatus.DONE, {"ate_rmse": 0.02}, source="Table 1"),
    ),
    provenance={"commit": "abc", "versions": {"numpy": "2"}},
    drawn=("office",),
)


def test_what_was_written_is_read(tmp_path):
    write_results(tmp_path / RESULTS, COMPARISON)
    assert read_results(tmp_path) == COMPARISON
    assert [cell.seed for cell in COMPARISON.of("office", "default")] == [0, 1]


def test_a_missing_value_stays_missing(tmp_path):
    cell = replace(COMPARISON.cells[0], metrics={"ate_rmse": math.nan})
    write_results(tmp_path / RESULTS, replace(COMPARISON, cells=(cell,)))
    assert "NaN" not in (tmp_path / RESULTS).read_text()
    assert math.isnan(read_results(tmp_path).cells[0].metrics["ate_rmse"])


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"format": 99}'])
def test_other_files_than_results_are_rejected(tmp_path, text):
    (tmp_path / RESULTS).write_text(text)
    with pytest.raises(InputError, match=r"results\.json"):
        read_results(tmp_path)


def test_a_missing_file_is_an_error_with_the_cure(tmp_path):
    with pytest.raises(InputError, match="bmask-slam compare"):
        read_results(tmp_path)


def test_a_data_frame_has_a_row_per_cell_and_a_column_per_metric():
    pytest.importorskip("pandas")
    frame = COMPARISON.to_pandas()
    assert list(frame["kind"]) == ["run", "run", "published"]
    means = frame.groupby("method")["ate_rmse"].mean()
    assert means.to_dict() == {"default": 0.0123, "other": 0.02}
