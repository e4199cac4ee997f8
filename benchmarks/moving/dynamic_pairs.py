"""Which keypoints of real pairs of frames move, against masks of the man drawn by hand.

    python -m benchmarks.moving.dynamic_pairs [--data FOLDER] [--segmenter none]

Each pair goes to the system in both orders, as a recording of two frames: the first makes the map,
against which the second is tracked. Counted are the second's keypoints, at the pose that was found.
With a segmenter the first frame's masks are known, as those of a keyframe.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations
from pathlib import Path

import cv2
import numpy as np

from benchmarks.moving.moving_points import Count, Image, Mask, count, picture, strip
from benchmarks.pages import table
from benchmarks.paths import SHARED
from bmask_slam.config.configuration import resolve
from bmask_slam.datasets.weights import find_weights
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.semantics.segmenters.segmenter import Segmenter
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions, make_segmenter
from bmask_slam.sequences.frame import Frame
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig

DATA = SHARED / "dynamic_pairs"
MASKS = Path(__file__).with_suffix(".json")
CAMERA = Camera(
    640, 480, fx=544.258, fy=546.088, cx=326.86, cy=236.121, fps=30.0, stereo_bf_px_m=40.0
)
"""Of the data's README."""


def read_pair(folder: Path) -> list[Frame]:
    """The two frames of a folder, by time."""
    frames = []
    for index, path in enumerate(p for p in sorted(folder.glob("*.png")) if p.stem.count(".") == 1):
        rgb = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
        stored = cv2.imread(str(path.with_suffix(".depth.png")), cv2.IMREAD_UNCHANGED)
        depth_m = np.where(stored > 0, stored / 1000, np.nan).astype(np.float32)
        name = f"{folder.name}/{path.name}"
        frames.append(Frame(index, float(path.stem), np.ascontiguousarray(rgb), depth_m, name))
    return frames


def person_mask(frame: Frame) -> Mask:
    """(H, W) the pixels of the man."""
    polygon = np.array(json.loads(MASKS.read_text())["man"][frame.name])
    mask = np.zeros(frame.depth_m.shape, np.uint8)
    return np.asarray(cv2.fillPoly(mask, [polygon], 1) > 0)


def moving_points(
    pair: Sequence[Frame], config: SystemConfig, segmenter: Segmenter | None = None
) -> tuple[Array, Mask]:
    """Keypoints (N, 2) of the second frame, and which of them were found to move (N,)."""
    system = SlamSystem(CAMERA, config, segmenter)
    system.process(replace(pair[0], index=0, timestamp_s=0.0))
    second = replace(pair[1], index=1, timestamp_s=1 / CAMERA.fps)
    features = system.prepare(second)
    pose = system.process(second, features).T_world_camera
    views = system.moving_objects.keyframe_views.posed(0, system.map)
    static = system.moving_objects.static_features_at(second, features, pose, views)
    return features.image_pixels, static.moving


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--segmenter", default="none")
    parser.add_argument("--weights")
    parser.add_argument("--set", action="append", default=[], metavar="A.B=C")
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    config = resolve(SystemConfig, None, arguments.set)
    options = SegmenterOptions(arguments.segmenter, arguments.weights)
    rows, pictures = [], list[Image]()
    total = {"man": Count(), "rest": Count()}
    for folder in sorted(p for p in arguments.data.iterdir() if p.is_dir()):
        for pair in permutations(read_pair(folder)):
            found = moving_points(
                pair, config, make_segmenter(options, arguments.data, find_weights)
            )
            masks = {"man": person_mask(pair[1])}
            counts = count(*found, masks)
            total = {kind: total[kind] + counts[kind] for kind in total}
            pictures.append(picture(pair[1], found, masks))
            rows.append((f"{folder.name}, {pair[1].name[-10:-4]}", *_cells(counts)))
    rows.append(("all", *_cells(total)))
    print(table(("pair, frame", "of the man moving", "of the rest static"), rows))
    if arguments.picture:
        cv2.imwrite(str(arguments.picture), strip(pictures, 2))


def _cells(counts: dict[str, Count]) -> tuple[str, str]:
    man, rest = counts["man"], counts["rest"]
    return f"{100 * man.share:.1f} % of {man.on}", f"{100 - 100 * rest.share:.1f} % of {rest.on}"


if __name__ == "__main__":
    main()
