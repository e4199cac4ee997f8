"""The layouts that recordings come in, and which of them lies in a folder."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from bmask_slam.evaluation.recordings import is_joined
from bmask_slam.evaluation.reference import TRUTH, read_reference
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError, did_you_mean
from bmask_slam.graph.files.reading import read_lines
from bmask_slam.sequences.bags.bag_file import is_bag
from bmask_slam.sequences.bags.bag_recording import open_bag_recording
from bmask_slam.sequences.bags.topics import split_path
from bmask_slam.sequences.cameras import find_camera
from bmask_slam.sequences.formats.euroc import is_euroc, open_euroc
from bmask_slam.sequences.formats.joined import open_joined
from bmask_slam.sequences.formats.numbered_folders import (
    is_icl_nuim,
    is_open3d,
    is_replica,
    is_scannet,
    is_seven_scenes,
    open_icl_nuim,
    open_open3d,
    open_replica,
    open_scannet,
    open_seven_scenes,
)
from bmask_slam.sequences.formats.phones import is_polycam, is_r3d, open_polycam, open_r3d
from bmask_slam.sequences.formats.repeats import without_repeats
from bmask_slam.sequences.formats.sens_file import is_sens, open_sens
from bmask_slam.sequences.lists import read_lists
from bmask_slam.sequences.recording import Recording

Given = Path | Camera | None
MOST_BESIDE = 1000
"""Names beside one that is not there, among which the one that was meant is looked for."""


class Layout(NamedTuple):
    """How a layout is recognised and opened."""

    is_one: Callable[[Path], bool]
    open: Callable[[Path, Given], Recording]


FOLDERS = (
    Layout(is_icl_nuim, open_icl_nuim),
    Layout(is_seven_scenes, open_seven_scenes),
    Layout(is_scannet, open_scannet),
    Layout(is_replica, open_replica),
    Layout(is_euroc, open_euroc),
    Layout(is_open3d, open_open3d),
    Layout(is_polycam, open_polycam),
)
"""Folders other than TUM's, in the order in which they are tried. TUM's lists win over all but
ICL-NUIM."""
FILES = (
    Layout(is_sens, open_sens),
    Layout(is_r3d, open_r3d),
    Layout(is_joined, lambda path, camera: open_joined(path, camera, open_recording)),
)
_LISTS = ("rgb.txt", "depth.txt", "associations.txt")


def is_recording_file(path: Path) -> bool:
    """Whether a path names a recording that is one file, or a bag; it need not be there."""
    bag, _ = split_path(path)
    return is_bag(bag) or any(layout.is_one(path) for layout in FILES)


def is_recording_folder(path: Path) -> bool:
    """Whether it is the folder of a recording: with a list of TUM's, a bag, or another layout."""
    listed = any((path / name).is_file() for name in _LISTS)
    return listed or is_bag(path) or any(layout.is_one(path) for layout in FOLDERS)


def open_recording(path: Path, camera: Given = None) -> Recording:
    """Open what lies at a path, in any layout of docs/data.md, without images that were repeated.

    Raises:
        InputError: nothing there, no known layout, a name that is no UTF-8, or files that are
            broken.
    """
    try:
        str(path.absolute()).encode()
    except UnicodeEncodeError as error:
        name = repr(str(path))
        raise InputError(f"{name}: its name, or one above, is not UTF-8; rename it") from error
    return without_repeats(_open(path, camera))


def _open(path: Path, camera: Given) -> Recording:
    """What lies at a path. Raises InputError."""
    bag, _ = split_path(path)
    if is_bag(bag):
        return open_bag_recording(path, camera)
    for layout in FILES:
        if layout.is_one(path):
            if not path.is_file():
                raise InputError(f"{path}: is no plain file; give a recording of docs/data.md")
            return layout.open(path, camera)
    if path.is_file():
        raise InputError(
            f"{path}: a file, and no recording of docs/data.md by its name; give the folder that "
            "holds rgb.txt"
        )
    if not path.is_dir():
        if bag != path and bag.exists():
            raise InputError(f"{bag}: is no ROS bag; leave --rgb-topic and other topics out")
        beside: list[str] = []
        with suppress(OSError):  # no folder either, or one that may not be read
            beside = [other.name for other in islice(path.parent.iterdir(), MOST_BESIDE)]
        near = did_you_mean(path.name, beside)
        raise InputError(
            f"{path}: no such folder; give the folder that holds rgb.txt, or a recording in "
            f"another layout of docs/data.md{near}"
        )
    for layout in FOLDERS:
        if layout.is_one(path) and (layout.open is open_icl_nuim or not _has_lists(path)):
            return layout.open(path, camera)
    return _open_tum(path, camera)


def _has_lists(folder: Path) -> bool:
    """Whether it has a list of TUM's; associations.txt is one by the four columns of a line."""
    if any((folder / name).is_file() for name in _LISTS[:2]):
        return True
    path = folder / _LISTS[2]
    rows = read_lines(path, "restore it") if path.is_file() else iter(())
    _, first = next(rows, (0, ""))
    return len(first.split()) == 4


def _open_tum(folder: Path, given: Given) -> Recording:
    """A folder in the layout of the TUM RGB-D benchmark. Raises InputError."""
    if not any((folder / name).is_file() for name in _LISTS):
        raise InputError(
            f"{folder}: no such list as rgb.txt, depth.txt or associations.txt, and none of the "
            "other layouts of docs/data.md; a sequence needs rgb.txt and depth.txt with lines "
            "'timestamp file'"
        )
    camera, source = (given, "given") if isinstance(given, Camera) else find_camera(folder, given)
    lists = read_lists(folder)
    truth = read_reference(folder) if (folder / TRUTH).is_file() else None
    return Recording("TUM", folder, *lists, camera, source, truth)
