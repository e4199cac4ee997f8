"""A real crowd: people who walk into the image do not take the camera along."""

from pathlib import Path

import pytest
from repository import shared

import bmask_slam


@pytest.mark.parametrize("bucket_px", [40, 44])
def test_a_crowd_is_left_out_by_depth_and_motion_alone(tmp_path: Path, bucket_px: int) -> None:
    """No masks. In frame 160 a man walks in from the right, where nothing was seen before.

    With either spread of keypoints he took the camera with him: 0.15 m.
    """
    found = bmask_slam.run(
        shared("bonn_crowd"),
        tmp_path / "run",
        segmenter="none",
        calibrate="off",
        max_frames=200,
        quiet=True,
        settings={"features.bucket_px": bucket_px},
    )
    metrics = found.metrics
    assert metrics["tracked_share"].value == 1.0
    assert metrics["ate_rmse"].value < 0.015
