"""A finished run in the viewer: its map at once, its frames over time."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bmask_slam.events import EVENTS, Event, read_events
from bmask_slam.graph.arrays import Array, Arrays, Bytes
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_update import RelativePose
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.files.ply import POINTS, read_ply
from bmask_slam.graph.trajectory import (
    MAX_STAMP_ERROR_S,
    Trajectory,
    nearest_indices,
    read_tum,
)
from bmask_slam.run_folder.folder import trajectory_files
from bmask_slam.run_folder.frame_file import FRAMES, FrameTable, read_frames
from bmask_slam.run_folder.landmark_file import LANDMARKS
from bmask_slam.run_folder.map_file import SavedRun, check_finished, read_run
from bmask_slam.run_folder.origin import find_sequence
from bmask_slam.run_folder.reader import Run
from bmask_slam.run_folder.semantic_files import OBJECTS, read_objects
from bmask_slam.semantics.instances.overlay import class_colour
from bmask_slam.sequences.sequence import open_sequence
from bmask_slam.tracking.results import FrameResult, TrackingStatus
from bmask_slam.viewer.replay_pictures import ReplayPictures
from bmask_slam.viewer.scene import PATH_COLOUR, Scene
from bmask_slam.viewer.shown import Box, Ellipsoid

logger = logging.getLogger(__name__)

MAX_DENSE_POINTS = 300_000
GRAPH, ENOUGH = "graph", (FRAMES, LANDMARKS, "trajectory.txt")
"""What a run is shown by that has no graph."""


@dataclass(frozen=True)
class ReplayOptions:
    """How a finished run is shown.

    Attributes:
        sequence: its images; None: where they were.
        images: whether they are shown, and masks of keyframes with them.
        paced: at the rate of the stamps, for a viewer that is connected.
    """

    sequence: Path | None = None
    images: bool = True
    paced: bool = False


def replay(path: Path, scene: Scene, options: ReplayOptions | None = None) -> int:
    """Show a run folder; returns the number of its frames.

    Raises:
        InputError: a file of it is missing or broken.
    """
    options = options or ReplayOptions()
    run = read_shown(path, options.sequence)
    scene.log_camera(run.camera)
    trajectory = run.trajectories["trajectory.txt"]
    table = read_frames(path / FRAMES)
    scene.set_time(float(trajectory.timestamps_s[0]) if len(trajectory) else 0.0)
    told = path, options.sequence, table, run.camera
    pictures = ReplayPictures(*told) if options.images else None
    scene.log_names(pictures.names if pictures else ())
    _show_map(run, scene)
    try:
        frames = _frame_results(table, trajectory, _events(path))
    except ValueError as error:
        raise InputError(f"{path / FRAMES}: {error}; run again") from error
    uncertain = _show_uncertainty(path, scene) if len(run.tables) else {}
    began_s = time.monotonic()
    for line, frame in enumerate(frames):
        if options.paced:
            due_s = began_s + frame.timestamp_s - frames[0].timestamp_s
            time.sleep(max(due_s - time.monotonic(), 0.0))
        scene.log_frame(frame)
        covariance = uncertain.get(int(table.keyframe_ids[line]))
        if covariance is not None:
            scene.log_uncertainty(covariance)
        if pictures is not None:
            pictures.show(line, frame.timestamp_s, scene)
    scene.log_line("world/trajectory", trajectory.positions_world, PATH_COLOUR)
    return len(frames)


def read_shown(path: Path, sequence: Path | None) -> SavedRun:
    """A run to be shown; one without a graph, as after --localise, has its poses and landmarks.

    Their camera is that of its recording, which may be in ``sequence`` now. Raises InputError.
    """
    check_finished(path)
    if (path / GRAPH).exists() or not all((path / name).is_file() for name in ENOUGH):
        return read_run(path)
    camera = open_sequence(sequence or find_sequence(path)).camera
    none = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
    trajectories = {file.name: read_tum(file) for file in trajectory_files(path)}
    landmarks = read_ply(path / LANDMARKS, POINTS)
    no_graph = FactorTables(), camera, SmootherConfig(), np.zeros(0)
    return SavedRun(path, *no_graph, trajectories, none, landmarks)


def _events(run: Path) -> dict[int, list[Event]]:
    """What happened, by frame; a run of an older version has no such file."""
    found: dict[int, list[Event]] = {}
    for event in read_events(run / EVENTS) if (run / EVENTS).is_file() else ():
        found.setdefault(event.frame, []).append(event)
    return found


def _show_uncertainty(path: Path, scene: Scene) -> dict[int, Array]:
    """Show where the keyframes may be; their covariances (6, 6) [rad, m] by id.

    By covariances.txt, else by the graph, which takes a second in a long run.
    """
    run = Run(path)
    try:
        keyframes, covariances = run.keyframes, run.keyframe_covariances
    except (InputError, RuntimeError) as error:  # RuntimeError: GTSAM's, of a singular graph
        logger.warning("shown without uncertainty: %s", error)
        return {}
    known = np.flatnonzero(np.isfinite(covariances).all(axis=(1, 2)))
    R = keyframes.poses_world_camera[known, :3, :3]
    position = R @ covariances[known, 3:, 3:] @ np.swapaxes(R, 1, 2)
    centres = keyframes.poses_world_camera[known, :3, 3]
    shown = [Ellipsoid.of(c, m) for c, m in zip(centres, position, strict=True)]
    scene.log_ellipsoids("world/uncertainty", shown)
    return dict(zip(keyframes.ids[known].tolist(), covariances[known], strict=True))


def _show_map(run: SavedRun, scene: Scene) -> None:
    """Show landmarks, keyframes, loops, objects and the dense cloud."""
    landmarks = run.landmarks
    labels = landmarks.get("label")
    places, colours = _xyz(landmarks), landmark_colours(landmarks)
    scene.log_points("world/landmarks", places, colours, 0.008, labels)
    keyframes = run.keyframes.positions_world
    grey = np.full((len(keyframes), 3), 200, np.uint8)
    scene.log_points("world/keyframes", keyframes, grey, 0.02)
    scene.log_segments("world/loops", _loops(run), (255, 120, 0))
    if (run.path / OBJECTS).is_file():
        scene.log_boxes(_boxes(run.path))
    dense = run.path / "dense" / "cloud.ply"
    if dense.is_file():
        cloud = read_ply(dense, POINTS)
        step = max(len(cloud["x"]) // MAX_DENSE_POINTS, 1)
        some = {name: column[::step] for name, column in cloud.items()}
        scene.log_points("world/dense", _xyz(some), _rgb(some), 0.006)


def landmark_colours(landmarks: Arrays) -> Bytes:
    """Colours (N, 3) of the landmarks' classes, or the landmarks' own where they have no class."""
    colours = _rgb(landmarks)
    labels = landmarks.get("label")
    if labels is None:
        return colours
    for label in np.unique(labels[labels > 0]).tolist():
        colours[labels == label] = class_colour(label).astype(np.uint8)
    return colours


def _loops(run: SavedRun) -> Array:
    """Positions (N, 2, 3) of the ends of the loops in the graph."""
    keyframes = run.tables.keyframes
    position = dict(zip(keyframes.ids.tolist(), keyframes.values[:, :3, 3], strict=True))
    factors = (entry.factor for entry in run.tables.pose_factors.values())
    ends = [
        (position[f.keyframe_a], position[f.keyframe_b])
        for f in factors
        if isinstance(f, RelativePose) and f.kind == "loop"
    ]
    return np.array(ends, float).reshape(-1, 2, 3)


def _boxes(run: Path) -> list[Box]:
    """The objects of a run, with label, probability and colour."""
    names, objects = read_objects(run)
    number = {name: k for k, name in enumerate(names)}
    return [
        Box(
            o.box,
            f"{o.label} {o.probability:.2f}",
            class_colour(number.get(o.label, 0)).astype(np.uint8),
        )
        for o in objects
    ]


def _frame_results(
    frames: FrameTable, trajectory: Trajectory, events: dict[int, list[Event]]
) -> list[FrameResult]:
    """The frames of a run with their final poses. Raises ValueError for what no run writes."""
    if not np.isfinite(frames.timestamps_s).all():
        raise ValueError("a stamp is not a finite number")
    near = known = np.zeros(len(frames), int)
    if len(trajectory):
        near = nearest_indices(trajectory.timestamps_s, frames.timestamps_s)
        known = np.abs(trajectory.timestamps_s[near] - frames.timestamps_s) < MAX_STAMP_ERROR_S
    return [
        FrameResult(
            int(frames.index[k]),
            float(frames.timestamps_s[k]),
            TrackingStatus(frames.status[k]),
            trajectory.poses_world_camera[near[k]] if known[k] else None,
            matches=int(frames.matches[k]),
            inliers=int(frames.inliers[k]),
            ignored=int(frames.ignored[k]),
            stage_ms={n: float(ms[k]) for n, ms in frames.stage_ms.items() if np.isfinite(ms[k])},
            events=tuple(events.get(int(frames.index[k]), ())),
        )
        for k in range(len(frames))
    ]


def _xyz(columns: Arrays) -> Array:
    return np.stack([columns[name] for name in "xyz"], axis=1).astype(float)


def _rgb(columns: Arrays) -> Bytes:
    return np.stack([columns[name] for name in ("red", "green", "blue")], axis=1)
