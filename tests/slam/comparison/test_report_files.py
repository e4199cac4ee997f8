"""Report sections of run folders and trained networks: times, maps, losses, curves."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_comparison import make_comparison, unsaved

from bmask_slam.comparison.experiment.result import Comparison
from bmask_slam.comparison.report import figures, write_report
from bmask_slam.comparison.report.curves import network_pictures, read_losses, read_precision
from bmask_slam.comparison.report.run_files import event_table, map_pictures, stage_table
from bmask_slam.run_folder.frame_file import COLUMNS, STAGES
from bmask_slam.semantics.segmenters.evaluation import ApCurve, SegmentationResult, write_curves


@pytest.fixture
def comparison(tmp_path: Path) -> Comparison:
    """The first two runs have folders: one with times, one with a picture."""
    made = make_comparison(tmp_path)
    cells = list(made.cells)
    for k in range(2):
        (tmp_path / f"run{k}").mkdir()
        cells[k] = replace(cells[k], folder=f"run{k}")
    return replace(made, cells=tuple(cells))


def write_frames(path: Path, rows: list[dict[str, object]]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)


def test_stage_times_are_over_frames_or_keyframes_of_all_runs(comparison, tmp_path):
    frames = [{"tracking_ms": ms, "graph_ms": 0.0, "keyframe": ""} for ms in (10.0, 20.0)]
    write_frames(tmp_path / "run0/frames.csv", frames)
    keyframe = {"tracking_ms": 60.0, "graph_ms": 7.0, "keyframe": 3}
    write_frames(tmp_path / "run1/frames.csv", [keyframe])
    (row,) = stage_table(comparison, tmp_path).rows
    entries = dict(zip(STAGES, row.entries, strict=True))
    assert entries["tracking"].plain == "20.0 (95 %: 56.0)"
    assert entries["graph"].plain == "7.0 (95 %: 7.0)"
    assert entries["loops"].text == "–"


def test_without_run_folders_there_is_no_stage_table(comparison, tmp_path):
    assert stage_table(comparison, tmp_path) is None


def test_events_are_counted_by_kind_as_a_mean_over_runs(comparison, tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "as_picture", unsaved)
    assert event_table(comparison, "one", tmp_path) is None
    lost = '3,0.1,lost,"7 matches give no pose, nor is it recognised"\n'
    for k, count in enumerate((2, 1)):
        text = "index,timestamp,kind,text\n0,0.0,new segment,it begins\n" + count * lost
        (tmp_path / f"run{k}/events.csv").write_text(text)
    table = event_table(comparison, "one", tmp_path)
    assert table.columns == ("lost", "new segment")
    assert [entry.text for entry in table.rows[0].entries] == ["1.5", "1"]
    assert "Events in a run" in write_report(comparison, tmp_path)[0].read_text()


def test_map_pictures_are_of_the_first_run_with_maps_and_scaled(comparison, tmp_path):
    (tmp_path / "run1/dense").mkdir()
    image = np.zeros((600, 1800, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "run1/dense/view_overview.png"), image)
    (tmp_path / "run1/objects.png").write_text("no picture")
    (picture,) = map_pictures(comparison, "one", tmp_path)
    assert picture.size_px == (900, 300)
    assert picture.uri.startswith("data:image/png;base64,")
    assert map_pictures(comparison, "two_x", tmp_path) == []


def write_losses(folder: Path, scale: float) -> None:
    folder.mkdir()
    lines = ["step,loss,value"]
    lines += [
        f"{k},{name},{scale * v}" for k in range(100) for name, v in (("mask", 2), ("box", 3))
    ]
    (folder / "losses.csv").write_text("\n".join(lines))


def test_losses_are_summed_and_smoothed(tmp_path):
    write_losses(tmp_path / "a", 1.0)
    curves = read_losses(tmp_path / "a/losses.csv")
    assert set(curves) == {"mask", "box", "total"}
    np.testing.assert_allclose(curves["total"][:, 1], 5.0)
    assert curves["total"][0, 0] == 49, "a mean over fifty steps stands at the last of them"


def test_precision_recall_curves_are_read_back(tmp_path):
    precision = np.linspace(1, 0, 101) ** 2
    curve = ApCurve("segm", "class score x MaskIoU", 0.5, 0.6, 0.7, precision)
    write_curves(
        SegmentationResult(
            (curve,), iou_correlation=0.1, iou_correlation_of_good=0.1, images=3, instances=4
        ),
        tmp_path / "new/precision_recall.csv",
    )
    ((name, points),) = read_precision(tmp_path / "new/precision_recall.csv").items()
    assert name == "segm, by class score x MaskIoU"
    np.testing.assert_allclose(
        points, np.column_stack([np.linspace(0, 1, 101), precision]), atol=1e-6
    )


def test_networks_are_drawn_in_one_figure(comparison, tmp_path, caplog):
    write_losses(tmp_path / "a", 1.0)
    write_losses(tmp_path / "b", 2.0)
    (tmp_path / "b/precision_recall.csv").write_text("kind,recall\n1,2\n")
    named = {"experiment": {"networks": {"small": "a", "large": "b", "absent": "c"}}}
    (picture,) = network_pictures(replace(comparison, provenance=named), tmp_path)
    text = picture.data.decode()
    assert ">small<" in text
    assert ">large<" in text
    assert "absent" not in text
    assert "precision_recall.csv" in caplog.text


def test_drawings_are_kept_as_files_and_old_ones_removed(comparison, tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "as_picture", unsaved)
    first = {p.name for p in write_report(comparison, tmp_path) if p.parent.name == "figures"}
    assert "default-on-one.pdf" in first
    write_report(replace(comparison, sequences=("two_x",)), tmp_path)
    left = {path.name for path in (tmp_path / "figures").iterdir()}
    assert left == {name for name in first if "two-x" in name}
