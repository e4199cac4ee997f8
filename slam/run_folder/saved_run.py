"""A run folder read back: its graph, its trajectories and its landmarks."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bmask_slam.config.configuration import resolve
from bmask_slam.graph.arrays import Array, Arrays, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.files.ply import read_ply
from bmask_slam.graph.marginals.landmark_marginalisation import reinstate
from bmask_slam.graph.smoother.storage import read_graph
from bmask_slam.graph.trajectory import Trajectory, read_tum

MAX_STAMP_ERROR_S = 1e-5  # of stamps with six decimals
MAX_POSE_ERROR = 1e-5  # of poses with nine: metres, and entries of rotations


@dataclass(frozen=True, eq=False)
class SavedRun:
    """What a run folder holds of a map.

    Attributes:
        path: the folder.
        shadow, camera: its graph, with all landmarks that were retired; config: what that was
            made with.
        keyframe_stamps_s: (K,) of the graph's keyframes; NaN for one of another run.
        trajectories: by file name, each map segment; trajectory.txt, the largest, is first.
        keyframes: what keyframes.txt holds.
        landmarks: columns of landmarks.ply.
    """

    path: Path
    tables: FactorTables
    camera: Camera
    config: SmootherConfig
    keyframe_stamps_s: Array
    trajectories: dict[str, Trajectory]
    keyframes: Trajectory
    landmarks: Arrays


def read_run(path: Path) -> SavedRun:
    """Read a run folder whose run came to its end.

    Raises:
        InputError: a file that is missing or broken, or keyframes.txt and graph of different runs.
    """
    if not (path / "graph").is_file():
        raise InputError(f"{path}: holds no graph; give the folder of a run that came to its end")
    tables, camera = read_graph(path / "graph")
    config = path / "config.yaml"
    graph_config = resolve(SmootherConfig, config if config.is_file() else None, section="graph")
    reinstate(tables, camera, graph_config)
    names = ["trajectory.txt", *sorted(p.name for p in path.glob("trajectory_segment_*.txt"))]
    run = SavedRun(
        path,
        tables,
        camera,
        graph_config,
        _keyframe_stamps(path / "frames.csv", tables.keyframes.ids),
        {name: read_tum(path / name) for name in names},
        read_tum(path / "keyframes.txt"),
        read_ply(path / "landmarks.ply"),
    )
    _check_same_run(run)
    return run


def _keyframe_stamps(path: Path, ids: Ints) -> Array:
    """Stamps (K,) of keyframes by the lines of frames.csv."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; give the folder as the run left it")
    with path.open(encoding="utf-8", newline="") as file:
        made = [row for row in csv.DictReader(file) if row.get("keyframe")]
    stamps_s = {int(row["keyframe"]): float(row["timestamp"]) for row in made}
    return np.array([stamps_s.get(i, np.nan) for i in ids.tolist()])


def _check_same_run(run: SavedRun) -> None:
    """Refuse a graph whose keyframes are not where keyframes.txt has them."""
    known = np.flatnonzero(np.isfinite(run.keyframe_stamps_s))
    known = known[np.argsort(run.keyframe_stamps_s[known])]
    stamps_s, written = run.keyframe_stamps_s[known], run.keyframes
    at = np.searchsorted(stamps_s + MAX_STAMP_ERROR_S, written.timestamps_s)
    if (at < len(known)).all():
        at = known[at]
        late_s = np.abs(run.keyframe_stamps_s[at] - written.timestamps_s)
        error = np.abs(run.tables.keyframes.values[at] - written.poses_world_camera)
        if (late_s < MAX_STAMP_ERROR_S).all() and error.max() < MAX_POSE_ERROR:
            return
    raise InputError(
        f"{run.path}: keyframes.txt and graph do not belong together; give the folder as the run "
        "left it"
    )
