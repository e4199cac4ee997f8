"""The g2o text format of pose graphs: VERTEX_SE2, EDGE_SE2, VERTEX_SE3:QUAT, EDGE_SE3:QUAT, FIX.

Orders at the file boundary, and nowhere else: quaternions x y z w; the upper triangle of the
information matrix row by row, in 3-D of [translation, rotation], where arrays here have
[rotation, translation]. Rotational information is taken per radian, as GTSAM and most who write
such files do; g2o's own 3-D edge measures half angles (the quaternion's vector part).
"""

from __future__ import annotations

import logging
import os
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from graph.errors import InputError, finite_number
from graph.geometry import Array, make_pose, quaternion_from_rotation, rotation_from_quaternion
from graph.pose_graph import (
    PoseGraph,
    component_labels,
    planar_coordinates,
    planar_poses,
)
from graph.trajectory import Indices

logger = logging.getLogger(__name__)

_IDS = {"VERTEX_SE2": 1, "VERTEX_SE3:QUAT": 1, "EDGE_SE2": 2, "EDGE_SE3:QUAT": 2}
_NUMBERS = {"VERTEX_SE2": 3, "VERTEX_SE3:QUAT": 7, "EDGE_SE2": 3 + 6, "EDGE_SE3:QUAT": 7 + 21}
_ROTATION_FIRST = np.array([3, 4, 5, 0, 1, 2])  # its own inverse
_MAX_ID = 2**63 - 1


@dataclass(frozen=True)
class _Rows:
    """The lines of one tag: ids (1 or 2 a line), numbers, and line numbers in the file."""

    ids: list[list[int]] = field(default_factory=list)
    numbers: list[list[float]] = field(default_factory=list)
    lines: list[int] = field(default_factory=list)


def read_g2o(path: Path) -> PoseGraph:
    """Read a 2-D or 3-D pose graph; of one that is not connected, the largest part.

    Lines with other tags are left out, with one warning a tag. A file of edges alone gives a graph
    with ``has_poses`` false.

    Raises:
        InputError: naming file and line: a wrong number of columns, a value that is no finite
            number, a vertex twice or missing, an information matrix that is not positive definite,
            2-D and 3-D mixed; or no file, or no edge in it.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; give a pose graph in g2o format")
    rows, fixed = _read_rows(path)
    planar, spatial = (any(rows[tag].ids for tag in rows if kind in tag) for kind in ("SE2", "SE3"))
    if planar and spatial:
        lines = [rows[tag].lines[0] for tag in rows if "SE3" in tag and rows[tag].lines]
        raise InputError(f"{path}:{min(lines)}: 3-D in a file that also has SE2 tags; split it")
    vertices = rows["VERTEX_SE2" if planar else "VERTEX_SE3:QUAT"]
    edges = rows["EDGE_SE2" if planar else "EDGE_SE3:QUAT"]
    if not edges.ids:
        raise InputError(f"{path}: no EDGE_SE2 or EDGE_SE3:QUAT line; nothing to optimise")
    ids, order = _vertex_ids(vertices, edges, path)
    edge_rows = _edge_indices(edges, ids, path)
    given = np.array(vertices.numbers)[order] if vertices.ids else None
    size = 3 if planar else 7
    numbers = np.array(edges.numbers)
    graph = PoseGraph(
        ids=ids,
        poses=np.tile(np.eye(4), (len(ids), 1, 1)) if given is None else _poses(given),
        edges=edge_rows,
        measurements=_poses(numbers[:, :size]),
        information=_information(numbers[:, size:], edges, path),
        fixed=np.isin(ids, _known_fixed(fixed, ids, path, given is not None)),
        has_poses=given is not None,
    )
    return _largest_part(graph, path)


def write_g2o(path: Path, graph: PoseGraph) -> None:
    """Write a graph as ``read_g2o`` reads it; the file appears whole or not at all."""
    path = Path(path)
    kind = "SE2" if graph.is_planar else "SE3:QUAT"
    lines = [
        f"VERTEX_{kind} {i} {_text(p)}"
        for i, p in zip(graph.ids, _columns(graph.poses, graph.is_planar), strict=True)
    ]
    lines += [f"FIX {i}" for i in graph.ids[graph.fixed]]
    information = graph.information
    if not graph.is_planar:
        information = information[:, _ROTATION_FIRST[:, None], _ROTATION_FIRST]
    upper = information[(slice(None), *np.triu_indices(information.shape[-1]))]
    numbers = np.hstack([_columns(graph.measurements, graph.is_planar), upper])
    names = graph.ids[graph.edges]
    lines += [f"EDGE_{kind} {i} {j} {_text(n)}" for (i, j), n in zip(names, numbers, strict=True)]
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_text("\n".join(lines) + "\n", encoding="ascii", newline="\n")
    os.replace(temporary, path)


def _text(numbers: Array) -> str:
    return " ".join(f"{number:.15g}" for number in numbers.tolist())


def _columns(T: Array, planar: bool) -> Array:
    """(K, 3) x y angle, or (K, 7) position and quaternion x y z w, of transforms (K, 4, 4)."""
    if planar:
        return planar_coordinates(T)
    return np.hstack([T[:, :3, 3], quaternion_from_rotation(T[:, :3, :3])])


def _poses(columns: Array) -> Array:
    """The inverse of ``_columns``."""
    if columns.shape[1] == 3:
        return planar_poses(columns)
    return make_pose(rotation_from_quaternion(columns[:, 3:]), columns[:, :3])


# --- reading -------------------------------------------------------------------------------------


def _read_rows(path: Path) -> tuple[dict[str, _Rows], dict[int, int]]:
    """Lines of the known tags, and line numbers of FIX by vertex id."""
    rows = {tag: _Rows() for tag in _IDS}
    fixed: dict[int, int] = {}
    unknown: Counter[str] = Counter()
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        tag, where = words[0], f"{path}:{number}"
        if tag in rows:
            ids, numbers = _row(words, where)
            rows[tag].ids.append(ids)
            rows[tag].numbers.append(numbers)
            rows[tag].lines.append(number)
        elif tag == "FIX":
            fixed.update({_id(word, where): number for word in words[1:]})
        else:
            unknown[tag] += 1
    for tag, count in unknown.items():
        logger.warning("%s: %d lines of the unknown type %s left out", path, count, tag[:40])
    return rows, fixed


def _row(words: list[str], where: str) -> tuple[list[int], list[float]]:
    """Ids and numbers of one vertex or edge line."""
    tag, ids = words[0], _IDS[words[0]]
    expected = ids + _NUMBERS[tag]
    if len(words) - 1 != expected:
        raise InputError(
            f"{where}: {len(words) - 1} values after {tag}, expected {expected}; correct the line"
        )
    names = [_id(word, where) for word in words[1 : 1 + ids]]
    numbers = [finite_number(word, where) for word in words[1 + ids :]]
    if "QUAT" in tag and sum(q * q for q in numbers[3:7]) < 1e-12:
        raise InputError(f"{where}: a zero quaternion is no rotation; correct or remove the line")
    if ids == 2 and names[0] == names[1]:
        raise InputError(f"{where}: an edge from vertex {names[0]} to itself; remove the line")
    return names, numbers


def _id(word: str, where: str) -> int:
    """The vertex id that a word is."""
    if not (word.isascii() and word.isdigit() and int(word) <= _MAX_ID):
        raise InputError(f"{where}: {word[:40]!r} is no vertex id; ids are whole numbers from 0 on")
    return int(word)


def _vertex_ids(vertices: _Rows, edges: _Rows, path: Path) -> tuple[Indices, Indices]:
    """Sorted ids (N,), and the vertex line (N,) of each; without vertex lines the edges' ids."""
    if not vertices.ids:
        ids = np.unique(np.array(edges.ids, np.int64))
        return ids, np.zeros(0, np.int64)
    ids, first = np.unique(np.array(vertices.ids, np.int64)[:, 0], return_index=True)
    if len(ids) < len(vertices.ids):
        again = np.setdiff1d(np.arange(len(vertices.ids)), first)[0]
        where = f"{path}:{vertices.lines[again]}"
        raise InputError(f"{where}: vertex {vertices.ids[again][0]} is there twice; remove one")
    return ids, first


def _edge_indices(edges: _Rows, ids: Indices, path: Path) -> Indices:
    """Rows (M, 2) into ``ids``."""
    names = np.array(edges.ids, np.int64)
    missing = ~np.isin(names, ids)
    if missing.any():
        k, side = np.argwhere(missing)[0]
        raise InputError(
            f"{path}:{edges.lines[k]}: an edge to vertex {names[k, side]}, which the file does not "
            "have; add the vertex or remove the edge"
        )
    return np.searchsorted(ids, names)


def _information(triangles: Array, edges: _Rows, path: Path) -> Array:
    """Matrices (M, d, d) from their upper triangles, in the order of ``PoseGraph``."""
    d = 3 if triangles.shape[1] == 6 else 6
    rows, columns = np.triu_indices(d)
    matrices = np.zeros((len(triangles), d, d))
    matrices[:, rows, columns] = matrices[:, columns, rows] = triangles
    smallest = np.linalg.eigvalsh(matrices)[:, 0]
    if (smallest <= 0).any():
        k = int(np.argmax(smallest <= 0))
        raise InputError(
            f"{path}:{edges.lines[k]}: an information matrix that is not positive definite "
            f"(smallest eigenvalue {smallest[k]:.3g}); correct or remove the edge"
        )
    return matrices if d == 3 else matrices[:, _ROTATION_FIRST[:, None], _ROTATION_FIRST]


def _known_fixed(fixed: dict[int, int], ids: Indices, path: Path, has_poses: bool) -> list[int]:
    known = set(ids.tolist())
    for name, line in fixed.items():
        if name not in known:
            raise InputError(f"{path}:{line}: FIX {name}, a vertex that is not there; remove it")
    if len(fixed) > 1 and not has_poses:
        line = max(fixed.values())
        raise InputError(f"{path}:{line}: several FIX without vertex lines; add their poses")
    return list(fixed)


def _largest_part(graph: PoseGraph, path: Path) -> PoseGraph:
    labels = component_labels(graph)
    sizes = np.bincount(labels)
    if len(sizes) == 1:
        return graph
    part = graph.with_vertices(labels == np.argmax(sizes))
    logger.warning(
        "%s: %d parts that no edge connects; the largest is taken, %d vertices are left out",
        path,
        len(sizes),
        len(graph.ids) - len(part.ids),
    )
    return part
