"""A run folder of a rendered sequence with true keyframe poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bmask_slam.features.brisk import BriskExtractor, FeatureConfig
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.files.array_file import nested
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.run_folder.map_file import write_map
from bmask_slam.sequences.sequence import Sequence
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.map_state import world_state
from bmask_slam.world.world_map import WorldMap

FRAMES = tuple(range(0, 40, 4))


def make_run(
    folder: Path,
    sequence: Sequence,
    broken: dict[int, str] | None = None,
    frames: tuple[int, ...] = FRAMES,
) -> Path:
    """A run folder whose map has a keyframe at the true pose of each of some frames."""
    assert sequence.groundtruth is not None
    truth = sequence.groundtruth.poses_world_camera
    extractor = BriskExtractor(sequence.camera, FeatureConfig(border_px=12))
    world = WorldMap()
    for number, index in enumerate(frames):
        frame = sequence.load(index)
        features = extractor.extract(frame)
        T: Array = inverse(truth[0]) @ truth[index]
        ids = np.full(len(features), -1, np.int64)
        keyframe = Keyframe(number, index, frame.timestamp_s, 0, T, features, ids)
        world.add_keyframe(keyframe)
        problem = (broken or {}).get(number)
        if problem != "no landmarks":
            rows = np.flatnonzero(np.isfinite(features.depth_m))
            points = sequence.camera.backproject(features.pixels[rows], features.depth_m[rows])
            world.make_landmarks(keyframe, rows, transform(T, points))
        if problem == "nan pose":
            keyframe.T_world_camera[0, 3] = np.nan
        if problem == "other image":
            keyframe.timestamp_s += 1.0
    folder.mkdir()
    write_map(folder / "map", nested(mapper=nested(world=world_state(world))), sequence.camera)
    (folder / "config.yaml").write_text(f"# bmask-slam 0, sequence {sequence.folder}, stride 1\n")
    return folder
