"""``Run(path)``: a run folder as numpy arrays, each part read when it is first asked for."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from pydantic import BaseModel

from bmask_slam.events import Event, read_events
from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.json_file import STRICT, read_json
from bmask_slam.graph.files.reading import read_text
from bmask_slam.graph.sensors.markers import MarkerMap
from bmask_slam.graph.trajectory import MAX_STAMP_ERROR_S, Trajectory, nearest_indices, read_tum
from bmask_slam.run_folder.covariance_file import COVARIANCES, read_covariances, rows_of
from bmask_slam.run_folder.folder import CHECKPOINT, DENSE, FILES, trajectory_files
from bmask_slam.run_folder.frame_file import FRAMES, FrameTable, read_frames
from bmask_slam.run_folder.landmark_file import (
    LANDMARKS,
    MARKERS,
    DenseCloud,
    Landmarks,
    read_dense_cloud,
    read_landmarks,
    read_markers,
)
from bmask_slam.run_folder.origin import CONFIG, read_origin
from bmask_slam.run_folder.semantic_files import OBJECTS, SavedObject, read_objects

if TYPE_CHECKING:
    from bmask_slam.system_config import SystemConfig

STOPPED = "stopped_after"
"""Of metrics.json: the frames after which a signal ended a run; not in that of a whole run."""


class Metric(NamedTuple):
    """A number of metrics.json; unit "1" is a share."""

    value: float
    unit: str


class _Row(BaseModel):
    """A row of metrics.json."""

    model_config = STRICT
    name: str
    value: int | float
    unit: str


@dataclass(frozen=True, eq=False)
class Keyframes:
    """The keyframes of a run, K of them, in the order of their stamps.

    Attributes:
        ids: (K,); -1 for a keyframe that frames.csv does not have.
        timestamps_s: (K,).
        poses_world_camera: (K, 4, 4), ``p_world = T_world_camera @ p_camera``.
        reasons: K texts, why each was made.
    """

    ids: Ints
    timestamps_s: Array
    poses_world_camera: Array
    reasons: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.ids)


class Run:
    """The folder of a run, also of one that goes on or was stopped; whatever is there can be read.

    Every property is read from its file when it is first asked for, and kept. World coordinates
    are those of the run's map: metres, in the camera frame of its first keyframe. ``os.fspath``
    gives the folder, so that a run can be given wherever a path can.

    Raises:
        InputError: no such folder or no run in it; each property, if its file is missing or
            broken, names the file and the command that makes it.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        if not self.path.is_dir():
            raise InputError(f"{self.path}: no such folder; give the folder of a run")
        if not any((self.path / name).exists() for name in (*FILES, CHECKPOINT)):
            cure = f"make one by: bmask-slam run SEQUENCE --out {quote(str(self.path))}"
            raise InputError(f"{self.path}: holds no run; {cure}")

    def __fspath__(self) -> str:
        return str(self.path)

    def __repr__(self) -> str:
        return f"Run({str(self.path)!r})"

    @property
    def is_finished(self) -> bool:
        """Whether the run came to its end, was not stopped before, and wrote all its results."""
        path = self.path / "metrics.json"
        whole = path.is_file() and not (self.path / CHECKPOINT).exists()
        return whole and f'"{STOPPED}"' not in read_text(path, self._again())

    @cached_property
    def trajectory(self) -> Trajectory:
        """Every frame with a pose in the largest map segment; of a run that goes on, so far."""
        return read_tum(self._file("trajectory.txt"))

    @cached_property
    def trajectories(self) -> tuple[Trajectory, ...]:
        """Every map segment, each in a world frame of its own; the largest is first."""
        return (self.trajectory, *map(read_tum, trajectory_files(self.path)[1:]))

    @cached_property
    def keyframes(self) -> Keyframes:
        """The keyframes of the largest map segment."""
        trajectory, frames = read_tum(self._file("keyframes.txt")), self.frames
        stamps_s = trajectory.timestamps_s
        ids, reasons = np.full(len(stamps_s), -1), [""] * len(stamps_s)
        made = np.flatnonzero(frames.keyframe_ids >= 0)
        if len(made):
            near = made[nearest_indices(frames.timestamps_s[made], stamps_s)]
            late_s = np.abs(frames.timestamps_s[near] - stamps_s)
            for k in np.flatnonzero(late_s <= MAX_STAMP_ERROR_S).tolist():
                ids[k], reasons[k] = frames.keyframe_ids[near[k]], frames.keyframe_reasons[near[k]]
        return Keyframes(ids, stamps_s, trajectory.poses_world_camera, tuple(reasons))

    @cached_property
    def frames(self) -> FrameTable:
        """Status, matches, inliers and times of every frame; of a run that goes on, so far."""
        return read_frames(self._file(FRAMES))

    @cached_property
    def events(self) -> tuple[Event, ...]:
        """What happened, in order; empty for a run of an older version, which wrote no events."""
        return read_events(self.path)

    @cached_property
    def landmarks(self) -> Landmarks:
        """The landmarks of the largest map segment, with labels if there was a segmenter."""
        names = self.label_names if (self.path / OBJECTS).is_file() else None
        return read_landmarks(self._file(LANDMARKS), names)

    @cached_property
    def markers(self) -> MarkerMap:
        """The fiducial markers of the largest map segment."""
        return read_markers(self._file(MARKERS, "--markers DICT:SIZE_M"))

    @cached_property
    def objects(self) -> tuple[SavedObject, ...]:
        """The objects of the largest map segment."""
        return tuple(self._label_names_and_objects[1])

    @cached_property
    def label_names(self) -> tuple[str, ...]:
        """The C class names of the run's segmenter; the first is "unknown"."""
        return self._label_names_and_objects[0]

    @cached_property
    def label_distributions(self) -> Array:
        """Probabilities (N, C) of ``label_names`` for the N ``landmarks``."""
        from bmask_slam.graph.files.array_file import fitting, part  # noqa: PLC0415
        from bmask_slam.run_folder.map_file import MAP, read_map, saved_labels  # noqa: PLC0415

        path = self._file(MAP)
        with fitting(path):
            found = saved_labels(part(read_map(path)[0], "semantics"), self.path)
        if found is None:
            raise InputError(
                f"{self.path / 'map'}: has no labels; {self._again('--segmenter light')}"
            )
        return found.store.probabilities(self.landmarks.ids)

    @cached_property
    def keyframe_covariances(self) -> Array:
        """Covariances (K, 6, 6) of the ``keyframes``, NaN where the graph knows none.

        Of ``[rotation rad, translation m]`` in the camera's frame: the true pose is about
        ``T_world_camera @ se3_exp(xi)``, xi ~ N(0, covariance). Read from covariances.txt, or
        computed from the graph.
        """
        if (self.path / COVARIANCES).is_file():
            saved = read_covariances(self.path / COVARIANCES)
            return rows_of(self.keyframes.ids, saved.keyframe_ids, saved.covariances)
        ids, covariances = self._marginals(np.zeros(0, np.int64))[0]
        return rows_of(self.keyframes.ids, ids, covariances)

    @cached_property
    def landmark_covariances(self) -> Array:
        """Covariances (N, 3, 3) of the ``landmarks`` in m^2, world axes; computed from the graph.

        NaN for a landmark that is not in the graph at the end. It takes up to a minute. InputError
        also for a singular graph.
        """
        ids, covariances = self._marginals(self.landmarks.ids)[1]
        return rows_of(self.landmarks.ids, ids, covariances)

    @cached_property
    def dense_cloud(self) -> DenseCloud:
        """The dense cloud, after ``map_run``."""
        return read_dense_cloud(self._file(f"{DENSE}/cloud.ply"), self._dense_names)

    @cached_property
    def object_clouds(self) -> dict[int, DenseCloud]:
        """The dense cloud of each object by its id, after ``map_run``."""
        names = self._dense_names
        files = sorted((self.path / DENSE / "objects").glob("*-*.ply"))
        own = ((f.name.partition("-")[0], f) for f in files)
        return {int(k): read_dense_cloud(f, names) for k, f in own if k.isdecimal()}

    @cached_property
    def metrics(self) -> dict[str, Metric]:
        """Value and unit of every number in metrics.json by its name."""
        path = self._file("metrics.json")
        rows = read_json(path, list[_Row], self._again())
        return {row.name: Metric(row.value, row.unit) for row in rows}

    @cached_property
    def camera(self) -> Camera:
        """The camera that the run was made with."""
        from bmask_slam.graph.smoother.storage import read_graph  # noqa: PLC0415

        return read_graph(self._file("graph"))[1]

    @cached_property
    def config(self) -> SystemConfig:
        """The resolved configuration of the run."""
        from bmask_slam.config.configuration import resolve  # noqa: PLC0415
        from bmask_slam.system_config import SystemConfig  # noqa: PLC0415 - loads GTSAM

        return resolve(SystemConfig, self._file(CONFIG))

    @cached_property
    def sequence(self) -> Path | None:
        """The folder or file of the recording that the run was made from; None for a camera."""
        return read_origin(self.path).sequence

    @cached_property
    def log(self) -> tuple[str, ...]:
        """The lines of log.txt."""
        return tuple(read_text(self._file("log.txt"), self._again()).splitlines())

    @cached_property
    def _label_names_and_objects(self) -> tuple[tuple[str, ...], list[SavedObject]]:
        self._file(OBJECTS, "--segmenter light")
        return read_objects(self.path)

    @cached_property
    def _dense_names(self) -> tuple[str, ...]:
        """Class names of the labels of the dense clouds."""
        path = self._file(f"{DENSE}/legend.json")
        cure = f"bmask-slam map {quote(str(self.path))} makes it again"
        return tuple(read_json(path, dict[str, Any], cure))

    def _marginals(self, landmark_ids: Ints) -> tuple[tuple[Ints, Array], tuple[Ints, Array]]:
        """Ids and covariances of the graph's keyframes, and of those landmarks that it has."""
        from bmask_slam.config.configuration import resolve  # noqa: PLC0415
        from bmask_slam.graph.smoother.isam2 import SolverError  # noqa: PLC0415
        from bmask_slam.graph.smoother.smoother import Smoother, SmootherConfig  # noqa: PLC0415
        from bmask_slam.run_folder.covariance_file import why_singular  # noqa: PLC0415

        config = resolve(SmootherConfig, self._file(CONFIG), section="graph")
        path = self._file("graph")
        smoother = Smoother.load(path, config)
        known = np.intersect1d(landmark_ids, smoother.state()["landmark_ids"])
        try:
            found = smoother.marginals(known)
        except SolverError as error:
            raise InputError(f"{path}: no covariances, {why_singular(error)}") from error
        return (found.keyframe_ids, found.keyframes), (found.landmark_ids, found.landmarks)

    def _file(self, name: str, option: str = "") -> Path:
        """The path of a file of the run. Raises InputError if it is not there."""
        path = self.path / name
        if path.exists():
            return path
        if name.startswith(DENSE):
            cure = f"make it by: bmask-slam map {quote(str(self.path))}"
            raise InputError(f"{path}: no such file; {cure}")
        if (self.path / CHECKPOINT).exists():
            cure = f"finish the run by: bmask-slam run --resume {quote(str(self.path))}"
            raise InputError(f"{path}: no such file yet; {cure}")
        raise InputError(f"{path}: no such file; {self._again(option)}")

    def _again(self, option: str = "") -> str:
        """The command that makes the run once more."""
        sequence, out = (quote(str(path)) for path in (self.sequence or "SEQUENCE", self.path))
        words = ("bmask-slam run", sequence, option, f"--out {out} --overwrite")
        return f"make it by: {' '.join(filter(None, words))}"
