"""KITTI and EuRoC trajectories: bytes of the files, round trips, errors."""

from pathlib import Path

import numpy as np
import pytest

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.graph.trajectory import Trajectory, write_tum
from bmask_slam.graph.trajectory_formats import (
    read_euroc,
    read_kitti,
    read_times,
    read_trajectory,
    recognise,
    write_euroc,
    write_kitti,
    write_times,
)


@pytest.fixture
def trajectory() -> Trajectory:
    rng = np.random.default_rng(0)
    stamps_s = 1403636579.763555527 + 0.05 * np.arange(50)
    return Trajectory(stamps_s, se3_exp(2 * rng.normal(size=(50, 6))))


def test_kitti_is_read_back(tmp_path: Path, trajectory: Trajectory) -> None:
    write_kitti(tmp_path / "a.txt", trajectory.poses_world_camera)
    found = read_kitti(tmp_path / "a.txt")
    np.testing.assert_allclose(found, trajectory.poses_world_camera, atol=1e-10)
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_kitti_rows_are_the_upper_rows_of_the_matrix(tmp_path: Path) -> None:
    T = np.array([[0.0, -1, 0, 7], [1, 0, 0, 8], [0, 0, 1, 9], [0, 0, 0, 1]])
    write_kitti(tmp_path / "a.txt", T[None])
    assert (tmp_path / "a.txt").read_text() == "0 -1 0 7 1 0 0 8 0 0 1 9\n"


def test_euroc_is_read_back_to_the_same_stamps(tmp_path: Path, trajectory: Trajectory) -> None:
    write_euroc(tmp_path / "a.csv", trajectory)
    found = read_euroc(tmp_path / "a.csv")
    np.testing.assert_array_equal(found.timestamps_s, trajectory.timestamps_s)
    np.testing.assert_allclose(found.poses_world_camera, trajectory.poses_world_camera, atol=1e-10)


def test_euroc_columns(tmp_path: Path) -> None:
    """w comes first; a quarter turn about z takes x to y; 17 columns are read as 8."""
    file = tmp_path / "a.csv"
    row = "1500000000,1,2,3,0.70710678118654752,0,0,0.70710678118654752"
    file.write_text(f"#header\n{row}\n")
    found = read_euroc(file)
    assert found.timestamps_s.tolist() == [1.5]
    np.testing.assert_allclose(found.poses_world_camera[0, :3, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_array_equal(found.positions_world, [[1, 2, 3]])
    file.write_text(row + ",0" * 9)
    np.testing.assert_array_equal(read_euroc(file).poses_world_camera, found.poses_world_camera)
    write_euroc(file, found)
    numbers = [float(word) for word in file.read_text().splitlines()[1].split(",")]
    np.testing.assert_allclose(numbers, [1.5e9, 1, 2, 3, np.sqrt(0.5), 0, 0, np.sqrt(0.5)])


IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no pose in the file"),
        (f"{IDENTITY}\n1 2 3\n", ":2: 3 columns, expected 12"),
        (IDENTITY.replace("1 0 0 0 0", "1 0 0 inf 0"), ":1: 'inf' is not a finite number"),
        (f"{IDENTITY}\n{IDENTITY.replace('1', '2')}", "pose 2 holds no rotation"),
        (IDENTITY.replace("1", "-1"), "pose 1 holds no rotation"),
    ],
)
def test_broken_kitti_files(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(InputError, match=message):
        read_kitti(tmp_path / "a.txt")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("#only a header\n", "no pose in the file"),
        ("1,0,0,0,1,0,0\n", ":1: 7 columns, expected 8 or 17"),
        ("1,0,0,0,1,0,0,nan\n", ":1: 'nan' is not a finite number"),
        ("1.5,0,0,0,1,0,0,0\n", ":1: '1.5' is no stamp in whole nanoseconds"),
        ("1,0,0,0,0,0,0,0\n", ":1: a zero quaternion"),
        ("1,0,0,0,1,0,0,0\n" * 2, "a stamp is there more than once"),
    ],
)
def test_broken_euroc_files(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        read_euroc(tmp_path / "a.csv")


def test_no_file(tmp_path: Path) -> None:
    for read in (read_kitti, read_euroc):
        with pytest.raises(InputError, match="no such trajectory file"):
            read(tmp_path / "none")


# --- any of the three -----------------------------------------------------------------------------


@pytest.mark.parametrize("start_s", [0.0, 1403636579.75])
def test_the_format_is_recognised(tmp_path: Path, trajectory: Trajectory, start_s: float) -> None:
    moved = Trajectory(start_s + 0.25 * np.arange(50), trajectory.poses_world_camera)
    write_tum(tmp_path / "tum", moved)
    write_euroc(tmp_path / "euroc", moved)
    write_kitti(tmp_path / "kitti", moved.poses_world_camera)
    for name in ("tum", "euroc", "kitti"):
        assert recognise(tmp_path / name) == name
        found = read_trajectory(tmp_path / name, moved.timestamps_s)
        np.testing.assert_array_equal(found.timestamps_s, moved.timestamps_s)
        np.testing.assert_allclose(found.poses_world_camera, moved.poses_world_camera, atol=2e-9)


def test_tum_with_commas_is_not_euroc(tmp_path: Path) -> None:
    file = tmp_path / "a.txt"
    file.write_text("".join(f"{1403636579 + k},{k},0,0,0,0,0,1\n" for k in range(4)))
    assert recognise(file) == "tum"
    assert read_trajectory(file).timestamps_s.tolist() == [1403636579.0 + k for k in range(4)]


def test_kitti_without_stamps_is_rejected_with_the_cure(
    tmp_path: Path, trajectory: Trajectory
) -> None:
    file = tmp_path / "a.txt"
    write_kitti(file, trajectory.poses_world_camera)
    with pytest.raises(InputError, match=r"has no stamps; give them with --times"):
        read_trajectory(file)
    with pytest.raises(InputError, match="50 poses for 49 stamps"):
        read_trajectory(file, trajectory.timestamps_s[1:])


def test_times_are_read_back_or_read_from_tum(tmp_path: Path, trajectory: Trajectory) -> None:
    write_times(tmp_path / "times.txt", trajectory.timestamps_s)
    write_tum(tmp_path / "tum.txt", trajectory)
    for name in ("times.txt", "tum.txt"):
        np.testing.assert_allclose(read_times(tmp_path / name), trajectory.timestamps_s, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no stamp in the file"),
        ("1\nx\n", ":2: 'x' is not a finite number"),
        ("# t\n1\n3\n2\n", ":4: a stamp that is not later"),
        ("1\n1\n", ":2: a stamp that is not later"),
    ],
)
def test_broken_times_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "t").write_text(text)
    with pytest.raises(InputError) as error:
        read_times(tmp_path / "t")
    assert message in str(error.value)
