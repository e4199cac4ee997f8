"""The file of keyframe covariances, also of a run."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np
import pytest
from synthetic_view import CAMERA, render_plane

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.graph.smoother.isam2 import SolverError
from bmask_slam.graph.smoother.smoother import Smoother
from bmask_slam.run_folder.covariance_file import (
    KeyframeCovariances,
    find_covariances,
    read_covariances,
    write_covariances,
)
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig


def example(count: int = 4) -> KeyframeCovariances:
    A = np.random.default_rng(2).normal(size=(count, 6, 6)) * 1e-3
    return KeyframeCovariances(
        np.array([0, 3, 4, 12][:count]), 1e9 + np.arange(count) / 3, A @ A.swapaxes(1, 2)
    )


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    made = example()
    write_covariances(tmp_path / "covariances.txt", made)
    found = read_covariances(tmp_path / "covariances.txt")
    np.testing.assert_array_equal(found.keyframe_ids, made.keyframe_ids)
    np.testing.assert_allclose(found.timestamps_s, made.timestamps_s, atol=1e-6)
    np.testing.assert_allclose(found.covariances, made.covariances, rtol=1e-8)
    assert [file.name for file in tmp_path.iterdir()] == ["covariances.txt"]


def test_the_columns_are_the_upper_triangle_row_by_row(tmp_path: Path) -> None:
    write_covariances(tmp_path / "c.txt", example(1))
    (line,) = [s for s in (tmp_path / "c.txt").read_text().splitlines() if not s.startswith("#")]
    numbers = [float(word) for word in line.split()]
    covariance = example(1).covariances[0]
    assert len(numbers) == 23
    assert numbers[2 + 1] == pytest.approx(covariance[0, 1])
    assert numbers[2 + 6] == pytest.approx(covariance[1, 1])
    assert numbers[-1] == pytest.approx(covariance[5, 5])


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda s: "", "no covariance in the file"),
        (lambda s: s.replace("\n", " 5\n"), "24 columns"),
        (lambda s: "x" + s, "not a keyframe id"),
        (lambda s: s.rsplit(" ", 1)[0] + " nan\n", "not a finite number"),
        (lambda s: s.rsplit(" ", 1)[0] + " -1.0\n", "keyframe 0 is not positive definite"),
    ],
)
def test_bad_files_are_refused_with_line_and_cure(tmp_path: Path, change, text: str) -> None:
    path = tmp_path / "covariances.txt"
    write_covariances(path, example(1))
    path.write_text(change(path.read_text().splitlines()[-1] + "\n"))
    with pytest.raises(InputError, match=text):
        read_covariances(path)
    with pytest.raises(InputError, match="no such file"):
        read_covariances(tmp_path / "elsewhere.txt")


def test_uncertainty_grows_along_the_path(tmp_path: Path) -> None:
    system = SlamSystem(CAMERA, SystemConfig(covariances=True))
    for i in range(30):
        system.process(render_plane(se3_exp(np.array([0, 0, 0, -0.6 + 0.05 * i, 0, 0])), i))
    system.finish()
    system.files()["covariances.txt"](tmp_path / "covariances.txt")
    found = read_covariances(tmp_path / "covariances.txt")
    keyframes = system.keyframe_trajectory()
    np.testing.assert_allclose(found.timestamps_s, keyframes.timestamps_s, atol=1e-6)
    assert len(found.keyframe_ids) >= 3
    sigma_m = np.sqrt(np.trace(found.covariances[:, 3:, 3:], axis1=1, axis2=2))
    assert sigma_m[0] < 1e-3  # the world is the first keyframe's
    assert sigma_m[0] < sigma_m[1] < sigma_m[-1] < 0.05


def test_a_singular_graph_is_said_with_the_variable_and_a_cure(tmp_path: Path, caplog) -> None:
    """The file then has no line, which "run again" would not change."""

    class Singular:
        def marginals(self) -> None:
            raise SolverError("Indeterminant linear system\nand much more", ("keyframe", 3))

    found = find_covariances(cast("Smoother", Singular()), {0: 0.0})
    said = caplog.messages[-1]
    assert "singular (Indeterminant linear system) and does not determine keyframe 3; add" in said
    write_covariances(tmp_path / "c.txt", found)
    with pytest.raises(InputError, match=r"c\.txt: no covariance in the file; .* log\.txt says"):
        read_covariances(tmp_path / "c.txt")
