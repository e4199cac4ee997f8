"""Objects of a run: read back, and queried by name."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from bmask_slam.cli import main
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.ply import read_ply, write_ply
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.labelling.results import MapObjects
from bmask_slam.run_folder.export import export
from bmask_slam.run_folder.scene.query import Asked, ask, format_answer, query
from bmask_slam.run_folder.scene.scene_graph import write_scene_graph
from bmask_slam.run_folder.semantic_files import (
    BOXES,
    OBJECTS,
    read_objects,
    read_scene,
    write_boxes,
    write_objects,
)
from bmask_slam.semantics.labels import label_set
from bmask_slam.semantics.objects.boxes3d import OrientedBox
from bmask_slam.semantics.objects.publication import MapObject

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


def test_an_answer_as_json(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["query", str(run), "chair", "--near", "0", "-1", "0.5", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    chairs = {found["id"]: found for found in answer["objects"]}
    assert chairs[4]["centroid_world_m"] == pytest.approx([1.0, -2.0, 3.5])
    assert sorted(chairs[4]["box"]["size_m"]) == pytest.approx([0.4, 0.9, 1.25])
    assert chairs[4]["distance_m"] > 0
    assert answer["counts"] == {"chair": 2, "desk": 1}


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


def test_an_empty_answer_names_the_relation_that_was_asked_for(run: Path) -> None:
    """The run holds chairs; none is in that relation."""
    for other, words in (("desk", "desk"), ("1", "1"), ("", "any other")):
        text = format_answer(ask(run, Asked("chair", relation="inside", other=other)))
        assert text == f"no chair inside {words}; the run holds chair (2), desk (1)"


def test_runs_without_objects_or_with_broken_ones(run: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="had a segmenter"):
        query(tmp_path / "nothing", "chair")
    content = json.loads((run / OBJECTS).read_text())
    for broken in ("", "[]", '{"labels": []}', json.dumps({**content, "objects": [{"id": 1}]})):
        (run / OBJECTS).write_text(broken)
        with pytest.raises(InputError, match="run again"):
            query(run, "chair")


def test_up_is_a_unit_vector(run: Path) -> None:
    content = json.loads((run / OBJECTS).read_text())
    (run / OBJECTS).write_text(json.dumps({**content, "up_world": [0.0, 3.0, -4.0]}))
    assert np.allclose(read_scene(run).up_world, [0.0, 0.6, -0.8], atol=1e-12)
    for up in ([0.0, 0.0, 0.0], [0.0, 1e-200, 0.0]):
        (run / OBJECTS).write_text(json.dumps({**content, "up_world": up}))
        with pytest.raises(InputError, match=r"objects.json: up_world: has no direction, .*; run"):
            read_scene(run)


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


def furnished(tmp_path: Path) -> Path:
    """A run with a desk, a cup on it, a chair beside it and one far away; z is up."""
    sizes = {1: (0.5, 0.5, 0.9), 2: (1.6, 0.8, 0.7), 3: (0.1, 0.1, 0.1)}
    made = []
    things = ((0, 2, 0, 0), (1, 3, 0.2, 0.75), (2, 1, 1.2, 0), (5, 1, 9, 0))
    for number, label, x_m, bottom_m in things:
        T = np.eye(4)
        T[:3, 3] = x_m, 0, bottom_m + 0.5 * sizes[label][2]
        box = OrientedBox(T, np.array(sizes[label]))
        p = np.eye(4)[label]
        ids = np.arange(3), np.array([10 * number, 10 * number + 1])
        made.append(MapObject(number, label, p, T[:3, 3], box, *ids, 0.5, 2.25))
    found = MapObjects(NAMES, made, np.array([0.0, 0.0, 1.0]), -0.01)
    write_objects(tmp_path / OBJECTS, found)
    return tmp_path


def test_objects_by_place(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = furnished(tmp_path)
    answer = ask(run, Asked(near_world=np.array([9.5, 0.0, 0.2]), most=2))
    assert [o.id for o in answer.objects] == [5, 2]
    assert answer.distances_m == pytest.approx((0.25, 9.5 - 1.45))
    assert main(["query", str(run), "chair", "--near", "0", "-1", "0.5"]) == 0
    head, first, _ = capsys.readouterr().out.splitlines()
    assert "distance (m)" in head
    assert first.split()[:2] == ["chair", "2"]


def test_objects_by_relation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = furnished(tmp_path)
    assert [o.id for o in ask(run, Asked(relation="on", other="desk")).objects] == [1]
    for desk in ("0", "000"):
        beside = ask(run, Asked("chair", relation="beside", other=desk))
        assert [o.id for o in beside.objects] == [2]
    assert ask(run, Asked(relation="inside")).objects == ()
    assert main(["query", str(run), "--on"]) == 0
    assert "on desk 0" in capsys.readouterr().out
    with pytest.raises(InputError, match="has no object 7"):
        ask(run, Asked(relation="on", other="7"))
    for other in ("sofa", "²", "9" * 5000):
        with pytest.raises(InputError, match=f"label set has no '{other[:9]}"):
            ask(run, Asked(relation="on", other=other))


def landmarks_of(run: Path) -> Array:
    """Write 60 landmarks; their points (60, 3)."""
    points = np.random.default_rng(0).uniform([-1, -1, 0], [10, 1, 2], (60, 3)).astype(np.float32)
    ids = np.arange(60, dtype=np.int32)
    grey = dict.fromkeys(("red", "green", "blue"), np.zeros(60, np.uint8))
    columns = dict(zip("xyz", points.T, strict=True))
    write_ply(run / "landmarks.ply", {**columns, **grey, "observations": ids, "id": ids})
    return points


@pytest.mark.parametrize(
    ("last", "problem"),
    [
        ([], "labels.csv: 59 lines, but 60 landmarks; run again"),
        (["59,desk,0.9,0.5,3,wall,abc"], "labels.csv: line 61: 'abc' is not a finite number"),
        (["59,desk,0.9,0.5,3,wall,nan"], "labels.csv: line 61: 'nan' is not a finite number"),
    ],
)
def test_a_scene_graph_of_broken_labels(tmp_path: Path, last: list[str], problem: str) -> None:
    run = furnished(tmp_path)
    landmarks_of(run)
    rows = [f"{k},desk,0.9,0.5,3,wall,0.5" for k in range(59)] + last
    head = "id,label,probability,entropy,views,surface,surface_probability"
    (run / "labels.csv").write_text("\n".join([head, *rows]) + "\n")
    with pytest.raises(InputError, match=problem):
        write_scene_graph(run, run / "scene.json")
    assert not (run / "scene.json").exists()


def test_the_scene_graph_of_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, out = furnished(tmp_path), tmp_path.parent / "scene.json"
    points = landmarks_of(run)
    rows = [f"{k},{'desk' if k < 20 else 'unknown'},0.75000,0.5,3" for k in range(60)]
    text = "\n".join(["id,label,probability,entropy,views", *rows]) + "\n"
    (run / "labels.csv").write_text(text)
    assert main(["export", str(run), "--format", "scene-graph", "--out", str(out)]) == 0
    content = json.loads(out.read_text())
    assert [o["label"] for o in content["objects"]] == ["desk", "cup", "chair", "chair"]
    assert {"subject": 1, "relation": "on", "object": 0} in content["relations"]
    assert content["room"]["floor_height_along_up_m"] == -0.01
    assert max(content["room"]["box"]["size"]) == pytest.approx(11, abs=1)
    surface = content["surfaces"][0]
    assert (surface["label"], surface["landmarks"], surface["probability"]) == ("desk", 20, 0.75)
    rows = [f"{k},unknown,0.9,0.5,3,{'wall' if k < 15 else 'unknown'},0.5" for k in range(60)]
    head = "id,label,probability,entropy,views,surface,surface_probability"
    (run / "labels.csv").write_text("\n".join([head, *rows]) + "\n")
    assert main(["export", str(run), "--format", "scene-graph", "--out", str(out)]) == 0
    surfaces = json.loads(out.read_text())["surfaces"]
    assert [(s["label"], s["landmarks"], s["probability"]) for s in surfaces] == [("wall", 15, 0.5)]
    cloud = tmp_path.parent / "objects.ply"
    assert main(["export", str(run), "--format", "objects-ply", "--out", str(cloud)]) == 0
    found = read_ply(cloud)
    assert found["id"].tolist() == [0, 0, 1, 1, 2, 2, 5, 5]
    assert np.allclose(found["x"][2:4], points[10:12, 0])
    assert len({tuple(found[c][k] for c in ("red", "green", "blue")) for k in range(8)}) == 4
    with pytest.raises(InputError, match="needs the folder of a run"):
        export(out, "scene-graph", tmp_path.parent / "other.json")


def test_no_run_and_no_place_are_refused(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["query", str(tmp_path / "nowhere")]) == 1
    assert "nowhere: no such folder; give that of a run" in capsys.readouterr().err
    assert main(["query", str(run), "--near", "1", "2", "nan"]) == 1
    assert "--near 1 2 nan: give three finite coordinates" in capsys.readouterr().err


def test_a_run_that_was_killed_and_can_go_on_is_said(tmp_path: Path, capsys) -> None:
    run, out = tmp_path / "run", tmp_path / "a"
    run.mkdir()
    (run / "checkpoint").write_text("")
    for words in (
        ["query", f"{run}"],
        ["export", f"{run}", "--format", "scene-graph", "--out", f"{out}"],
        ["export", f"{run}", "--format", "objects-ply", "--out", f"{out}"],
    ):
        assert main(words) == 1
        assert f"bmask-slam run --resume {run}" in capsys.readouterr().err
