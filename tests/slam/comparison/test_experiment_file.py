"""Experiments are read strictly: errors name file, path, value and cure."""

from pathlib import Path

import pytest

from bmask_slam.comparison.experiment.experiment import Configuration
from bmask_slam.comparison.experiment.experiment_file import find_experiment, read_experiment
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.data_files import data_path

WHOLE = """\
title: All keys
description: of an experiment
seeds: [3, 4]
with_scale: true
max_time_difference_s: 0.01
verdicts: [ate_rmse]
sequences:
  office: {render: {name: office, frames: 20, people: 1}}
  xyz: tum/freiburg1_xyz
  kitchen: {folder: kitchen, reference: truth.txt, camera: camera.yaml}
configurations:
  default:
  other: {note: no loops, set: [loops.enabled=false], segmenter: none, stride: 2, dense: true}
systems:
  ORB: {note: a file, with_scale: true, trajectories: {xyz: orb.txt, office@3: orb-3.txt}}
published:
  - {method: DVO, source: "a table", ate_rmse: {xyz: 0.011}, tracked_share: {xyz: 1}}
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "mine.yaml"
    path.write_text(text)
    return path


def test_every_key_is_read(tmp_path):
    found = read_experiment(write(tmp_path, WHOLE))
    assert (found.name, found.title, found.seeds) == ("mine", "All keys", (3, 4))
    assert (found.with_scale, found.max_time_difference_s) == (True, 0.01)
    office, xyz, kitchen = found.sequences
    assert (office.render.name, office.render.frames, office.render.people) == ("office", 20, 1)
    assert (xyz.name, xyz.folder, xyz.render) == ("xyz", "tum/freiburg1_xyz", None)
    assert kitchen.reference == tmp_path / "truth.txt"
    assert kitchen.camera == tmp_path / "camera.yaml"
    assert found.configurations["default"] == Configuration()
    assert found.configurations["other"].arguments() == [
        *("--segmenter", "none", "--stride", "2", "--set", "loops.enabled=false", "--map"),
    ]
    assert found.systems["ORB"].trajectories == {"xyz": "orb.txt", "office@3": "orb-3.txt"}
    assert found.systems["ORB"].with_scale
    assert found.published[0].figures == {"ate_rmse": {"xyz": 0.011}, "tracked_share": {"xyz": 1}}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("title:", "titel:", "unknown key titel; there are: name, title"),
        ("seeds: [3, 4]", "seeds: 3", "seeds = 3 is not a list"),
        ("seeds: [3, 4]", "seeds: [3, 3]", "each once"),
        ("0.01", "20", "give seconds, at most 1"),
        (
            "verdicts: [ate_rmse]",
            "verdicts: [ate]",
            "'ate' cannot be judged; metrics are: ate_rmse",
        ),
        ("verdicts: [ate_rmse]", "verdicts: [loops_closed]", "cannot be judged"),
        ("frames: 20", "frame: 20", r"sequences.office.render: unknown key frame; did you mean"),
        ("frames: 20", "frames: few", r"frames = few is not a whole number"),
        ("frames: 20", "seed: 2", r"render: seed = 2 is each cell's own; write it in seeds"),
        ("name: office", "name: attic", r"name = 'attic' is not a scene; there are: office"),
        ("folder: kitchen, ", "", r"sequences.kitchen: give either folder or render"),
        ("folder: kitchen", "path: kitchen", r"sequences.kitchen: unknown key path"),
        ("loops.enabled", "loop.enabled", r"configurations.other: --set .*did you mean loops"),
        ("stride: 2", "stride: 0", r"configurations.other: stride = 0: must be at least 1"),
        (
            "dense: true",
            "dance: true",
            r"configurations.other: unknown key dance; there are: note, config",
        ),
        ("{xyz: orb.txt,", "{zyx: orb.txt,", r"systems.ORB: no sequence 'zyx'; there are: kitchen"),
        ("xyz: orb.txt", "xyz: 5", r"systems.ORB.trajectories.xyz = 5: give a file's path"),
        ("ate_rmse: {xyz", "ate: {xyz", r"published\[0\]: unknown key ate"),
        ("{xyz: 0.011}", "{xyz: 1 cm}", r"ate_rmse.xyz = '1 cm': give a number"),
        ('source: "a table", ', "", r"published\[0\]: source is missing"),
        ("method: DVO", "method: default", "too similar"),
        ("  ORB:", "  O/B:", "method 'O/B': use letters and digits"),
    ],
)
def test_errors_name_the_wrong_key(tmp_path, old, new, message):
    assert old in WHOLE
    path = write(tmp_path, WHOLE.replace(old, new))
    with pytest.raises(InputError, match=message) as caught:
        read_experiment(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("text", ["", "title: none", "[]", "sequences: 5"])
def test_an_experiment_needs_sequences(tmp_path, text):
    with pytest.raises(InputError, match=r"mine\.yaml"):
        read_experiment(write(tmp_path, text))


def test_an_unknown_name_lists_the_shipped_ones():
    with pytest.raises(InputError, match="rendered"):
        find_experiment("renderd")


@pytest.mark.parametrize(
    "path", sorted(data_path("experiments").glob("*.yaml")), ids=lambda p: p.stem
)
def test_shipped_experiments_are_read(path):
    found = read_experiment(path.stem)
    assert found.file == path
    assert found.title
    assert found.description
    assert found.configurations
