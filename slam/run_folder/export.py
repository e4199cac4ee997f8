"""Export of runs, trajectories and graphs to the formats of other programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Ints
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.ply import read_ply, write_ply
from bmask_slam.graph.g2o.landmark_graphs import has_landmarks, write_landmark_graph
from bmask_slam.graph.g2o.landmark_reader import read_landmark_graph
from bmask_slam.graph.smoother.storage import read_graph
from bmask_slam.graph.trajectory import Trajectory, write_tum
from bmask_slam.graph.trajectory_formats import (
    read_times,
    read_trajectory,
    write_euroc,
    write_kitti,
    write_times,
)
from bmask_slam.run_folder.folder import trajectory_files
from bmask_slam.run_folder.landmark_file import LANDMARKS_COMMENT
from bmask_slam.run_folder.map_file import check_finished
from bmask_slam.run_folder.scene.scene_graph import write_object_points, write_scene_graph

ExportFormat = Literal["tum", "kitti", "euroc", "g2o", "ply", "scene-graph", "objects-ply"]
POSITIONS_COMMENT = "bmask-slam camera positions, world frame, metres, seconds"
POINTS_COMMENT = "bmask-slam landmarks of a graph, world frame, metres"


@dataclass(frozen=True)
class Exported:
    """The files written, and a text on what they contain and omit."""

    files: tuple[Path, ...]
    contents: str


def export(source: Path, form: ExportFormat, out: Path, times: Path | None = None) -> Exported:
    """Write a run folder, a trajectory or a g2o file with landmarks in another format.

    ``times`` is a file with the stamps of a trajectory in KITTI's format.

    Raises:
        InputError: broken input, a source without the data that the format needs, or an output
            that is the input or lies in a missing folder.
    """
    _check_paths(source, _files(form, out), times)
    if form == "g2o":
        return _graph(source, out)
    if form in ("scene-graph", "objects-ply"):
        if not source.is_dir():
            raise InputError(f"{source}: {form} needs the folder of a run with a segmenter")
        write = write_scene_graph if form == "scene-graph" else write_object_points
        return Exported((out,), write(source, out))
    if source.is_file() and has_landmarks(source):
        return _points_of_graph(source, form, out)
    if form == "ply" and source.is_dir():
        return _landmarks(source, out)
    return _trajectory(source, form, out, times)


def _files(form: ExportFormat, out: Path) -> tuple[Path, ...]:
    """What is written; in KITTI's format the stamps have a file of their own."""
    return (out, out.parent / f"{out.stem}_times.txt") if form == "kitti" else (out,)


def _check_paths(source: Path, files: tuple[Path, ...], times: Path | None) -> None:
    """Refuse outputs that are read too, or cannot be written. Raises InputError."""
    out = files[0]
    if not out.parent.is_dir():
        raise InputError(f"{out}: the folder {out.parent} does not exist; make it first")
    if not source.exists():
        raise InputError(f"{source}: no such file or folder; give a run folder or a trajectory")
    whole = source.resolve()
    inputs = (whole,) if times is None else (whole, times.resolve())
    for file in files:
        if file.is_dir():
            raise InputError(f"{file}: a folder; give the name of a file to write")
        if file.resolve() in inputs or file.resolve().parent == whole:
            raise InputError(
                f"{file}: is (in) the input, which stays as it is; choose another --out"
            )


def _graph(source: Path, out: Path) -> Exported:
    check_finished(source)
    if not (source / "graph").is_file():
        cure = "give the folder of a finished run, not one with --localise"
        raise InputError(f"{source}: has no graph, which g2o needs; {cure}")
    tables, camera = read_graph(source / "graph")
    write_landmark_graph(out, tables, camera)
    seen = tables.observations.select(tables.observations.all_rows())
    flat = int(np.isnan(seen.measurements[:, 2]).sum())
    edges, own = len(tables.pose_factors), len(tables.own_factors)
    lacking = f", {own} factors of your own (add_factor)" if own else ""
    return Exported(
        (out,),
        f"{len(tables.keyframes.ids)} keyframes (VERTEX_SE3:QUAT), {len(tables.landmarks.ids)} "
        f"landmarks (VERTEX_TRACKXYZ), {len(seen)} observations (EDGE_PROJECT_DISPARITY; {flat} "
        f"without depth: no information on 1/z), {edges} relative poses and priors.\n"
        f"Not in the format: the robust kernels of observations{lacking}, and what is in comments."
        f"{_segments_in(source)}",
    )


def _segments_in(source: Path) -> str:
    """A line of a graph that is not of one world, as it is of all map segments; "" of one."""
    count = len(trajectory_files(source)) - 1
    text = "{} more map segments are in it, each in a world of its own; no edge joins them"
    return f"\n{text.format(count)}" if count else ""


def _points_of_graph(source: Path, form: ExportFormat, out: Path) -> Exported:
    if form != "ply":
        raise InputError(f"{source}: a graph has no stamps, which {form} needs; give a run folder")
    tables, _ = read_landmark_graph(source)
    x, y, z = tables.landmarks.values.T
    write_ply(out, {"x": x, "y": y, "z": z, "id": _ids(tables.landmarks.ids)}, POINTS_COMMENT)
    return Exported((out,), f"{len(x)} landmarks: x y z in metres, id")


def _ids(ids: Ints) -> NDArray[np.int32]:
    """Ids as 32-bit integers, the largest that PLY has. Raises InputError beyond them."""
    if len(ids) and ids.max() > np.iinfo(np.int32).max:
        raise InputError("landmark ids exceed 32 bits, the largest integers of PLY; renumber them")
    return ids.astype(np.int32)


def _landmarks(source: Path, out: Path) -> Exported:
    check_finished(source)
    columns = read_ply(source / "landmarks.ply")
    write_ply(out, columns, LANDMARKS_COMMENT)
    count = len(next(iter(columns.values())))
    return Exported((out,), f"{count} landmarks: {', '.join(columns)}")


def _trajectory(source: Path, form: ExportFormat, out: Path, times: Path | None) -> Exported:
    file, note = source, ""
    if source.is_dir():
        file, *others = trajectory_files(source)
        count = len(others)
        note = f"\n{count} more map segments have files of their own in {source}" if count else ""
    trajectory = read_trajectory(file, None if times is None else read_times(times))
    files, what = _write(trajectory, form, out)
    return Exported(files, f"{len(trajectory)} poses T_world_camera: {what}{note}")


def _write(trajectory: Trajectory, form: ExportFormat, out: Path) -> tuple[tuple[Path, ...], str]:
    """Write a trajectory; the files, and a text on what a line contains."""
    if form == "tum":
        write_tum(out, trajectory)
        return (out,), "stamp in seconds, position in metres, quaternion x y z w"
    if form == "euroc":
        write_euroc(out, trajectory)
        return (out,), "stamp in nanoseconds, position in metres, quaternion w x y z"
    if form == "kitti":
        files = _files(form, out)
        write_kitti(out, trajectory.poses_world_camera)
        write_times(files[1], trajectory.timestamps_s)
        return files, "the upper three rows of the matrix; the stamps are in the second file"
    x, y, z = trajectory.positions_world.T
    write_ply(out, {"x": x, "y": y, "z": z, "t": trajectory.timestamps_s}, POSITIONS_COMMENT)
    return (out,), "x y z in metres and the stamp t in seconds"
