"""Images that repeat the one before are left out where a driver or recorder did that."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from bmask_slam.sequences.sequence import Sequence, open_sequence

COUNT = 60
CAMERA = "{width: 64, height: 48, fx: 60, fy: 60, cx: 31, cy: 24, depth_scale: 1000, fps: 30}\n"


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A camera that turns by two pixels a frame before a wall of noise; depth differs in noise."""
    rng = np.random.default_rng(0)
    wall = cv2.GaussianBlur(rng.uniform(0, 255, (48, 300)), (0, 0), 3)
    wall = np.clip(128 + 6 * (wall - 128), 0, 255).astype(np.uint8)
    for kind in ("rgb", "depth"):
        (tmp_path / kind).mkdir()
    for k in range(COUNT):
        view = wall[:, 2 * k : 2 * k + 64]
        cv2.imwrite(f"{tmp_path}/rgb/{k}.png", cv2.cvtColor(view, cv2.COLOR_GRAY2BGR))
        depth = (2000 + rng.normal(0, 9, (48, 64))).astype(np.uint16)
        cv2.imwrite(f"{tmp_path}/depth/{k}.png", depth)
    (tmp_path / "camera.yaml").write_text(CAMERA)
    return tmp_path


def opened(folder: Path, rgb: list[int], depth: list[int]) -> Sequence:
    """The recording with these images, one after the other at 30 Hz."""
    for kind, images in (("rgb", rgb), ("depth", depth)):
        lines = (f"{100 + k / 30:.6f} {kind}/{image}.png\n" for k, image in enumerate(images))
        (folder / f"{kind}.txt").write_text("".join(lines))
    return open_sequence(folder)


def shown(sequence: Sequence) -> list[int]:
    return [int(file.stem) for file in sequence.pairs.rgb_files]


EACH = list(range(COUNT))
TWICE = [k // 2 * 2 for k in EACH]


def test_images_that_were_written_twice_are_used_once(recording: Path) -> None:
    for rgb, depth in ((TWICE, EACH), (EACH, TWICE), (TWICE, TWICE)):
        sequence = opened(recording, rgb, depth)
        assert shown(sequence) == EACH[::2]
        np.testing.assert_allclose(sequence.timestamps_s, 100 + np.arange(0, COUNT, 2) / 30)
        text = sequence.recording.warnings[0]
        assert text.startswith("30 of 60 ") and "repeat the one before" in text


def test_equal_copies_are_repetitions_too(recording: Path) -> None:
    for k in range(0, COUNT, 2):
        (recording / f"rgb/{k + 1}.png").write_bytes((recording / f"rgb/{k}.png").read_bytes())
    assert shown(opened(recording, EACH, EACH)) == EACH[::2]


def test_single_repetitions_and_right_recordings_stay(recording: Path) -> None:
    few = [k - (k % 10 == 5) for k in EACH]
    for rgb in (EACH, few):
        sequence = opened(recording, rgb, EACH)
        assert shown(sequence) == rgb
        assert sequence.recording.warnings == ()
        assert sequence.recording.rgb.copies == (6 if rgb == few else 0)


def test_a_driver_that_hung_is_told_from_a_simulated_camera_at_rest(recording: Path) -> None:
    hung = [20 if 20 <= k < 40 else k for k in EACH]
    sequence = opened(recording, hung, EACH)
    assert shown(sequence) == [*range(21), *range(40, COUNT)]
    (text,) = sequence.recording.warnings
    assert text.startswith("19 colour images behind 100.666667 s") and "driver hung" in text
    rest = [*range(21), *[20] * 19, *range(21, 41)]
    sequence = opened(recording, rest, rest)
    assert shown(sequence) == rest
    assert sequence.recording.warnings == ()


def test_a_hang_until_the_end_is_no_jump(recording: Path) -> None:
    rgb = [*range(40), *[39] * 20]
    assert shown(opened(recording, rgb, EACH)) == rgb


def test_a_lens_that_was_covered_is_no_hang(recording: Path) -> None:
    cv2.imwrite(f"{recording}/rgb/20.png", np.zeros((48, 64, 3), np.uint8))
    rgb = [20 if 20 <= k < 40 else k for k in EACH]
    assert shown(opened(recording, rgb, EACH)) == rgb
