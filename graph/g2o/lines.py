"""Lines of g2o files: tags, ids and numbers, and the columns of poses and information.

The file's orders are converted here and nowhere else: quaternions x y z w; the upper triangle of
the information matrix row by row, in 3-D of [translation, rotation], where arrays have [rotation,
translation]. Rotational information is per radian, as in GTSAM and most such files; g2o's own 3-D
edge measures half angles (the quaternion's vector part).
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.errors import InputError, finite_number, is_whole
from bmask_slam.graph.files.reading import read_lines
from bmask_slam.graph.files.whole_file import whole_file
from bmask_slam.graph.g2o.dialects import g2o_words
from bmask_slam.graph.geometry import make_pose, quaternion_from_rotation, rotation_from_quaternion
from bmask_slam.graph.pose_graph.pose_graph import planar_coordinates, planar_poses
from bmask_slam.graph.trajectory import check_quaternion

logger = logging.getLogger(__name__)

MAX_TOLD = 10
"""Unknown types that are named; a file of another kind has one a line."""
LEAST = 1e-9  # eigenvalue of a repaired matrix, of its largest
_ROTATION_FIRST = np.array([3, 4, 5, 0, 1, 2])  # its own inverse


class Tag(NamedTuple):
    """How many ids and numbers follow a tag; the position of a quaternion among the numbers."""

    ids: int
    numbers: int
    quaternion: int | None = None


@dataclass(frozen=True)
class Rows:
    """The lines of one tag: ids, numbers, and line numbers in the file."""

    ids: list[list[int]] = field(default_factory=list)
    numbers: list[list[float]] = field(default_factory=list)
    lines: list[int] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.lines)


def read_rows(
    path: Path, tags: dict[str, Tag], on_comment: Callable[[str, int], None] = lambda text, k: None
) -> tuple[dict[str, Rows], dict[int, int]]:
    """Lines of the given tags, other dialects' among them, and line numbers of FIX by vertex id.

    Lines of other tags are left out, with one warning a tag, at most `MAX_TOLD`. ``on_comment``
    gets each comment line and its number.

    Raises:
        InputError: naming file and line: a wrong number of columns, a value that is no finite
            number, or a zero quaternion; or no file.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; give a run folder, or a graph in g2o format")
    rows = {tag: Rows() for tag in tags}
    fixed: dict[int, int] = {}
    unknown: Counter[str] = Counter()
    for number, line in read_lines(path, "give a graph in g2o format", comments=True):
        where = f"{path}:{number}"
        if line.startswith("#"):
            on_comment(line, number)
            continue
        words = g2o_words(line.split(), where)
        tag = words[0]
        if tag in tags:
            ids, numbers = _row(words, tags[tag], where)
            rows[tag].ids.append(ids)
            rows[tag].numbers.append(numbers)
            rows[tag].lines.append(number)
        elif tag == "FIX":
            fixed.update({_id(word, where): number for word in words[1:]})
        else:
            unknown[tag] += 1
    for tag, count in unknown.most_common(MAX_TOLD):
        logger.warning("%s: %d lines of the unknown type %s left out", path, count, tag[:40])
    if len(unknown) > MAX_TOLD:
        logger.warning("%s: lines of %d more unknown types", path, len(unknown) - MAX_TOLD)
    return rows, fixed


def _row(words: list[str], tag: Tag, where: str) -> tuple[list[int], list[float]]:
    """Ids and numbers of one line."""
    expected = tag.ids + tag.numbers
    if len(words) - 1 != expected:
        raise InputError(
            f"{where}: {len(words) - 1} values after {words[0]}, expected {expected}; correct the "
            "line"
        )
    names = [_id(word, where) for word in words[1 : 1 + tag.ids]]
    numbers = [finite_number(word, where) for word in words[1 + tag.ids :]]
    first = tag.quaternion
    if first is not None:
        check_quaternion(numbers[first : first + 4], where)
    return names, numbers


def _id(word: str, where: str) -> int:
    """The vertex id in a word."""
    if not is_whole(word):
        raise InputError(f"{where}: {word[:40]!r} is no vertex id; ids are whole numbers from 0 on")
    return int(word)


def vertex_ids(vertices: Rows, path: Path) -> tuple[Ints, Ints]:
    """Sorted ids (N,), and the vertex line (N,) of each. Raises InputError for an id twice."""
    names = np.array(vertices.ids, np.int64).reshape(-1, 1)[:, 0]
    ids, first = np.unique(names, return_index=True)
    if len(ids) < len(names):
        again = np.setdiff1d(np.arange(len(names)), first)[0]
        where = f"{path}:{vertices.lines[again]}"
        raise InputError(f"{where}: vertex {names[again]} is there twice; remove one")
    return ids, first


def indices_of(names: Ints, lines: list[int], ids: Ints, path: Path) -> Ints:
    """Rows (M, ...) into sorted ``ids`` of the vertices (M, ...) that edges name."""
    missing = ~np.isin(names, ids)
    if missing.any():
        where = np.argwhere(missing)[0]
        raise InputError(
            f"{path}:{lines[where[0]]}: an edge to vertex {names[tuple(where)]}, which the file "
            "does not have; add the vertex or remove the edge"
        )
    return np.searchsorted(ids, names)


def information_matrices(
    triangles: Array, lines: list[int], path: Path, repair: bool = False
) -> Array:
    """Matrices (M, d, d) from upper triangles; of six columns, rotation first.

    With ``repair`` those that are not positive definite become the nearest (Frobenius norm; Higham,
    1988) whose eigenvalues are at least ``LEAST`` of the largest, with a warning.

    Raises:
        InputError: there are some, and ``repair`` is false.
    """
    d = 3 if triangles.shape[1] == 6 else 6
    rows, columns = np.triu_indices(d)
    matrices = np.zeros((len(triangles), d, d))
    matrices[:, rows, columns] = matrices[:, columns, rows] = triangles
    smallest, *_, largest = np.linalg.eigvalsh(matrices).T
    wrong = np.flatnonzero(smallest <= 0)
    if len(wrong):
        some = ", ".join(f"{lines[k]} ({smallest[k]:.3g})" for k in wrong[:5])
        what = f"{len(wrong)} of {len(lines)}"
        where = f"in lines (smallest eigenvalue) {some}{', ...' if len(wrong) > 5 else ''}"
        if not repair:
            raise InputError(
                f"{path}:{lines[wrong[0]]}: an information matrix that is not positive definite; "
                f"{what} are not, {where}; correct them, or take the nearest ones by --repair"
            )
        logger.warning(
            "%s: %s information matrices are not positive definite and were replaced by the "
            "nearest ones that are, %s",
            path,
            what,
            where,
        )
        matrices[wrong] = _nearest_definite(matrices[wrong], float(np.median(largest)))
    return matrices if d == 3 else matrices[:, _ROTATION_FIRST[:, None], _ROTATION_FIRST]


def _nearest_definite(matrices: Array, typical: float) -> Array:
    """The nearest symmetric matrices (K, d, d) whose eigenvalues have the least that is allowed."""
    values, vectors = np.linalg.eigh(matrices)
    least = LEAST * np.maximum(values[:, -1:], max(typical, LEAST))
    return np.asarray((vectors * np.maximum(values, least)[:, None]) @ np.swapaxes(vectors, 1, 2))


def information_columns(information: Array) -> Array:
    """The inverse of ``information_matrices``: (M, 6 or 21)."""
    if information.shape[-1] == 6:
        information = information[:, _ROTATION_FIRST[:, None], _ROTATION_FIRST]
    return information[(slice(None), *np.triu_indices(information.shape[-1]))]


def pose_columns(T: Array, planar: bool = False) -> Array:
    """(K, 3) x y angle, or (K, 7) position and quaternion x y z w, of transforms (K, 4, 4)."""
    if planar:
        return planar_coordinates(T)
    return np.hstack([T[:, :3, 3], quaternion_from_rotation(T[:, :3, :3])])


def poses_of_columns(columns: Array) -> Array:
    """The inverse of ``pose_columns``."""
    if columns.shape[1] == 3:
        return planar_poses(columns)
    return make_pose(rotation_from_quaternion(columns[:, 3:]), columns[:, :3])


def numbers_text(numbers: Array) -> str:
    """Numbers as words, with fifteen digits."""
    return " ".join(f"{number:.15g}" for number in numbers.tolist())


def write_lines(path: Path, lines: Iterable[str]) -> None:
    """Write a file that appears whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="ascii", newline="\n")
