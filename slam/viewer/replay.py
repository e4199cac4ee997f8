"""A finished run in the viewer: its map at once, its frames over time."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from bmask_slam.graph.arrays import Array, Arrays, Bytes
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.graph_update import RelativePose
from bmask_slam.graph.files.ply import read_ply
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.run_folder.frame_file import STAGES
from bmask_slam.run_folder.map_file import SavedRun, read_run
from bmask_slam.run_folder.semantic_files import OBJECTS, read_objects
from bmask_slam.semantics.instances.overlay import class_colour
from bmask_slam.tracking.results import FrameResult, TrackingStatus
from bmask_slam.viewer.scene import Box, Scene

MAX_DENSE_POINTS = 300_000
MAX_STAMP_ERROR_S = 1e-5


def replay(path: Path, scene: Scene) -> int:
    """Show a run folder; the number of its frames.

    Raises:
        InputError: a file of it is missing or broken.
    """
    run = read_run(path)
    scene.camera(run.camera)
    trajectory = run.trajectories["trajectory.txt"]
    scene.at(float(trajectory.timestamps_s[0]) if len(trajectory) else 0.0)
    _show_map(run, scene)
    frames = _frames(path / "frames.csv", trajectory)
    for frame in frames:
        scene.frame(frame)
    scene.line("world/trajectory", trajectory.positions_world, (80, 170, 255))
    return len(frames)


def _show_map(run: SavedRun, scene: Scene) -> None:
    landmarks = run.landmarks
    points = _xyz(landmarks)
    scene.points("world/landmarks", points, landmark_colours(landmarks), 0.008)
    keyframes = run.keyframes.positions_world
    scene.points("world/keyframes", keyframes, np.full((len(keyframes), 3), 200, np.uint8), 0.02)
    scene.pairs("world/loops", _loops(run), (255, 120, 0))
    if (run.path / OBJECTS).is_file():
        names, objects = read_objects(run.path)
        number = {name: k for k, name in enumerate(names)}
        scene.boxes(
            [
                Box(
                    o.box,
                    f"{o.label} {o.probability:.2f}",
                    class_colour(number.get(o.label, 0)).astype(np.uint8),
                )
                for o in objects
            ]
        )
    dense = run.path / "dense" / "cloud.ply"
    if dense.is_file():
        cloud = read_ply(dense)
        step = max(len(cloud["x"]) // MAX_DENSE_POINTS, 1)
        some = {name: column[::step] for name, column in cloud.items()}
        scene.points("world/dense", _xyz(some), _rgb(some), 0.006)


def landmark_colours(landmarks: Arrays) -> Bytes:
    """Colours (N, 3): of the class, where there is one, else of the landmark itself."""
    colours = _rgb(landmarks)
    labels = landmarks.get("label")
    if labels is None:
        return colours
    for label in np.unique(labels[labels > 0]).tolist():
        colours[labels == label] = class_colour(label).astype(np.uint8)
    return colours


def _loops(run: SavedRun) -> Array:
    """Positions (N, 2, 3) of the ends of the loops in the graph."""
    graph = run.tables
    position = dict(
        zip(graph.keyframes.ids.tolist(), graph.keyframes.values[:, :3, 3], strict=True)
    )
    factors = (entry.factor for entry in graph.pose_factors.values())
    ends = [
        (position[f.keyframe_a], position[f.keyframe_b])
        for f in factors
        if isinstance(f, RelativePose) and f.kind == "loop"
    ]
    return np.array(ends, float).reshape(-1, 2, 3)


def _frames(path: Path, trajectory: Trajectory) -> list[FrameResult]:
    """The lines of frames.csv, with the final poses."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    found = []
    for row in rows:
        try:
            stamp_s = float(row["timestamp"])
            near = int(np.searchsorted(trajectory.timestamps_s + MAX_STAMP_ERROR_S, stamp_s))
            known = near < len(trajectory)
            known = known and abs(trajectory.timestamps_s[near] - stamp_s) < MAX_STAMP_ERROR_S
            found.append(
                FrameResult(
                    int(row["index"]),
                    stamp_s,
                    TrackingStatus(row["status"]),
                    trajectory.poses_world_camera[near] if known else None,
                    matches=int(row["matches"]),
                    inliers=int(row["inliers"]),
                    ignored=int(row["ignored"]),
                    stage_ms={s: float(row[f"{s}_ms"]) for s in STAGES if row[f"{s}_ms"]},
                )
            )
        except (KeyError, ValueError) as error:
            raise InputError(f"{path}: line {len(found) + 2}: {error}; run again") from error
    return found


def _xyz(columns: Arrays) -> Array:
    return np.stack([columns[name] for name in "xyz"], axis=1).astype(float)


def _rgb(columns: Arrays) -> Bytes:
    return np.stack([columns[name] for name in ("red", "green", "blue")], axis=1)
