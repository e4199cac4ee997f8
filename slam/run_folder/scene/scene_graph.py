"""The scene of a run for other programs: a scene graph as JSON, objects as coloured points."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError, finite_number
from bmask_slam.graph.files.ply import POINTS, read_ply, write_ply
from bmask_slam.graph.files.reading import read_table
from bmask_slam.graph.files.whole_file import whole_file
from bmask_slam.run_folder.landmark_file import LANDMARKS
from bmask_slam.run_folder.object_picture import distinct_colour
from bmask_slam.run_folder.scene.query import finished_scene
from bmask_slam.run_folder.semantic_files import LABELS, SavedObject, SavedScene
from bmask_slam.semantics.objects.boxes3d import OrientedBox, box_around
from bmask_slam.semantics.objects.relations import relations

FORMAT = "bmask-slam scene graph, version 1"
OBJECTS_COMMENT = "bmask-slam landmarks on objects, world frame, metres; id: of the object"
_WITHIN = 0.01
"""Share of landmarks that may lie outside the room, on each side."""
_FEW = 10
"""A surface needs so many landmarks."""
SURFACES = (
    "wall", "floor", "ceiling", "cabinet", "counter", "table", "desk", "door", "window", "shelves",
    "whiteboard", "curtain", "blinds",
)  # fmt: skip
"""Labels of landmarks that are surfaces of the room, where the segmenter has them."""


def write_scene_graph(run: Path, out: Path) -> str:
    """Write room, surfaces, objects and their relations; returns a text on what was written.

    Metres, in the run's world frame; boxes stand upright. The room is the box around nearly all
    landmarks. Raises InputError for a run without objects or landmarks.
    """
    scene, points = finished_scene(run), _landmarks(run)
    found = relations([o.box for o in scene.objects], scene.up_world)
    inner = _within(points, scene.up_world)
    surfaces = _surfaces(run, scene, points)
    content = {
        "format": FORMAT,
        "frame": "world: the camera of the run's first keyframe; metres",
        "up": _rounded(scene.up_world),
        "room": {
            "box": None if inner is None else _box(inner),
            "floor_height_along_up_m": None if np.isnan(scene.floor_m) else scene.floor_m,
            "landmarks": len(points),
        },
        "surfaces": surfaces,
        "objects": [_object(o) for o in scene.objects],
        "relations": [
            {
                "subject": scene.objects[r.subject].id,
                "relation": r.kind,
                "object": scene.objects[r.object].id,
            }
            for r in found
        ],
    }
    with whole_file(out) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return (
        f"a room, {len(surfaces)} surfaces, {len(scene.objects)} objects, {len(found)} relations "
        "(JSON; metres, world frame)"
    )


def write_object_points(run: Path, out: Path) -> str:
    """Write the landmarks on objects as PLY, a colour an object; returns a text on them.

    Raises:
        InputError: a run without objects or landmarks, or no landmark lies on an object.
    """
    scene = finished_scene(run)
    columns = read_ply(run / LANDMARKS, (*POINTS[:3], "id"))
    ids, points, colours, owners = columns["id"], [], [], []
    for number, o in enumerate(scene.objects):
        own = np.isin(ids, o.landmarks)
        points.append(np.stack([columns[axis][own] for axis in "xyz"], axis=1))
        colour = np.rint(255 * np.array(distinct_colour(number))).astype(np.uint8)
        colours.append(np.tile(colour, (int(own.sum()), 1)))
        owners.append(np.full(int(own.sum()), o.id, np.int32))
    if not sum(map(len, owners)):
        raise InputError(f"{run}: no landmark lies on an object; give a run that found some")
    x, y, z = np.concatenate(points).T.astype(np.float32)
    red, green, blue = np.concatenate(colours).T
    named = {"x": x, "y": y, "z": z, "red": red, "green": green, "blue": blue}
    write_ply(out, {**named, "id": np.concatenate(owners)}, OBJECTS_COMMENT)
    names = ", ".join(f"{o.id} {o.label}" for o in scene.objects)
    return f"{len(x)} landmarks on objects: x y z in metres, colour and id of the object\n{names}"


def _object(o: SavedObject) -> dict[str, Any]:
    return {
        "id": o.id,
        "label": o.label,
        "probability": o.probability,
        "centroid": _rounded(o.centroid_world),
        "box": _box(o.box),
        "keyframes": len(o.keyframes),
        "first_seen_s": o.first_seen_s,
        "last_seen_s": o.last_seen_s,
    }


def _landmarks(run: Path) -> Array:
    columns = read_ply(run / LANDMARKS, POINTS[:3])
    return np.stack([columns[axis] for axis in "xyz"], axis=1).astype(float)


def _within(points_world: Array, up_world: Array) -> OrientedBox | None:
    """The upright box around points (N, 3) without the outermost ones; None for no points."""
    if not len(points_world):
        return None
    axes = box_around(points_world, up_world).T_world_box[:3, :3]
    local = points_world @ axes
    low, high = np.quantile(local, [_WITHIN, 1 - _WITHIN], axis=0)
    inner = ((local >= low) & (local <= high)).all(axis=1)
    return box_around(points_world[inner] if inner.any() else points_world, up_world)


def _surfaces(run: Path, scene: SavedScene, points_world: Array) -> list[dict[str, Any]]:
    """Label, number of landmarks, mean probability and box of all that lies on each surface.

    Raises:
        InputError: labels.csv is not of these landmarks, or has a probability that is no number.
    """
    table = run / LABELS
    columns = read_table(table, ("label", "probability"), "run again")
    names = np.array(columns.get("surface", columns["label"]))
    if len(names) != len(points_world):
        raise InputError(
            f"{table}: {len(names)} lines, but {len(points_world)} landmarks; run again"
        )
    texts = columns.get("surface_probability", columns["probability"])
    sure = np.array([finite_number(p, f"{table}: line {n}") for n, p in enumerate(texts, 2)])
    found = []
    for name in sorted(set(names.tolist()) & set(SURFACES)):
        own = names == name
        box = _within(points_world[own], scene.up_world)
        if own.sum() >= _FEW and box is not None:
            probability = round(float(sure[own].mean()), 4)
            row = {"label": name, "landmarks": int(own.sum()), "probability": probability}
            found.append({**row, "box": _box(box)})
    return found


def _box(box: OrientedBox) -> dict[str, Any]:
    return {
        "centre": _rounded(box.T_world_box[:3, 3]),
        "axes": [_rounded(axis) for axis in box.T_world_box[:3, :3].T],
        "size": _rounded(box.size_m),
    }


def _rounded(values: Array) -> list[float]:
    return [round(float(v), 4) for v in values]
