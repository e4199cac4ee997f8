"""A saved map: what a finished run knows, for other runs to go on from or to be localised in."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from bmask_slam.graph.arrays import Arrays
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.array_file import FileKind, read_arrays, write_arrays
from bmask_slam.graph.smoother.storage import read_camera

MAP_FILE = FileKind("map", 4, compressed=True)
MAP = "map"


def write_map(path: Path, state: Arrays, camera: Camera) -> None:
    """Save a system's state, atomically. Raises InputError if it cannot."""
    write_arrays(path, MAP_FILE, {"camera": dataclasses.asdict(camera)}, state)


def read_map(path: Path) -> tuple[Arrays, Camera]:
    """The system's state in a map file, or in that of a run folder.

    Raises:
        InputError: it is missing, foreign, broken, empty or of another version.
    """
    file = path / MAP if path.is_dir() else path
    header, state = read_arrays(file, MAP_FILE)
    if not len(state.get("mapper.world.keyframes.id", ())):
        raise InputError(f"{file}: holds no keyframe; give the map of a run that saw something")
    return state, read_camera(header, file)
