"""Objects of a run: read back, and queried by name."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from bmask_slam.cli import main
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.labelling.results import MapObjects
from bmask_slam.run_folder.query import format_answer, query
from bmask_slam.run_folder.semantic_files import (
    BOXES,
    OBJECTS,
    read_objects,
    write_boxes,
    write_objects,
)
from bmask_slam.semantics.labels import label_set
from bmask_slam.semantics.objects.boxes3d import OrientedBox
from bmask_slam.semantics.objects.object_map import MapObject

NAMES = label_set(("chair", "desk", "cup"))


def make_object(number: int, label: int, probability: float, keyframes: list[int]) -> MapObject:
    p: Array = np.full(4, (1 - probability) / 3)
    p[label] = probability
    T = se3_exp(np.array([0.1, 0.2, 0.3 * number, 1.0, 2.0, 3.0 + number]))
    box = OrientedBox(T, np.array([0.4, 1.25, 0.9]))
    ids = np.array(keyframes), np.array([7, 9])
    return MapObject(number, label, p, np.array([1.0, -2.0, 3.5]), box, *ids, 0.5, 2.25)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    made = [
        make_object(0, 1, 0.6, [0, 1, 2, 5]),
        make_object(1, 2, 0.9, [4]),
        make_object(4, 1, 0.8, [3, 4, 6]),
    ]
    found = MapObjects(NAMES, made, np.array([0.0, -1.0, 0.0]))
    write_objects(tmp_path / OBJECTS, found)
    write_boxes(tmp_path / BOXES, found)
    return tmp_path


def test_objects_are_read_back(run: Path) -> None:
    names, objects = read_objects(run)
    assert names == ("unknown", "chair", "desk", "cup")
    assert [o.id for o in objects] == [0, 1, 4]
    original, o = make_object(4, 1, 0.8, [3, 4, 6]), objects[2]
    assert np.allclose(o.box.T_world_box, original.box.T_world_box, atol=1e-6)
    assert np.allclose(o.box.size_m, original.box.size_m)
    assert np.allclose(o.centroid_world, original.centroid_world)
    assert (o.label, o.probability, o.first_seen_s, o.last_seen_s) == ("chair", 0.8, 0.5, 2.25)
    assert o.keyframes.tolist() == [3, 4, 6]
    assert o.landmarks.tolist() == [7, 9]


def test_the_most_certain_object_is_first(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    answer = query(run, "chair")
    assert [o.id for o in answer.objects] == [4, 0]
    assert answer.counts == {"chair": 2, "desk": 1}
    assert len(query(run, None).objects) == 3
    assert main(["query", str(run), "chair"]) == 0
    head, first, second = capsys.readouterr().out.splitlines()
    assert "keyframes" in head
    expected = "chair 4 1.000 -2.000 3.500 1.25 0.40 0.90 0.80 3-4, 6"
    assert " ".join(first.split()) == expected
    assert second.endswith("0-2, 5")


def test_only_the_most_certain_objects_are_listed_without_all(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = [make_object(k, 1 + k % 3, 0.5 + k / 100, [k]) for k in range(12)]
    write_objects(tmp_path / OBJECTS, MapObjects(NAMES, made, np.array([0.0, -1.0, 0.0])))
    assert [o.id for o in query(tmp_path, None, 10).objects] == list(range(11, 1, -1))
    assert main(["query", str(tmp_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 12
    assert lines[-1] == "and 2 objects that are less sure: --all"
    assert main(["query", str(tmp_path), "--all"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 13
    assert main(["query", str(tmp_path), "chair"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 5


def test_unknown_labels_in_a_query(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "no cup; the run holds chair (2), desk (1)" in format_answer(query(run, "cup"))
    assert main(["query", str(run), "horse"]) == 1
    error = capsys.readouterr().err
    assert "'horse'" in error
    assert "chair (2), desk (1)" in error
    assert "the set has chair, desk, cup" in error


def test_runs_without_objects_or_with_broken_ones(run: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="had a segmenter"):
        query(tmp_path / "nothing", "chair")
    content = json.loads((run / OBJECTS).read_text())
    for broken in ("", "[]", '{"labels": []}', json.dumps({**content, "objects": [{"id": 1}]})):
        (run / OBJECTS).write_text(broken)
        with pytest.raises(InputError, match="run again"):
            query(run, "chair")


def test_boxes_are_written_as_lines(run: Path) -> None:
    head, body = (run / BOXES).read_text().split("end_header\n")
    assert "element vertex 24" in head
    assert "element edge 36" in head
    rows = [line.split() for line in body.splitlines()]
    corners = np.array([[float(v) for v in row[:3]] for row in rows[:24]])
    assert np.allclose(corners[:8], make_object(0, 1, 0.6, [0]).box.corners_world, atol=1e-5)
    edges = np.array(rows[24:], int)
    lengths = np.linalg.norm(corners[edges[:, 0]] - corners[edges[:, 1]], axis=1)
    assert set(np.round(lengths, 3)) == {0.4, 1.25, 0.9}
