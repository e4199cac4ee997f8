"""landmarks.ply and markers.json, written and read back as arrays; dense clouds, read."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from bmask_slam.graph.arrays import Array, Bytes, Ints
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.json_file import STRICT, format_json, read_json
from bmask_slam.graph.files.ply import POINTS, check_columns, read_ply, write_ply
from bmask_slam.graph.files.reading import read_table
from bmask_slam.graph.sensors.markers import FoundMarker, MarkerMap
from bmask_slam.labelling.results import LandmarkCloud

LANDMARKS = "landmarks.ply"
MARKERS = "markers.json"
LANDMARKS_COMMENT = "bmask-slam landmarks, world frame, metres"
Row4 = tuple[float, float, float, float]


def write_landmarks(path: Path, cloud: LandmarkCloud) -> None:
    """Landmarks as PLY: position in the world in metres, colour, number of keyframes, id."""
    x, y, z = cloud.points_world.T.astype(np.float32)
    red, green, blue = cloud.colours.T.astype(np.uint8)
    columns = {"x": x, "y": y, "z": z, "red": red, "green": green, "blue": blue}
    columns["observations"] = cloud.observations.astype(np.int32)
    columns["id"] = cloud.ids.astype(np.int32)
    if cloud.labels is not None:
        found = cloud.labels.estimates
        columns["label"] = found.labels.astype(np.int32)
        columns["probability"] = found.probability.astype(np.float32)
        columns["entropy"] = found.entropy.astype(np.float32)
        if (on := cloud.labels.surfaces) is not None:
            columns["surface"] = on.labels.astype(np.int32)
            columns["surface_probability"] = on.probability.astype(np.float32)
    write_ply(path, columns, LANDMARKS_COMMENT)


@dataclass(frozen=True, eq=False)
class Landmarks:
    """The landmarks of a run, N of them.

    Attributes:
        ids: (N,).
        points_world: (N, 3) in metres.
        colours: (N, 3) uint8, red first.
        observations: (N,), number of keyframes that observed each.
        labels: (N,) class names, "unknown" where a landmark is on no known object; None if the run
            had no segmenter.
        probabilities: (N,) of the label, or None.
        entropies: (N,) of the distribution over all labels in nats, or None.
        surfaces: (N,) names of what the landmarks lie on (wall, floor, ...), or "unknown"; None if
            the segmenter found instances alone.
        surface_probabilities: (N,) of it, or None.
    """

    ids: Ints
    points_world: Array
    colours: Bytes
    observations: Ints
    labels: NDArray[np.str_] | None = None
    probabilities: Array | None = None
    entropies: Array | None = None
    surfaces: NDArray[np.str_] | None = None
    surface_probabilities: Array | None = None

    def __len__(self) -> int:
        return len(self.ids)


def read_landmarks(path: Path, names: tuple[str, ...] | None) -> Landmarks:
    """Read what `write_landmarks` wrote; ``names`` are those of the labels, None without any.

    The names of surfaces are those in labels.csv beside it.

    Raises:
        InputError: no such file, a column that is missing, or a label without a name.
    """
    columns = _columns(path, ("id", "observations"), ("label", "probability", "entropy"))
    found = Landmarks(
        columns["id"].astype(np.int64),
        columns["xyz"],
        columns["rgb"],
        columns["observations"].astype(np.int64),
    )
    if names is None or "label" not in columns:
        return found
    labels = _named(columns["label"], names, path)
    probabilities, entropies = (columns[n].astype(float) for n in ("probability", "entropy"))
    found = replace(found, labels=labels, probabilities=probabilities, entropies=entropies)
    if "surface" not in columns:
        return found
    cure, table = "run again", path.with_name("labels.csv")
    surfaces = np.array(read_table(table, ("surface",), cure)["surface"], np.str_)
    if len(surfaces) != len(found):
        raise InputError(f"{table}: {len(surfaces)} lines, but {len(found)} landmarks; {cure}")
    check_columns(columns, ("surface_probability",), path)
    sure = columns["surface_probability"].astype(float)
    return replace(found, surfaces=surfaces, surface_probabilities=sure)


@dataclass(frozen=True, eq=False)
class DenseCloud:
    """A dense cloud that ``bmask-slam map`` made, N points.

    Attributes:
        points_world: (N, 3) in metres.
        normals_world: (N, 3), unit vectors towards the camera.
        colours: (N, 3) uint8, red first.
        labels: (N,) class names, "background" on no object.
        probabilities: (N,) of the label.
        sigmas_m: (N,), standard deviation along the ray.
    """

    points_world: Array
    normals_world: Array
    colours: Bytes
    labels: NDArray[np.str_]
    probabilities: Array
    sigmas_m: Array

    def __len__(self) -> int:
        return len(self.points_world)


def read_dense_cloud(path: Path, names: tuple[str, ...]) -> DenseCloud:
    """Read a cloud of a dense folder, whose labels have these names. Raises InputError."""
    columns = _columns(path, ("nx", "ny", "nz", "label", "probability", "sigma"))
    normals = np.stack([columns[f"n{axis}"] for axis in "xyz"], axis=1).astype(float)
    if not (np.isfinite(columns["xyz"]).all() and np.isfinite(normals).all()):
        raise InputError(f"{path}: a point or normal is not finite; make it again")
    return DenseCloud(
        columns["xyz"],
        normals,
        columns["rgb"],
        _named(columns["label"], names, path),
        columns["probability"].astype(float),
        columns["sigma"].astype(float),
    )


class _SavedMarker(BaseModel):
    """A marker in markers.json."""

    model_config = STRICT
    id: int
    size_m: float | None
    T_world_marker: tuple[Row4, Row4, Row4, Row4]
    seen: int
    used: int


class _SavedMarkers(BaseModel):
    """The content of markers.json."""

    model_config = STRICT
    dictionary: str
    T_world_site: tuple[Row4, Row4, Row4, Row4] | None
    markers: list[_SavedMarker]


def write_markers(path: Path, found: MarkerMap) -> None:
    """Write markers.json; poses are rows of (4, 4), in metres."""
    path.write_text(format_json(found) + "\n", encoding="utf-8")


def read_markers(path: Path) -> MarkerMap:
    """Read what `write_markers` wrote. Raises InputError."""
    saved = read_json(path, _SavedMarkers, "run again with --markers")
    markers = [
        FoundMarker(
            m.id,
            np.nan if m.size_m is None else m.size_m,
            np.array(m.T_world_marker),
            m.seen,
            m.used,
        )
        for m in saved.markers
    ]
    T_world_site = None if saved.T_world_site is None else np.array(saved.T_world_site)
    return MarkerMap(saved.dictionary, T_world_site, tuple(markers))


def _columns(
    path: Path, needed: tuple[str, ...], together: tuple[str, ...] = ()
) -> dict[str, NDArray]:
    """Columns of a PLY file, and "xyz" (N, 3) and "rgb" (N, 3) of its points.

    The columns ``together`` are needed if the first of them is there.
    """
    columns = read_ply(path, (*POINTS, *needed))
    if columns.keys() & set(together[:1]):
        check_columns(columns, together, path)
    columns["xyz"] = np.stack([columns[name] for name in POINTS[:3]], axis=1).astype(float)
    columns["rgb"] = np.stack([columns[name] for name in POINTS[3:]], axis=1)
    return columns


def _named(labels: NDArray, names: tuple[str, ...], path: Path) -> NDArray[np.str_]:
    if len(labels) and not 0 <= labels.min() <= labels.max() < len(names):
        raise InputError(f"{path}: a label beyond the {len(names)} of the run; make it again")
    return np.array(names, np.str_)[labels.astype(np.int64)]
