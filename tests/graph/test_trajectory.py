"""TUM files and association by time."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from repository import SHARED

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.graph.trajectory import Trajectory, associate, associate_stamps, read_tum, write_tum

TRAJECTORIES = SHARED / "trajectories"

stamps = st.lists(
    st.integers(0, 400).map(lambda k: k / 100), min_size=0, max_size=25, unique=True
).map(lambda values: np.sort(np.array(values, float)))


def random_trajectory(count: int = 20, seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    return Trajectory(1.3e9 + np.arange(count) / 30, se3_exp(rng.normal(size=(count, 6))))


def greedy_association(a_s, b_s, limit_s):
    """A simple reference: all pairs, the closest first, each stamp once; returns the stamps."""
    pairs = sorted((abs(a - b), a, b) for a in a_s for b in b_s if abs(a - b) <= limit_s)
    used_a, used_b = set(), set()
    for _, a, b in pairs:
        if a not in used_a and b not in used_b:
            used_a.add(a)
            used_b.add(b)
    return sorted(used_a), sorted(used_b)


def test_stamps_are_sorted_and_repeated_ones_rejected():
    t = random_trajectory(5)
    shuffled = Trajectory(t.timestamps_s[::-1], t.poses_world_camera[::-1])
    np.testing.assert_array_equal(shuffled.timestamps_s, t.timestamps_s)
    np.testing.assert_array_equal(shuffled.poses_world_camera, t.poses_world_camera)
    with pytest.raises(ValueError, match="repeated"):
        Trajectory([1.0, 1.0], np.stack([np.eye(4)] * 2))
    with pytest.raises(ValueError, match="finite"):
        Trajectory([np.nan], np.eye(4)[None])
    with pytest.raises(ValueError, match="2 timestamps"):
        Trajectory([1.0, 2.0], np.eye(4)[None])


def test_round_trip_and_bytes(tmp_path):
    t = random_trajectory()
    write_tum(tmp_path / "a.txt", t)
    back = read_tum(tmp_path / "a.txt")
    np.testing.assert_allclose(back.timestamps_s, t.timestamps_s, atol=1e-6)
    np.testing.assert_allclose(back.poses_world_camera, t.poses_world_camera, atol=1e-8)
    write_tum(tmp_path / "b.txt", back)
    assert (tmp_path / "a.txt").read_bytes() == (tmp_path / "b.txt").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.txt", "b.txt"]


def test_written_numbers(tmp_path):
    """A quarter turn about z, one metre along x: the numbers of the format, sign and order."""
    pose = se3_exp([0, 0, np.pi / 2, 0, 0, 0])
    pose[:3, 3] = [1, -0.0, -2]
    write_tum(tmp_path / "t.txt", Trajectory([12.3456789], pose[None]))
    header, line = (tmp_path / "t.txt").read_text().splitlines()
    assert header.startswith("#")
    half = "0.707106781"
    assert line == (
        f"12.345679 1.000000000 0.000000000 -2.000000000 0.000000000 0.000000000 {half} {half}"
    )


def test_reads_any_order_with_comments(tmp_path):
    path = tmp_path / "t.txt"
    path.write_text(
        "\ufeff# a comment\n2.0 5 6 7 0 0 0 2\n\n  # another\n1.0,1,2,3,1,0,0,0\n", encoding="utf-8"
    )
    t = read_tum(path)
    np.testing.assert_array_equal(t.timestamps_s, [1, 2])
    np.testing.assert_array_equal(t.positions_world, [[1, 2, 3], [5, 6, 7]])
    np.testing.assert_allclose(t.poses_world_camera[0, :3, :3], np.diag([1, -1, -1]), atol=1e-15)
    np.testing.assert_allclose(t.poses_world_camera[1, :3, :3], np.eye(3), atol=1e-15)


def test_keeps_the_first_of_equal_stamps(tmp_path, caplog):
    path = tmp_path / "t.txt"
    path.write_text("1 7 0 0 0 0 0 1\n1 8 0 0 0 0 0 1\n0 1 0 0 0 0 0 1\n")
    np.testing.assert_array_equal(read_tum(path).positions_world[:, 0], [1, 7])
    assert "1 repeated" in caplog.text


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["no pose"]),
        ("# only a comment\n", ["no pose"]),
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 1\n", [":2:", "7 columns", "expected 8"]),
        ("1 0 0 0 0 0 0 1 0 0 0 0\n", [":1:", "KITTI"]),
        ("1 0 0 nan 0 0 0 1\n", [":1:", "'nan'", "finite"]),
        ("inf 0 0 0 0 0 0 1\n", [":1:", "'inf'"]),
        ("1 0 0 abc 0 0 0 1\n", [":1:", "'abc'"]),
        ("# c\n1 0 0 0 0 0 0 0\n", [":2:", "zero quaternion"]),
        ("".join(f"{1000 * k / 30} 0 0 0 0 0 0 1\n" for k in range(9)), ["milliseconds", "1000"]),
        ("".join(f"{k * 33000000} 0 0 0 0 0 0 1\n" for k in range(9)), ["nanoseconds", "1e9"]),
    ],
)
def test_bad_files(tmp_path, text, words):
    path = tmp_path / "t.txt"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_tum(path)
    for word in [str(path), *words]:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_file(tmp_path):
    with pytest.raises(InputError, match="no such trajectory"):
        read_tum(tmp_path / "none.txt")


@given(stamps, stamps, st.sampled_from([0.0, 0.02, 0.3, 10.0]))
@settings(max_examples=150, deadline=None)
def test_association_is_greedy(a_s, b_s, limit_s):
    i, j = associate_stamps(a_s, b_s, limit_s)
    assert (np.diff(i) > 0).all()
    assert (np.diff(j) > 0).all()
    assert (np.abs(a_s[i] - b_s[j]) <= limit_s).all()
    expected_a, expected_b = greedy_association(a_s, b_s, limit_s)
    np.testing.assert_array_equal(a_s[i], expected_a)
    np.testing.assert_array_equal(b_s[j], expected_b)


def test_pairs_do_not_cross():
    """The greedy pairs 3-4 and 6-1 cross: they are exchanged."""
    i, j = associate_stamps(np.array([3.0, 6.0]), np.array([1.0, 4.0]), 5.0)
    assert (i.tolist(), j.tolist()) == ([0, 1], [0, 1])


@given(stamps, stamps)
@settings(max_examples=60, deadline=None)
def test_association_is_symmetric_without_ties(a_s, b_s):
    b_s = b_s + 0.003  # multiples of 0.01 on one side: no distance occurs twice around a stamp
    i, j = associate_stamps(a_s, b_s, 0.5)
    j2, i2 = associate_stamps(b_s, a_s, 0.5)
    assert set(zip(i, j, strict=True)) == set(zip(i2, j2, strict=True))


def test_associate_takes_the_nearest_within_the_limit():
    reference = random_trajectory(20)
    estimate = Trajectory(reference.timestamps_s[[3, 8, 12]] + [0.004, -0.015, 0.0],
                          reference.poses_world_camera[[3, 8, 12]])  # fmt: skip
    e, r = associate(estimate, reference)
    np.testing.assert_array_equal(e.poses_world_camera, r.poses_world_camera)
    e, r = associate(estimate, reference, max_difference_s=0.01)
    assert len(e) == len(r) == 2


@pytest.mark.skipif(not TRAJECTORIES.is_dir(), reason="no ../shared/data/trajectories here")
def test_tum_files():
    truth = read_tum(TRAJECTORIES / "freiburg1_xyz-groundtruth.txt")
    estimate = read_tum(TRAJECTORIES / "freiburg1_xyz-rgbdslam.txt")
    e, r = associate(estimate, truth)
    assert (len(truth), len(estimate), len(e)) == (3000, 788, 786)
    assert np.abs(e.timestamps_s - r.timestamps_s).max() < 0.02
