"""A real person composited into another real recording.

    python -m benchmarks.moving.composited [--frames 150] [--out runs/composited]

The person of the shared data's dynamic_pairs, with colour and depth, moves to and fro before the
camera of the red kitchen along a path in the kitchen's world, with mutual occlusion; the lower edge
stays at that of the image. The original and the composited recording are run without filter and
with geometry; the composited one also with masks, by ``--segmenter``.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from scipy.interpolate import CubicSpline

from benchmarks.moving.dynamic_pairs import CAMERA as PERSON_CAMERA
from benchmarks.moving.dynamic_pairs import DATA as PAIRS
from benchmarks.moving.dynamic_pairs import person_mask, read_pair
from benchmarks.pages import table
from benchmarks.paths import KITCHEN
from bmask_slam.config.configuration import resolve
from bmask_slam.graph.arrays import Array, Mask
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.graph.trajectory import read_tum
from bmask_slam.offline.runner import RunOptions, run
from bmask_slam.rendering.annotations import VisibleInstance, coco, visible_instances
from bmask_slam.rendering.writer import new_folder, stored_depth, write_json, write_lists, write_png
from bmask_slam.sequences.cameras import write_camera
from bmask_slam.sequences.frame import Frame
from bmask_slam.sequences.sequence import open_sequence
from bmask_slam.system_config import SystemConfig

LEG_S = 1.5
"""Time from one side of the picture to the other."""
SIDE_M, AHEAD_M = 0.55, 1.15


def walk(poses: Array, stamps_s: Array) -> Array:
    """Positions (F, 3) of the person in the world, left and right of the axis in turn."""
    knots_s = np.arange(stamps_s[0], stamps_s[-1] + LEG_S, LEG_S)
    at = np.searchsorted(stamps_s, knots_s).clip(max=len(stamps_s) - 1)
    side_m = SIDE_M * np.where(np.arange(len(at)) % 2, 1.0, -1.0)
    before = np.stack([side_m, np.zeros(len(at)), np.full(len(at), AHEAD_M)], axis=1)
    places = np.array([transform(poses[i], p[None])[0] for i, p in zip(at, before, strict=True)])
    return np.asarray(CubicSpline(knots_s, places)(stamps_s))


def composed(
    frame: Frame, person: Frame, place_camera: Array, focal_px: tuple[float, float]
) -> Frame:
    """A frame with the person at a place (3,) in its camera's frame.

    Args:
        frame: of the recording.
        person: a frame of the pairs; the pixels of its mask are used.
        place_camera: the person's centre.
        focal_px: focal length and centre column of the recording's camera.
    """
    mask = cv2.erode(person_mask(person).astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    middle_m = float(np.nanmedian(person.depth_m[mask]))
    scale = focal_px[0] / PERSON_CAMERA.fx * middle_m / place_camera[2]
    columns = np.flatnonzero(mask.any(axis=0))
    u = focal_px[0] * place_camera[0] / place_camera[2] + focal_px[1]
    height, width = frame.depth_m.shape
    shift = u - scale * columns.mean(), height - 1 - scale * (mask.shape[0] - 1)
    M = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
    size = (width, height)
    covered = cv2.warpAffine(mask.astype(np.uint8), M, size, flags=cv2.INTER_NEAREST) > 0
    rgb = cv2.warpAffine(person.rgb, M, size, flags=cv2.INTER_AREA)
    filled = np.nan_to_num(person.depth_m)
    depth_m = cv2.warpAffine(filled, M, size, flags=cv2.INTER_NEAREST)
    depth_m = np.where(depth_m > 0, depth_m - middle_m + place_camera[2], np.nan)
    covered &= ~(frame.depth_m < np.where(np.isnan(depth_m), place_camera[2], depth_m))
    return Frame(
        frame.index,
        frame.timestamp_s,
        np.where(covered[..., None], rgb, frame.rgb),
        np.where(covered, depth_m, frame.depth_m).astype(np.float32),
    )


def make(folder: Path, frames: int) -> None:
    """Write the recording with the person in TUM layout, with true masks."""
    kitchen = open_sequence(KITCHEN)
    truth = read_tum(KITCHEN / "groundtruth.txt")
    poses = truth.poses_world_camera[:frames]
    stamps_s = truth.timestamps_s[:frames]
    places = walk(poses, stamps_s)
    people = [read_pair(PAIRS / "test1")[0], read_pair(PAIRS / "test2")[0]]
    camera, marks = kitchen.camera, list[list[VisibleInstance]]()
    stamps = [f"{t:.6f}" for t in stamps_s]
    for i in range(frames):
        frame = kitchen.load(i)
        place = transform(inverse(poses[i]), places[i : i + 1])[0]
        person = people[int(stamps_s[i] / LEG_S) % 2]
        focal_px = camera.fx, camera.cx
        new = composed(frame, person, place, focal_px) if place[2] > 0.5 else frame
        changed: Mask = (new.rgb != frame.rgb).any(axis=2)
        changed |= ~np.isclose(new.depth_m, frame.depth_m, equal_nan=True)
        instances = changed.astype(np.uint16)
        name = f"{stamps[i]}.png"
        write_png(folder / "rgb" / name, np.ascontiguousarray(new.rgb))
        write_png(folder / "depth" / name, stored_depth(new.depth_m, camera.depth_scale))
        write_png(folder / "instances" / name, instances)
        marks.append(visible_instances(instances))
    write_lists(folder, stamps, poses)
    write_camera(folder / "camera.yaml", camera)
    scene: Any = SimpleNamespace(categories=("person",))
    write_json(folder / "annotations.json", coco(marks, stamps, camera, scene))


def ate_mm(sequence: Path, frames: int, out: Path, settings: list[str], segmenter: str) -> float:
    """ATE of a run."""
    config = resolve(SystemConfig, None, [*settings, f"semantics.segmenter.name={segmenter}"])
    options = RunOptions(sequence, config, out=out, overwrite=True, max_frames=frames, quiet=True)
    return next(1e3 * r["value"] for r in run(options).rows if r["name"] == "ate_rmse")


def main() -> None:
    """Parse, make, run, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--segmenter", default="truth", choices=["truth", "light"])
    parser.add_argument("--out", type=Path, default=Path("runs/composited"))
    arguments = parser.parse_args()
    folder = arguments.out / f"sequence-{arguments.frames}"
    if not folder.is_dir():
        with new_folder(folder) as temporary:
            make(temporary, arguments.frames)
    nothing, geometry = "moving_objects.geometry=false", "moving_objects.geometry=true"
    variants = {
        "without person, nothing": (KITCHEN, nothing, "none"),
        "without person, geometry": (KITCHEN, geometry, "none"),
        "with person, nothing": (folder, nothing, "none"),
        "with person, geometry": (folder, geometry, "none"),
        f"with person, geometry and masks ({arguments.segmenter})":
            (folder, geometry, arguments.segmenter),
    }  # fmt: skip
    rows = []
    for name, (sequence, setting, segmenter) in variants.items():
        out = arguments.out / name.replace(" ", "-").replace(",", "")
        rows.append((name, ate_mm(sequence, arguments.frames, out, [setting], segmenter)))
    clean_mm = rows[0][1]
    print(
        table(("", "ATE mm", "x clean"), [(n, f"{v:.1f}", f"{v / clean_mm:.2f}") for n, v in rows])
    )


if __name__ == "__main__":
    main()
