"""The image lists of a TUM folder: rgb.txt and depth.txt, or associations.txt."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePosixPath

import numpy as np

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.errors import InputError, finite_number
from bmask_slam.graph.files.file_names import check_name
from bmask_slam.graph.files.reading import read_lines
from bmask_slam.graph.trajectory import associate_stamps, check_seconds, nearest_indices

logger = logging.getLogger(__name__)

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
MAX_DEPTH_STEP_S = 0.1
"""Largest time between two depth images for interpolation between them."""
HALF_INTERVAL = 0.55
"""Of the interval between depth images: stamps are not quite regular."""
MIN_IN_ORDER, MIN_MIXED, MAX_SET_BACKS = 10, 5, 5
"""A clock was set back where so many images before and after that are in order, so many of those
after it share the time of those before, and it happened at most so often."""


@dataclass(frozen=True, eq=False)
class ImageList:
    """Stamped image files, sorted by stamp, each stamp once.

    Attributes:
        timestamps_s: (N,) increasing.
        files: the N images.
        unordered: how many stood behind one with a later stamp.
        repeated: how many were left out since another has their stamp.
        copies: how many repeat the image before, if these stayed.
        warnings: what makes stamps or images doubtful, each with a cure.
    """

    timestamps_s: Array
    files: tuple[Path, ...]
    unordered: int = 0
    repeated: int = 0
    copies: int = 0
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class ImagePairs:
    """Colour and depth images that belong together, sorted by the colour image's stamp.

    Attributes:
        timestamps_s: (N,) stamps of the colour images in seconds.
        rgb_files: the N colour images.
        depth_files: the N depth images.
        lags_s: (N,) capture time of each depth image minus that of its colour image.
        neighbour_files: the next depth images on the other side of the colour images' stamps, None
            where there is none.
        neighbour_shares: (N,) position of the colour images' stamps between the depth image (0) and
            its neighbour (1).
        unpaired_rgb: number of colour images without a depth image near enough in time.
        unpaired_depth: number of depth images without a colour image near enough in time.
    """

    timestamps_s: Array
    rgb_files: tuple[Path, ...]
    depth_files: tuple[Path, ...]
    lags_s: Array
    neighbour_files: tuple[Path | None, ...]
    neighbour_shares: Array
    unpaired_rgb: int = 0
    unpaired_depth: int = 0


def image_name(path: Path, folder: Path) -> str:
    """An image's path relative to a folder; the file name alone if it is outside."""
    inside = path.is_relative_to(folder)
    return (path.relative_to(folder) if inside else Path(path.name)).as_posix()


def colour_images(source: Path) -> list[tuple[str, Path]]:
    """Name relative to ``source`` and path of each colour image, ordered by stamp or name.

    Raises:
        InputError: there are no images.
    """
    if (source / "rgb.txt").is_file():
        files = list(read_list(source / "rgb.txt").files)
    elif (source / "associations.txt").is_file():
        files = list(read_associations(source / "associations.txt")[0].files)
    elif source.is_dir():
        files = sorted(p for p in source.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES)
    else:
        raise InputError(f"{source}: no such folder; give a sequence or a folder of images")
    if not files:
        raise InputError(f"{source}: no image in it; give a sequence or a folder of png or jpg")
    return [(image_name(path, source), path) for path in files]


def read_lists(folder: Path) -> tuple[ImageList, ImageList]:
    """Colour and depth images of a TUM folder; rgb.txt and depth.txt win over associations.txt.

    Raises:
        InputError: a missing or broken list.
    """
    if (folder / "rgb.txt").is_file() and (folder / "depth.txt").is_file():
        return read_list(folder / "rgb.txt"), read_list(folder / "depth.txt")
    if (folder / "associations.txt").is_file():
        return read_associations(folder / "associations.txt")
    missing = "rgb.txt" if not (folder / "rgb.txt").is_file() else "depth.txt"
    raise InputError(
        f"{folder / missing}: no such list; a sequence needs rgb.txt and depth.txt with lines "
        "'timestamp file', or associations.txt with 'timestamp rgb timestamp depth'"
    )


def read_pairs(folder: Path, max_difference_s: float, depth_time_offset_s: float) -> ImagePairs:
    """The image pairs of a TUM folder. Raises InputError as ``read_lists`` and ``pair_images``."""
    return pair_images(*read_lists(folder), max_difference_s, depth_time_offset_s, folder)


def pair_images(
    rgb: ImageList,
    depth: ImageList,
    max_difference_s: float,
    depth_time_offset_s: float,
    folder: Path,
) -> ImagePairs:
    """Pair colour and depth by nearest stamp, one to one where there is no offset.

    The capture time of a depth image, by which it is paired, is its stamp plus the offset. With an
    offset no colour image lies further than half an interval from depth, whatever the limit, and
    two may share a depth image: it is interpolated for each.

    Raises:
        InputError: no two stamps within the limit; ``folder`` begins the text.
    """
    depth_s = depth.timestamps_s + depth_time_offset_s
    if depth_time_offset_s:
        max_difference_s = max(max_difference_s, half_interval_s(np.diff(depth_s)))
        i, j = _nearest_pairs(rgb.timestamps_s, depth_s, max_difference_s)
    else:
        i, j = associate_stamps(rgb.timestamps_s, depth_s, max_difference_s)
    if not len(i):
        raise InputError(
            f"{folder}: no colour and depth image within {max_difference_s:g} s of each other "
            f"(colour begins at {rgb.timestamps_s[0]:.6f} s, depth at "
            f"{depth_s[0]:.6f} s); bring both lists to the same clock"
        )
    lags_s = depth_s[j] - rgb.timestamps_s[i]
    neighbours, shares = _neighbours(depth_s, j, lags_s)
    return ImagePairs(
        rgb.timestamps_s[i],
        tuple(rgb.files[k] for k in i),
        tuple(depth.files[k] for k in j),
        lags_s,
        tuple(depth.files[k] if k >= 0 else None for k in neighbours),
        shares,
        len(rgb.files) - len(i),
        len(depth.files) - len(np.unique(j)),
    )


def _nearest_pairs(rgb_s: Array, depth_s: Array, max_difference_s: float) -> tuple[Ints, Ints]:
    """Indices of colour images (N,), and for each of its nearest depth image, if within a limit."""
    nearest = nearest_indices(depth_s, rgb_s)
    near = np.flatnonzero(np.abs(depth_s[nearest] - rgb_s) <= max_difference_s)
    return near, nearest[near]


def half_interval_s(steps_s: Array) -> float:
    """A little more than half of the usual step (N,) of depth images; 0 without any."""
    return HALF_INTERVAL * float(np.median(steps_s)) if len(steps_s) else 0.0


def _neighbours(depth_s: Array, chosen: Ints, lags_s: Array) -> tuple[Ints, Array]:
    """For each chosen depth image its neighbour on the other side of the time ``lags_s`` before it.

    Returns indices, -1 where it is missing or too far in time, and the position between the two.
    """
    other = chosen - np.sign(lags_s).astype(np.int64)
    in_range = (other >= 0) & (other < len(depth_s)) & (lags_s != 0)
    other = np.where(in_range, other, chosen)
    step_s = np.abs(depth_s[other] - depth_s[chosen])
    in_range &= (step_s < MAX_DEPTH_STEP_S) & (np.abs(lags_s) < step_s)
    shares = np.divide(np.abs(lags_s), step_s, out=np.zeros(len(other)), where=in_range)
    return np.where(in_range, other, -1), shares


def read_list(path: Path) -> ImageList:
    """Read ``timestamp file`` lines in any order; files are relative to the list's folder.

    Raises:
        InputError: an empty list, a line of another form, or stamps that are not finite or not in
            seconds.
    """
    rows = [
        (number, finite_number(columns[0], f"{path}:{number}"), columns[1])
        for number, columns in _lines(path, 2, "timestamp file")
    ]
    return _image_list(path, rows)


def read_associations(path: Path) -> tuple[ImageList, ImageList]:
    """Colour and depth lists from ``timestamp rgb timestamp depth`` lines in any order.

    Lines with the depth image first (TUM's script called with depth.txt before rgb.txt) are
    recognised by their folder names. Raises InputError as ``read_list`` does.
    """
    lines = _lines(path, 4, "timestamp rgb timestamp depth")
    first = [(n, finite_number(c[0], f"{path}:{n}"), c[1]) for n, c in lines]
    second = [(n, finite_number(c[2], f"{path}:{n}"), c[3]) for n, c in lines]
    names = [str(PurePosixPath(rows[0][2])) for rows in (first, second)]  # of ./rgb/0.png too
    if names[0].startswith("depth") and names[1].startswith("rgb"):
        logger.info("%s: depth comes first in the lines", path)
        first, second = second, first
    return _image_list(path, first), _image_list(path, second)


def _lines(path: Path, count: int, form: str) -> list[tuple[int, list[str]]]:
    """Line number and columns of each line that is neither empty nor a comment."""
    lines = []
    for number, line in read_lines(path, f"expected lines of '{form}'"):
        columns = line.split(maxsplit=1) if count == 2 else line.split()
        if len(columns) != count:
            raise InputError(f"{path}:{number}: {line[:60]!r} is not of the form '{form}'")
        lines.append((number, columns))
    if not lines:
        raise InputError(f"{path}: the list is empty; expected lines of '{form}'")
    return lines


def sorted_list(path: Path, stamps_s: Array, files: Sequence[Path]) -> ImageList:
    """A list of images with stamps (N,) in any order; of several with one stamp the first is kept.

    Both are counted, with a warning that names ``path``.

    Raises:
        InputError: stamps that are not in seconds.
    """
    stamps_s = np.asarray(stamps_s, float)
    unordered = int(np.count_nonzero(stamps_s < np.maximum.accumulate(stamps_s)))
    kept_s, first = np.unique(stamps_s, return_index=True)
    repeated = len(stamps_s) - len(first)
    check_seconds(kept_s, path)
    if unordered or repeated:
        text = "%s: %d stamps out of order were sorted, %d repeated ones left out"
        logger.warning(text, path, unordered, repeated)
    found = clock_set_back(path, stamps_s) if unordered else ""
    kept, warnings = tuple(files[k] for k in first), (found,) if found else ()
    return ImageList(kept_s, kept, unordered, repeated, warnings=warnings)


def clock_set_back(path: Path, stamps_s: Array) -> str:
    """Where stamps (N,) as recorded begin again within the time of those before; "" if nowhere.

    A list that somebody shuffled goes back often; pieces that only stand in another order do not
    share any time. Images that a clock gave the same time are of two views, and sorted they
    alternate.
    """
    back = np.flatnonzero(np.diff(stamps_s) < 0) + 1
    pieces_s = np.split(stamps_s, back)
    if len(back) > MAX_SET_BACKS or min(map(len, pieces_s)) < MIN_IN_ORDER:
        return ""
    for before_s, behind_s in pairwise(pieces_s):
        mixed = int(np.count_nonzero((behind_s >= before_s[0]) & (behind_s <= before_s[-1])))
        if mixed >= MIN_MIXED:
            by_s = float(before_s[-1] - behind_s[0])
            return (
                f"{path}: the stamps go back by {by_s:.3f} s behind {before_s[-1]:.6f} s, and "
                f"{mixed} images lie between earlier ones; if the clock was set back there, add "
                "the time to the stamps behind, or run the two parts alone"
            )
    return ""


def _image_list(path: Path, rows: list[tuple[int, float, str]]) -> ImageList:
    """Sort (line, stamp, file) rows by stamp; refuse other units and bad names."""
    for line, _, name in rows:
        check_name(name, f"{path}:{line}")
    return sorted_list(path, np.array([row[1] for row in rows]), [path.parent / r[2] for r in rows])
