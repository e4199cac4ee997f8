"""Dense clouds in a run folder, and files beside them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.ply import read_ply, write_ply
from bmask_slam.mapping.products.cloud import Cloud
from bmask_slam.mapping.products.cloud_files import CloudWriter
from bmask_slam.run_folder.landmark_file import read_dense_cloud
from bmask_slam.run_folder.reader import Run

NAMES = ("background", "chair")


def write_cloud(stem: Path, value: float = 1.0, column: str = "points") -> Path:
    """A cloud of three points, of which the second has another value."""
    rows, one = {n: np.ones((3, 3), np.float32) for n in ("points", "normals")}, np.ones(3)
    rows[column][1, 2] = value
    number = one.astype(np.uint16)
    colours, one = np.zeros((3, 3), np.uint8), one.astype(np.float32)
    with CloudWriter(stem) as file:
        file.write(Cloud(*rows.values(), colours, one, number, one, number))
    return stem.with_suffix(".ply")


@pytest.mark.parametrize("column", ["points", "normals"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_cloud_that_is_not_finite_is_refused(tmp_path: Path, value: float, column: str) -> None:
    assert len(read_dense_cloud(write_cloud(tmp_path / "good"), NAMES)) == 3
    with pytest.raises(InputError, match=r"bad\.ply: a point or normal is not finite; make it"):
        read_dense_cloud(write_cloud(tmp_path / "bad", value, column), NAMES)


def test_labels_that_another_program_saved_as_floats_are_read(tmp_path: Path) -> None:
    columns = read_ply(write_cloud(tmp_path / "cloud"))
    for value in (1.0, np.nan):
        label = np.full(3, value, np.float32)
        write_ply(tmp_path / "edited.ply", {**columns, "label": label})
        if np.isfinite(value):
            assert read_dense_cloud(tmp_path / "edited.ply", NAMES).labels.tolist() == ["chair"] * 3
        else:
            with pytest.raises(InputError, match="a label beyond the 2 of the run"):
                read_dense_cloud(tmp_path / "edited.ply", NAMES)


def test_a_users_own_file_beside_the_objects_is_no_object(tmp_path: Path) -> None:
    objects = tmp_path / "dense" / "objects"
    objects.mkdir(parents=True)
    (tmp_path / "frames.csv").write_text("index,timestamp,status,keyframe\n")
    legend = {name: [9, 9, 9] for name in NAMES}
    (tmp_path / "dense" / "legend.json").write_text(json.dumps(legend))
    for name in ("0007-chair", "my-room", "3d-scan"):
        write_cloud(objects / name)
    assert list(Run(tmp_path).object_clouds) == [7]
