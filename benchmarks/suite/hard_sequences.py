"""Hard inputs from recorded and rendered sequences: faster, blurred, dark, with a robot in view.

They are written as folders in TUM layout.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from bmask_slam.graph.arrays import Array, Floats, Image
from bmask_slam.graph.geometry import inverse
from bmask_slam.graph.trajectory import Trajectory, associate_stamps, write_tum
from bmask_slam.rendering.engine.sensor import blur, optical_flow
from bmask_slam.rendering.writer import new_folder, stored_depth, write_png
from bmask_slam.sequences.cameras import write_camera
from bmask_slam.sequences.frame import Frame
from bmask_slam.sequences.sequence import Sequence, open_sequence

BURST, PAUSE = 12, 18
"""Numbers of consecutive frames that are blurred by a box, and that are not."""
DARK_NOISE = 3.0


@dataclass(frozen=True)
class Hardship:
    """Changes of a sequence.

    Attributes:
        stride: every n-th frame is kept.
        max_frames: of those that are kept.
        shutter: blur along the image motion, as a share of the motion to the next kept frame.
        box_px: side of a box that blurs BURST frames in every BURST + PAUSE.
        light: share of the light that there was, with noise of DARK_NOISE grey levels.
        body: share of the image's height, from below, that a patterned body on the camera fills.
        depth_noise: standard deviation of noise in depth, over its square, in 1/m.
        fps: frame rate [Hz] that the kept frames get, so that the camera moves faster.
    """

    stride: int = 1
    max_frames: int | None = None
    shutter: float = 0.0
    box_px: int = 0
    light: float = 1.0
    body: float = 0.0
    depth_noise: float = 0.0
    fps: float | None = None


def make_hard(source: Path, hardship: Hardship, out: Path) -> Path:
    """Write a hard version of a sequence to a folder, unless it exists; returns the folder."""
    if out.is_dir():
        return out
    sequence = open_sequence(source)
    kept = list(range(0, len(sequence), hardship.stride))[: hardship.max_frames]
    stamps_s = sequence.timestamps_s[kept]
    camera = sequence.camera
    if hardship.fps:
        stamps_s = stamps_s[0] + np.arange(len(kept)) / hardship.fps
        camera = replace(camera, fps=hardship.fps)
    names = [f"{stamp:.6f}.png" for stamp in stamps_s]
    with new_folder(out) as folder:
        for name, frame in zip(names, _disturbed(sequence, kept, hardship), strict=True):
            write_png(folder / "rgb" / name, frame.rgb)
            depth = stored_depth(frame.depth_m, camera.depth_scale)
            write_png(folder / "depth" / name, depth)
        for kind in ("rgb", "depth"):
            lines = [f"{name.removesuffix('.png')} {kind}/{name}\n" for name in names]
            (folder / f"{kind}.txt").write_text("".join(lines), encoding="utf-8")
        write_camera(folder / "camera.yaml", camera)
        truth = sequence.groundtruth
        if truth is not None:
            there, here = associate_stamps(sequence.timestamps_s[kept], truth.timestamps_s)
            poses = truth.poses_world_camera[here]
            write_tum(folder / "groundtruth.txt", Trajectory(stamps_s[there], poses))
    return out


def _disturbed(sequence: Sequence, kept: list[int], hardship: Hardship) -> Iterator[Frame]:
    """The kept frames with blur, in less light, with a body and noise."""
    for k, index in enumerate(kept):
        frame = sequence.load(index)
        if hardship.box_px and k % (BURST + PAUSE) >= PAUSE:
            side = (hardship.box_px, hardship.box_px)
            frame = replace(frame, rgb=cv2.blur(frame.rgb, side))
        if hardship.shutter:
            other = kept[k + 1] if k + 1 < len(kept) else kept[k - 1]
            flow = _flow(sequence, frame, other) * np.float32(1 if other > index else -1)
            blurred = blur(frame.rgb.astype(np.float32), hardship.shutter * flow)
            frame = replace(frame, rgb=np.rint(blurred).astype(np.uint8))
        if hardship.light < 1:
            noise = np.random.default_rng(k).normal(0, DARK_NOISE, frame.rgb.shape)
            dark = np.clip(np.rint(hardship.light * frame.rgb + noise), 0, 255)
            frame = replace(frame, rgb=dark.astype(np.uint8))
        if hardship.body:
            rgb = frame.rgb.copy()
            visible = rgb[round((1 - hardship.body) * len(rgb)) :]
            visible[:] = np.random.default_rng(1).integers(0, 255, visible.shape)
            frame = replace(frame, rgb=rgb)
        if hardship.depth_noise:
            noise = np.random.default_rng(k).normal(0, hardship.depth_noise, frame.depth_m.shape)
            depth_m = frame.depth_m + noise * frame.depth_m**2
            frame = replace(frame, depth_m=depth_m.astype(np.float32))
        yield frame


def _flow(sequence: Sequence, frame: Frame, other: int) -> Floats:
    """The image motion (H, W, 2) in px from a frame to another one.

    By depth and true poses of a rendered sequence, else by dense optical flow (DIS, OpenCV).
    """
    if (sequence.folder / "annotations.json").is_file() and sequence.groundtruth is not None:
        poses = _poses(sequence, [frame.index, other])
        return optical_flow(frame.depth_m, sequence.camera, inverse(poses[1]) @ poses[0])
    dis = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    return dis.calc(_gray(frame.rgb), _gray(sequence.load(other).rgb), None)


def _poses(sequence: Sequence, indices: list[int]) -> Array:
    truth = sequence.groundtruth
    assert truth is not None
    _, rows = associate_stamps(sequence.timestamps_s[sorted(indices)], truth.timestamps_s)
    return truth.poses_world_camera[rows][np.argsort(np.argsort(indices))]


def _gray(rgb: Image) -> Image:
    return cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
