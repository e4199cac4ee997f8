"""What a sequence yields."""

from __future__ import annotations

from dataclasses import dataclass

from bmask_slam.graph.arrays import Floats, Image


@dataclass(frozen=True)
class Frame:
    """One registered RGB-D frame.

    Attributes:
        index: position in the sequence, from 0, counting skipped and broken frames too.
        timestamp_s: stamp of the colour image in seconds.
        rgb: (H, W, 3) uint8, red first.
        depth_m: (H, W) float32 z-depth in metres, NaN where missing.
        name: file name of the colour image relative to its sequence, for looking up its masks.
    """

    index: int
    timestamp_s: float
    rgb: Image
    depth_m: Floats
    name: str = ""
