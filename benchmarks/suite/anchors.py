"""Figures of other systems, to set ours beside. None of them is measured by this benchmark.

KITCHEN: measured for this project on two cores without a GPU, on the same 600 frames and with the
same calibration, by the people who set the task; ORB-SLAM2 is ten runs, no loop closed.
PUBLISHED_ATE_CM: what is known of the trajectory files that the evaluation is checked with.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Anchor:
    """A system on the red kitchen's 600 frames; times are the median and 95 % of a frame."""

    system: str
    ate_cm: str
    frame_ms: str
    frame_p95_ms: str
    peak_mb: str


KITCHEN = (
    Anchor("ORB-SLAM2 RGB-D (C++, 10 runs)", "4.66-4.84", "14-16", "19-24", "480"),
    Anchor("Open3D hybrid odometry, frame to frame", "3.15", "42", "61", "240"),
    Anchor("Open3D dense SLAM (model tracking)", "3.36", "164", "244", "2120"),
    Anchor("OpenCV RgbdOdometry, frame to frame", "4.04", "20", "27", "72"),
    Anchor("OpenCV RgbdICP", "3.97", "50", "", "96"),
)

PUBLISHED_ATE_CM = {
    "freiburg1_xyz-rgbdslam.txt": "1.34 (Mur-Artal et al. 2015, Table III); file: 1.35",
    "fr2_desk_ORB.txt": "0.88 (ORB-SLAM, keyframes, Sim(3)); file: 0.81",
}
