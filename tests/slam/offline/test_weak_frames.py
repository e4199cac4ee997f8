"""A run that tracked weakly says so, with what most of its frames lack."""

from pathlib import Path

import pytest

from bmask_slam.offline.weak_frames import CONTRADICTED, FEW, UNCERTAIN, weakly_tracked

HEAD = "index,timestamp,status,segment,matches,inliers,keyframe\n"


def told(path: Path, weak: int, matches: int, inliers: int) -> str:
    """What is said of forty frames, some of them WEAK with so many matches and inliers."""
    kinds = [f"WEAK,0,{matches},{inliers}"] * weak + ["OK,0,300,200"] * (40 - weak)
    rows = (f"{k},{k / 30:.6f},{kind},\n" for k, kind in enumerate(kinds))
    (path / "frames.csv").write_text(HEAD + "".join(rows))
    return "".join(weakly_tracked(path / "frames.csv", 30))


@pytest.mark.parametrize(
    ("matches", "inliers", "reason"),
    [(200, 90, CONTRADICTED), (30, 20, FEW), (200, 150, UNCERTAIN)],
)
def test_many_weak_frames_are_said_with_the_reason(
    tmp_path: Path, matches: int, inliers: int, reason: str
) -> None:
    text = told(tmp_path, 20, matches, inliers)
    assert text.startswith("tracking: 20 of 40 frames are WEAK")
    assert f"in 20 of them {reason}: " in text


def test_a_run_without_a_pose_says_what_it_needs(tmp_path: Path) -> None:
    rows = (f"{k},{k / 30:.6f},LOST,0,0,0,\n" for k in range(40))
    (tmp_path / "frames.csv").write_text(HEAD + "".join(rows))
    (text,) = weakly_tracked(tmp_path / "frames.csv", 30)
    assert "no frame has a pose; a map begins where enough corners have depth" in text


def test_frames_that_are_not_in_the_map_are_said_to_be_so(tmp_path: Path) -> None:
    rows = (f"{k},{k / 30:.6f},LOST,0,0,0,\n" for k in range(40))
    (tmp_path / "frames.csv").write_text(HEAD + "".join(rows))
    (text,) = weakly_tracked(tmp_path / "frames.csv", 30, in_map=True)
    assert "no frame was recognised in the map; give the map of this place" in text
    assert "depth" not in text


def test_some_weak_frames_are_as_usual(tmp_path: Path) -> None:
    assert told(tmp_path, 9, 200, 90) == ""
    assert told(tmp_path, 0, 0, 0) == ""
