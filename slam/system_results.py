"""Results of a system at any time: trajectory, landmarks, objects, files, statistics."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from bmask_slam.back_end.map_backend import MapBackend
from bmask_slam.back_end.mapper import Mapper
from bmask_slam.events import totals
from bmask_slam.graph.arrays import Arrays
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.files.array_file import check_like, nested
from bmask_slam.graph.inertial.tables import example_arrays
from bmask_slam.graph.sensors.markers import MarkerMap
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.labelling.results import LandmarkCloud, MapObjects
from bmask_slam.labelling.semantic_mapper import SemanticMapper
from bmask_slam.run_folder.covariance_file import (
    COVARIANCES,
    KeyframeCovariances,
    find_covariances,
    write_covariances,
)
from bmask_slam.run_folder.landmark_file import MARKERS, write_markers
from bmask_slam.run_folder.map_file import MAP, SavedRun, write_map
from bmask_slam.run_folder.semantic_files import semantic_writers
from bmask_slam.sensing.carried_frames import example_state
from bmask_slam.system_config import SystemConfig
from bmask_slam.world.keyframe import Keyframe

OLDER_ARRAYS = ("semantics.labels.counts", "semantics.objects.labels.counts")
"""Arrays in older files that are read by nothing today."""
NEWER_ARRAYS = (
    "mapper.events.",
    "mapper.history.information",
    "mapper.loops.noise.",
    "mapper.loops.drift.",
    "mapper.loops.recogniser.dismissed",
    "localiser.images.",
    "frames.",
    "semantics.surfaces.",
    "semantics.views.",
    "label_views.",
)
"""Beginnings of the names of arrays that older files lack; an empty system's are used then."""
OPTIONAL_ARRAYS = (
    *("landmarks.spare", "world.label_views", "s.measured", "upright.points", "upright.sides"),
    *("labels.scores", "labels.seen", "labels.judged"),
    *("votes.coded", "votes.cell_px", "votes.codes_shape", "votes.codes", "points.covered"),
)
"""Ends of the names of arrays that older files lack, and whose readers do without."""
SENSOR_ARRAYS = ("mapper.sensors.", "mapper.graph.own_", "mapper.graph.imu_")
"""Beginnings of the names of arrays that are there with other sensors or own factors only."""


class SystemResults(ABC):
    """Results of a system; reading them changes nothing."""

    camera: Camera
    config: SystemConfig
    map: MapBackend
    semantics: SemanticMapper
    _first_keyframe: int

    @property
    def mapper(self) -> Mapper:
        """The owner of map and graph, where they are in this process.

        Raises:
            RuntimeError: they are in another process, until a live system is finished.
        """
        if not isinstance(self.map, Mapper):
            raise RuntimeError("map and graph are in another process until the run is finished")
        return self.map

    @abstractmethod
    def state(self) -> Arrays:
        """The whole state of the system, as named arrays."""

    def trajectory(self) -> Trajectory:
        """Every frame with a pose in the largest segment, from the keyframes as they are now."""
        nothing = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
        return self.segments().get(self.largest_segment(), nothing)

    def segments(self) -> dict[int, Trajectory]:
        """The frames of every map segment, each in the segment's own coordinate frame."""
        return self.map.history.trajectories(self.map.world)

    def largest_segment(self) -> int:
        """The mapped segment with most frames, any if none is; the older of equal ones."""
        return self.map.history.largest_segment(self.map.world)

    def keyframe_trajectory(self) -> Trajectory:
        """The keyframes of the largest segment that this session made.

        In a merged map those of recordings that a run had continued have no stamp, and are left
        out.
        """
        segment = self.largest_segment()
        chosen = [k for k in self.session_keyframes() if k.segment == segment]
        chosen = [k for k in chosen if np.isfinite(k.timestamp_s)]
        poses = np.array([k.T_world_camera for k in chosen]).reshape(-1, 4, 4)
        return Trajectory(np.array([k.timestamp_s for k in chosen]), poses)

    def session_keyframes(self) -> list[Keyframe]:
        """The keyframes that this session made; a run may have continued a map."""
        world = self.map.world
        return [k for k in world.keyframes.values() if k.id >= self._first_keyframe]

    def keyframe_covariances(self) -> KeyframeCovariances:
        """Covariances of the keyframes of the largest segment that have a stamp."""
        chosen = self.map.world.in_segment(self.largest_segment())
        stamps_s = {k.id: k.timestamp_s for k in chosen if np.isfinite(k.timestamp_s)}
        return find_covariances(self.mapper.smoother, stamps_s)

    def landmarks(self) -> LandmarkCloud:
        """The landmarks of the largest segment, with their colours."""
        table = self.map.world.landmarks
        chosen = self.map.world.in_segment(self.largest_segment())
        hosts = [k.id for k in chosen]
        ids = np.flatnonzero(table.in_map & np.isin(table.host, hosts))
        labels = self.semantics.landmark_labels(ids, chosen)
        views = table.observations[ids].astype(np.int64)
        return LandmarkCloud(ids, table.points_world[ids], table.colours[ids], views, labels)

    def objects(self) -> MapObjects:
        """The objects of the largest segment."""
        return self.semantics.map_objects(self.map.world.in_segment(self.largest_segment()))

    def markers_found(self) -> MarkerMap:
        """The fiducial markers of the largest segment."""
        chosen, mapper = self.largest_segment(), self.mapper
        return mapper.sensors.marker_map(mapper.smoother.tables, chosen)

    def files(self) -> dict[str, Callable[[Path], None]]:
        """Functions that write the files of the results, by file name."""
        found: dict[str, Callable[[Path], None]] = {
            "graph": self.mapper.smoother.save,
            MAP: self.save_map,
        }
        if self.semantics.enabled:
            found |= semantic_writers(self.landmarks(), self.objects(), self.trajectory())
        if self.config.sensors.markers.enabled:
            found[MARKERS] = lambda path: write_markers(path, self.markers_found())
        if self.config.covariances:
            found[COVARIANCES] = lambda path: write_covariances(path, self.keyframe_covariances())
        return found

    def as_run(self) -> SavedRun:
        """The run so far as one that was saved and read again, without its folder."""
        tables = self.mapper.smoother.tables
        stamps_s = {k.id: k.timestamp_s for k in self.session_keyframes()}
        return SavedRun(
            Path(),
            tables,
            self.camera,
            self.config.graph,
            np.array([stamps_s.get(i, np.nan) for i in tables.keyframes.ids.tolist()]),
            {"trajectory.txt": self.trajectory()},
            self.keyframe_trajectory(),
            {},
        )

    def save_map(self, path: Path) -> None:
        """Write the state without times, so that the same run gives the same bytes."""
        write_map(path, self.state() | {"mapper.update_ms": np.zeros(0)}, self.camera)

    def statistics(self) -> dict[str, Any]:
        """Sizes of the map, times of graph updates in milliseconds, what the graph refused."""
        return {
            "keyframes": len(self.map.world.keyframes),
            "landmarks": int(self.map.world.landmarks.in_map.sum()),
            "loops_closed": len(self.mapper.loops.closed),
            "isam2_update_ms": list(self.mapper.update_ms),
            "graph": totals(self.mapper.events.counts),
        }


def checked_state(state: Arrays, own: Arrays, path: Path) -> Arrays:
    """A state that was read from a file, with what older versions did not save yet.

    ``own`` is the state of an empty system. Raises InputError for arrays of other names or types.
    """
    graph: Arrays = {"own_factors": np.zeros(0, np.str_), "own_factor_ids": np.zeros(0, np.int64)}
    graph |= {"own_next": np.array(0), **example_arrays()}
    own = {**nested(mapper=nested(sensors=example_state(), graph=graph)), **own}
    state = {name: array for name, array in state.items() if name not in OLDER_ARRAYS}
    state = {name: a for name, a in own.items() if name.startswith(NEWER_ARRAYS)} | state
    present = {n: a for n, a in own.items() if n in state or not _is_optional(n)}
    check_like(state, present, path)
    return state


def _is_optional(name: str) -> bool:
    """Whether a state may do without an array."""
    return name.startswith(SENSOR_ARRAYS) or name.endswith(OPTIONAL_ARRAYS)
