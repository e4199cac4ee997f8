"""labels.csv and the files of objects (.json, .ply, .png): written, and read back."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, Field

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.errors import MAX_WHOLE, InputError, finite_number, whole_number
from bmask_slam.graph.files.json_file import STRICT, Name, read_json
from bmask_slam.graph.files.reading import read_table
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.labelling.label_views import FIRST_LABEL_VIEW
from bmask_slam.labelling.results import LandmarkCloud, MapObjects
from bmask_slam.run_folder.object_picture import draw_objects
from bmask_slam.semantics.instances.overlay import class_colour
from bmask_slam.semantics.objects.boxes3d import EDGES, OrientedBox
from bmask_slam.semantics.objects.publication import MapObject

LABELS = "labels.csv"
OBJECTS = "objects.json"
BOXES = "objects.ply"
OBJECTS_PICTURE = "objects.png"
SEMANTIC_FILES = (LABELS, OBJECTS, BOXES, OBJECTS_PICTURE)
_COLUMNS = ("id", "label", "probability", "entropy", "views")
_SURFACE_COLUMNS = ("surface", "surface_probability")
_SHORTEST_UP = 1e-6
_WITH_LABELS = (
    "give a run that had a segmenter, not what `optimise` made of it; after --localise the map's"
)
"""What to do where a run has no objects."""


@dataclass(frozen=True, eq=False)
class LabelTable:
    """The labels of a run's landmarks, in the order of landmarks.ply.

    Attributes:
        ids: (N,) of the landmarks.
        labels: N class names, "unknown" for a landmark on no known object.
        probability: (N,) of the label.
        entropy: (N,) of the distribution over all labels, in nats.
        views: (N,), number of keyframes whose masks voted.
    """

    ids: Ints
    labels: tuple[str, ...]
    probability: Array
    entropy: Array
    views: Ints


def semantic_writers(
    cloud: LandmarkCloud, objects: MapObjects, trajectory: Trajectory
) -> dict[str, Callable[[Path], None]]:
    """A function that writes a file, by the file's name."""
    return {
        LABELS: lambda path: write_labels(path, cloud),
        OBJECTS: lambda path: write_objects(path, objects),
        BOXES: lambda path: write_boxes(path, objects),
        OBJECTS_PICTURE: lambda path: draw_objects(path, cloud, objects, trajectory),
    }


def write_labels(path: Path, cloud: LandmarkCloud) -> None:
    """Write one line a landmark."""
    assert cloud.labels is not None
    names, found = cloud.labels.names, cloud.labels.estimates
    columns = [
        cloud.ids.tolist(),
        [names.map_name(label) for label in found.labels.tolist()],
        [f"{p:.5f}" for p in found.probability.tolist()],
        [f"{h:.5f}" for h in found.entropy.tolist()],
        found.views.tolist(),
    ]
    on = cloud.labels.surfaces
    if on is not None:
        columns.append([on.names.map_name(label) for label in on.labels.tolist()])
        columns.append([f"{p:.5f}" for p in on.probability.tolist()])
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow((*_COLUMNS, *_SURFACE_COLUMNS)[: len(columns)])
        writer.writerows(zip(*columns, strict=True))


def read_labels(run: Path) -> LabelTable:
    """The label table of a run folder.

    Raises:
        InputError: no such file, other columns, or a value that is not a number.
    """
    path = run / LABELS
    if not path.is_file():
        raise InputError(f"{path}: no such file; {_WITH_LABELS}")
    columns = read_table(path, _COLUMNS, "run again")

    def numbers(name: str, parse: Callable[[str, str], float]) -> list[float]:
        return [parse(text, f"{path}: line {n}") for n, text in enumerate(columns[name], 2)]

    return LabelTable(
        np.array(numbers("id", whole_number), np.int64),
        columns["label"],
        np.array(numbers("probability", finite_number), float),
        np.array(numbers("entropy", finite_number), float),
        np.array(numbers("views", whole_number), np.int64),
    )


Metres = Annotated[float, Field(ge=-1e9, le=1e9)]
Point = tuple[Metres, Metres, Metres]
Id = Annotated[int, Field(ge=0, le=MAX_WHOLE)]


class _Box(BaseModel):
    model_config = STRICT
    centre_world_m: Point
    axes_world: tuple[Point, Point, Point]
    size_m: Point


class _Object(BaseModel):
    model_config = STRICT
    id: Id
    label: Name
    probability: float
    centroid_world_m: Point
    box: _Box
    keyframes: list[Id]
    landmarks: list[Id]
    first_seen_s: float
    last_seen_s: float


class _ObjectFile(BaseModel):
    """What `write_objects` writes, as far as it is read."""

    model_config = STRICT
    labels: list[Name]
    objects: list[_Object]
    up_world: Point = (0.0, -1.0, 0.0)
    floor_m: Metres | None = None


@dataclass(frozen=True, eq=False)
class SavedObject:
    """An object of a run, read back.

    Attributes:
        id: number of the object.
        label: class name.
        probability: of the label.
        centroid_world: (3,) in metres.
        box: around the object.
        keyframes: (K,) ids of the keyframes that observed it.
        landmarks: (N,) ids of the landmarks on it.
        first_seen_s, last_seen_s: stamps.
    """

    id: int
    label: str
    probability: float
    centroid_world: Array
    box: OrientedBox
    keyframes: Ints
    landmarks: Ints
    first_seen_s: float
    last_seen_s: float


@dataclass(frozen=True, eq=False)
class SavedScene:
    """What objects.json holds.

    Attributes:
        names: class names of the segmenter. objects: of the run.
        up_world: (3,) unit vector, up. floor_m: the floor's height along it, NaN if unknown.
    """

    names: tuple[str, ...]
    objects: tuple[SavedObject, ...]
    up_world: Array
    floor_m: float


def write_objects(path: Path, found: MapObjects) -> None:
    """Write objects as JSON: metres, in the run's world frame."""
    content = {
        "labels": [found.names.map_name(k) for k in range(len(found.names))],
        "up_world": _rounded(found.up_world),
        "floor_m": None if np.isnan(found.floor_m) else round(float(found.floor_m), 6),
        "objects": [_as_json(o, found) for o in found.objects],
    }
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _as_json(o: MapObject, found: MapObjects) -> dict[str, Any]:
    likely = [k for k in np.argsort(-o.distribution).tolist()[:5] if o.distribution[k] >= 0.001]
    return {
        "id": o.id,
        "label": found.names.map_name(o.label),
        "probability": round(float(o.distribution[o.label]), 5),
        "distribution": {
            found.names.map_name(k): round(float(o.distribution[k]), 5) for k in likely
        },
        "centroid_world_m": _rounded(o.centroid_world),
        "box": {
            "centre_world_m": _rounded(o.box.T_world_box[:3, 3]),
            "axes_world": [_rounded(axis) for axis in o.box.T_world_box[:3, :3].T],
            "size_m": _rounded(o.box.size_m),
        },
        "keyframes": o.keyframe_ids[o.keyframe_ids < FIRST_LABEL_VIEW].tolist(),
        "landmarks": o.landmark_ids.tolist(),
        "first_seen_s": round(o.first_seen_s, 6),
        "last_seen_s": round(o.last_seen_s, 6),
    }


def _rounded(values: Array) -> list[float]:
    return [round(float(v), 6) for v in values]


def read_objects(run: Path) -> tuple[tuple[str, ...], list[SavedObject]]:
    """The class names of a run's segmenter, and its objects. Raises InputError as `read_scene`."""
    scene = read_scene(run)
    return scene.names, list(scene.objects)


def read_scene(run: Path) -> SavedScene:
    """The objects of a run, and where up and the floor are.

    Raises:
        InputError: no such folder or file, one that `write_objects` did not make, or up has no
            direction.
    """
    path = run / OBJECTS
    if not run.is_dir():
        raise InputError(f"{run}: no such folder; give that of a run that had a segmenter")
    if not path.is_file():
        raise InputError(f"{path}: no such file; {_WITH_LABELS}")
    content = read_json(path, _ObjectFile, "run again")
    floor_m = np.nan if content.floor_m is None else content.floor_m
    up_world = np.array(content.up_world)
    length = float(np.linalg.norm(up_world))
    if length < _SHORTEST_UP:
        raise InputError(f"{path}: up_world: has no direction, found {up_world}; run again")
    objects = tuple(_saved(o) for o in content.objects)
    return SavedScene(tuple(content.labels), objects, up_world / length, floor_m)


def _saved(o: _Object) -> SavedObject:
    T = np.eye(4)
    T[:3, :3] = np.array(o.box.axes_world).T
    T[:3, 3] = o.box.centre_world_m
    return SavedObject(
        o.id,
        o.label,
        o.probability,
        np.array(o.centroid_world_m),
        OrientedBox(T, np.array(o.box.size_m)),
        np.array(o.keyframes, np.int64),
        np.array(o.landmarks, np.int64),
        o.first_seen_s,
        o.last_seen_s,
    )


def write_boxes(path: Path, found: MapObjects) -> None:
    """Write the edges of the boxes as lines in ASCII PLY, in the colours of the classes."""
    corners = [o.box.corners_world for o in found.objects]
    colours = [class_colour(o.label).round().astype(int).tolist() for o in found.objects]
    count = len(found.objects)
    lines = ["ply", "format ascii 1.0", "comment bmask-slam object boxes, world frame, metres"]
    lines += [f"element vertex {8 * count}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += [f"property uchar {colour}" for colour in ("red", "green", "blue")]
    lines += ["property int object", f"element edge {len(EDGES) * count}"]
    lines += ["property int vertex1", "property int vertex2", "end_header"]
    for o, points, colour in zip(found.objects, corners, colours, strict=True):
        rgb = " ".join(map(str, colour))
        lines += [f"{x:.5f} {y:.5f} {z:.5f} {rgb} {o.id}" for x, y, z in points.tolist()]
    for k in range(count):
        lines += [f"{8 * k + a} {8 * k + b}" for a, b in EDGES.tolist()]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
