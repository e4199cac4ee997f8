"""The map and the graph of a finished run: saved, and read back to be worked on.

A saved map is what other runs go on from or are localised in; a saved graph is what an adjustment
or a calibration starts from.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

import numpy as np

from bmask_slam.config.configuration import resolve
from bmask_slam.graph.arrays import Array, Arrays, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.files.array_file import FileKind, part, read_arrays, write_arrays
from bmask_slam.graph.files.ply import POINTS, read_ply
from bmask_slam.graph.marginals.landmark_marginalisation import reinsert
from bmask_slam.graph.smoother.storage import read_camera, read_graph
from bmask_slam.graph.trajectory import MAX_STAMP_ERROR_S, Trajectory, read_tum
from bmask_slam.run_folder.folder import CHECKPOINT, trajectory_files
from bmask_slam.run_folder.frame_file import FRAMES, read_frames
from bmask_slam.run_folder.origin import CONFIG
from bmask_slam.semantics.beliefs.label_store import LabelStore
from bmask_slam.semantics.beliefs.observation import observation_model
from bmask_slam.semantics.labels import LabelSet, label_set

if TYPE_CHECKING:
    from bmask_slam.labelling.semantic_mapper import SemanticsConfig

MAP_FILE = FileKind("map", 4, compressed=True)
MAP = "map"
MAX_POSE_ERROR = 1e-5  # of poses with nine: metres, and entries of rotations


def write_map(path: Path, state: Arrays, camera: Camera) -> None:
    """Save a system's state, atomically. Raises InputError if it cannot."""
    write_arrays(path, MAP_FILE, {"camera": dataclasses.asdict(camera)}, state)


def read_map(path: Path) -> tuple[Arrays, Camera]:
    """The system's state in a map file, or in that of a run folder.

    Raises:
        InputError: it is missing, foreign, broken, empty or of another version.
    """
    check_finished(path)
    file = path / MAP if path.is_dir() else path
    header, state = read_arrays(file, MAP_FILE)
    if not len(state.get("mapper.world.keyframes.id", ())):
        raise InputError(f"{file}: holds no keyframe; give the map of a run that saw something")
    return state, read_camera(header, file)


def check_finished(run: Path) -> None:
    """Raises InputError for the folder of a run that was killed and can go on, so has no map."""
    if (run / CHECKPOINT).is_file() and not (run / MAP).is_file():
        cure = f"finish the run by: bmask-slam run --resume {quote(str(run))}"
        raise InputError(f"{run}: is not finished, and has no map yet; {cure}")


@dataclass(frozen=True, eq=False)
class SavedRun:
    """A finished run with its whole graph, read to be adjusted or calibrated.

    Attributes:
        path: the run folder.
        tables: the graph, with the observations of marginalised landmarks put back.
        camera: of the graph.
        config: what the graph was made with.
        keyframe_stamps_s: (K,) of the graph's keyframes; NaN for those of an earlier run that
            this one continued.
        trajectories: each map segment by file name; trajectory.txt, the largest, is first.
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
    """Read a finished run.

    Raises:
        InputError: a file that is missing or broken, or keyframes.txt and graph of different runs.
    """
    check_finished(path)
    if not (path / "graph").is_file():
        cure = "give the folder of a run that came to its end, without --localise"
        raise InputError(f"{path}: holds no graph; {cure}")
    tables, camera = read_graph(path / "graph")
    config = path / "config.yaml"
    graph_config = resolve(SmootherConfig, config if config.is_file() else None, section="graph")
    reinsert(tables, camera, graph_config)
    run = SavedRun(
        path,
        tables,
        camera,
        graph_config,
        _keyframe_stamps(path / FRAMES, tables.keyframes.ids),
        {file.name: read_tum(file) for file in trajectory_files(path)},
        read_tum(path / "keyframes.txt"),
        read_ply(path / "landmarks.ply", (*POINTS, "observations", "id")),
    )
    _check_same_run(run)
    return run


def _keyframe_stamps(path: Path, ids: Ints) -> Array:
    """Stamps (K,) of keyframes by the lines of frames.csv."""
    frames = read_frames(path)
    keyframes = zip(frames.keyframe_ids.tolist(), frames.timestamps_s.tolist(), strict=True)
    stamps_s = {number: stamp_s for number, stamp_s in keyframes if number >= 0}
    return np.array([stamps_s.get(number, np.nan) for number in ids.tolist()])


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


@dataclass(frozen=True, eq=False)
class RunLabels:
    """The label set of a run and its label store, whose ids are those of landmarks."""

    names: LabelSet
    store: LabelStore


def run_semantics(path: Path) -> SemanticsConfig:
    """The section ``semantics`` of a run's configuration. Raises InputError."""
    from bmask_slam.labelling.semantic_mapper import SemanticsConfig  # noqa: PLC0415 - loads GTSAM

    return resolve(SemanticsConfig, path / CONFIG, section="semantics")


def saved_labels(state: Arrays, path: Path) -> RunLabels | None:
    """What the part ``semantics`` of a map says of landmarks; None without a segmenter."""
    names = LabelSet(tuple(state["names"].tolist())) if state else label_set(())
    if len(names) < 2:
        return None
    model = observation_model(str(state.get("measured", np.array([""]))[0]), names)
    store = LabelStore(len(names), run_semantics(path).labels, model)
    store.restore(part(state, "labels"))
    return RunLabels(names, store)
