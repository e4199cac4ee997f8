"""Summary of a sequence, as ``bmask-slam info SEQUENCE`` prints it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.json_file import format_json
from bmask_slam.graph.trajectory import associate_stamps
from bmask_slam.sequences.sequence import Sequence

GAP_STEPS = 3
DEPTH_PERCENTILES = (5, 50, 95)


@dataclass(frozen=True)
class SequenceInfo:
    """Summary of a sequence.

    Attributes:
        frames: colour/depth pairs.
        fps_hz: from the typical step between stamps; NaN for a single frame.
        gaps: (stamp in seconds, length in seconds) of steps over three times the typical one.
        camera, camera_source: intrinsics and their source.
        depth_valid_share: share of pixels with depth in a few frames spread over the sequence.
        depth_percentiles_m: 5th, 50th and 95th, NaN without depth.
        groundtruth_share: frames with a ground truth pose within 0.02 s; None without any.
        groundtruth_length_m: path length of the ground truth during the sequence.
        unpaired_rgb, unpaired_depth: listed images without a partner.
        broken: frames known to be broken; unreadable images are found only when they are decoded.
    """

    folder: Path
    frames: int
    duration_s: float
    fps_hz: float
    gaps: tuple[tuple[float, float], ...]
    camera: Camera
    camera_source: str
    depth_valid_share: float
    depth_percentiles_m: tuple[float, float, float]
    groundtruth_share: float | None
    groundtruth_length_m: float | None
    unpaired_rgb: int
    unpaired_depth: int
    broken: int


def sequence_info(sequence: Sequence, sample_frames: int = 8) -> SequenceInfo:
    """Measure stamps and ground truth of the whole sequence and the depth of a few frames."""
    stamps_s = sequence.timestamps_s
    step_s = np.diff(stamps_s)
    typical_s = float(np.median(step_s)) if len(step_s) else float("nan")
    gaps = np.flatnonzero(step_s > GAP_STEPS * typical_s)
    valid_share, percentiles_m = depth_statistics(sequence, sample_frames)
    share, length_m = _groundtruth_statistics(sequence)
    return SequenceInfo(
        folder=sequence.folder,
        frames=len(sequence),
        duration_s=float(stamps_s[-1] - stamps_s[0]),
        fps_hz=1 / typical_s,
        gaps=tuple((float(stamps_s[k]), float(step_s[k])) for k in gaps),
        camera=sequence.camera,
        camera_source=sequence.camera_source,
        depth_valid_share=valid_share,
        depth_percentiles_m=percentiles_m,
        groundtruth_share=share,
        groundtruth_length_m=length_m,
        unpaired_rgb=sequence.pairs.unpaired_rgb,
        unpaired_depth=sequence.pairs.unpaired_depth,
        broken=len(sequence.skipped),
    )


def format_info(info: SequenceInfo) -> str:
    """The information as aligned text."""
    c, (low_m, middle_m, high_m) = info.camera, info.depth_percentiles_m
    gaps = f"{len(info.gaps)}"
    if info.gaps:
        start_s, longest_s = max(info.gaps, key=lambda gap: gap[1])
        gaps += f", the longest {longest_s:.2f} s after {start_s:.2f} s"
    truth = "none"
    if info.groundtruth_share is not None:
        share = 100 * info.groundtruth_share
        truth = f"{share:.1f} % of the frames, path of {info.groundtruth_length_m:.2f} m"
    rows = (
        ("sequence", f"{info.folder}"),
        ("frames", f"{info.frames} in {info.duration_s:.2f} s, {_told(info.fps_hz)} Hz"),
        ("gaps", gaps),
        ("unpaired images", f"{info.unpaired_rgb} colour, {info.unpaired_depth} depth"),
        ("broken frames", f"{info.broken}"),
        ("resolution", f"{c.width}x{c.height}"),
        ("intrinsics (px)", f"fx {c.fx:g}  fy {c.fy:g}  cx {c.cx:g}  cy {c.cy:g}"),
        ("distortion", " ".join(f"{k:g}" for k in c.distortion)),
        ("camera from", info.camera_source),
        ("rolling shutter", f"{1e3 * c.rolling_shutter_s:g} ms"),
        ("depth delay", f"{1e3 * c.depth_time_offset_s:g} ms"),
        ("depth distortion", " ".join(f"{k:g}" for k in c.depth_distortion)),
        ("depth scale", f"{c.depth_scale:g} to the metre"),
        ("valid depth", f"{100 * info.depth_valid_share:.1f} % of the pixels"),
        ("depth (m)", f"5 % {_told(low_m)}, median {_told(middle_m)}, 95 % {_told(high_m)}"),
        ("ground truth", truth),
    )
    return "\n".join(f"{name:<16} {value}" for name, value in rows)


def _told(value: float) -> str:
    """A number with two decimals, or that it is not known."""
    return "unknown" if math.isnan(value) else f"{value:.2f}"


def info_as_json(info: SequenceInfo) -> str:
    """The information as JSON, by the names of `SequenceInfo`; null for what is not known."""
    return format_json(info)


def depth_statistics(sequence: Sequence, count: int) -> tuple[float, tuple[float, float, float]]:
    """Share of valid pixels and depth percentiles in metres over a few readable frames, or NaN."""
    depths_m = []
    for index in np.unique(np.linspace(0, len(sequence) - 1, count, dtype=int)):
        try:
            depths_m.append(sequence.load(int(index)).depth_m)
        except InputError:
            continue
    values_m = np.stack(depths_m) if depths_m else np.zeros(0)
    valid_m: Array = values_m[np.isfinite(values_m)].astype(float)
    if not len(valid_m):
        return 0.0, (np.nan, np.nan, np.nan)
    low, middle, high = np.percentile(valid_m, DEPTH_PERCENTILES)
    return len(valid_m) / values_m.size, (float(low), float(middle), float(high))


def _groundtruth_statistics(sequence: Sequence) -> tuple[float | None, float | None]:
    """Share of frames with a ground truth pose, and the path length in metres in that time."""
    truth, stamps_s = sequence.groundtruth, sequence.timestamps_s
    if truth is None:
        return None, None
    share = len(associate_stamps(stamps_s, truth.timestamps_s)[0]) / len(sequence)
    during = (truth.timestamps_s >= stamps_s[0]) & (truth.timestamps_s <= stamps_s[-1])
    steps_m = np.linalg.norm(np.diff(truth.positions_world[during], axis=0), axis=1)
    return share, float(steps_m.sum())
