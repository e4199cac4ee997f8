"""The g2o text format of pose graphs: VERTEX_SE2, EDGE_SE2, VERTEX_SE3:QUAT, EDGE_SE3:QUAT, FIX.

The orders of their columns are in ``graph.g2o.lines``; other dialects in ``graph.g2o.dialects``;
graphs with landmarks in ``graph.g2o.landmark_graphs``.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from bmask_slam.graph.arrays import Ints
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.g2o.lines import (
    Rows,
    Tag,
    indices_of,
    information_columns,
    information_matrices,
    numbers_text,
    pose_columns,
    poses_of_columns,
    read_rows,
    vertex_ids,
    write_lines,
)
from bmask_slam.graph.pose_graph.pose_graph import PoseGraph, component_labels

logger = logging.getLogger(__name__)

_TAGS = {
    "VERTEX_SE2": Tag(1, 3),
    "VERTEX_SE3:QUAT": Tag(1, 7, 3),
    "EDGE_SE2": Tag(2, 3 + 6),
    "EDGE_SE3:QUAT": Tag(2, 7 + 21, 3),
}


def read_g2o(path: Path, repair: bool = False) -> PoseGraph:
    """Read a 2-D or 3-D pose graph; if it is not connected, its largest component.

    Other dialects are read too (``graph.g2o.dialects``); lines with unknown tags are left out, with
    one warning a tag. A file of edges alone gives a graph with ``has_poses`` false. ``repair``
    replaces information matrices that are not positive definite by the nearest that are.

    Raises:
        InputError: naming file and line: a wrong number of columns, a value that is no finite
            number, a vertex twice or missing, an information matrix that is not positive definite,
            2-D and 3-D mixed; or no file, or no edge in it.
    """
    path = Path(path)
    rows, fixed = read_rows(path, _TAGS)
    planar, spatial = (any(rows[tag].ids for tag in rows if kind in tag) for kind in ("SE2", "SE3"))
    if planar and spatial:
        lines = [rows[tag].lines[0] for tag in rows if "SE3" in tag and rows[tag].lines]
        raise InputError(f"{path}:{min(lines)}: 3-D in a file that also has SE2 tags; split it")
    vertices = rows["VERTEX_SE2" if planar else "VERTEX_SE3:QUAT"]
    edges = rows["EDGE_SE2" if planar else "EDGE_SE3:QUAT"]
    if not edges.ids:
        raise InputError(f"{path}: no EDGE_SE2 or EDGE_SE3:QUAT line; nothing to optimise")
    names = pairs_of(edges, path)
    ids, order = vertex_ids(vertices, path) if len(vertices) else (np.unique(names), None)
    edge_rows = indices_of(names, edges.lines, ids, path)
    given = None if order is None else poses_of_columns(np.array(vertices.numbers)[order])
    size = 3 if planar else 7
    numbers = np.array(edges.numbers)
    graph = PoseGraph(
        ids=ids,
        poses=np.tile(np.eye(4), (len(ids), 1, 1)) if given is None else given,
        edges=edge_rows,
        measurements=poses_of_columns(numbers[:, :size]),
        information=information_matrices(numbers[:, size:], edges.lines, path, repair),
        fixed=np.isin(ids, _known_fixed(fixed, ids, path, given is not None)),
        has_poses=given is not None,
    )
    return _largest_part(graph, path)


def write_g2o(path: Path, graph: PoseGraph) -> None:
    """Write a graph as ``read_g2o`` reads it; the file appears whole or not at all."""
    kind = "SE2" if graph.is_planar else "SE3:QUAT"
    lines = [
        f"VERTEX_{kind} {i} {numbers_text(p)}"
        for i, p in zip(graph.ids, pose_columns(graph.poses, graph.is_planar), strict=True)
    ]
    lines += [f"FIX {i}" for i in graph.ids[graph.fixed]]
    measured = pose_columns(graph.measurements, graph.is_planar)
    numbers = np.hstack([measured, information_columns(graph.information)])
    names = graph.ids[graph.edges]
    lines += [
        f"EDGE_{kind} {i} {j} {numbers_text(n)}" for (i, j), n in zip(names, numbers, strict=True)
    ]
    write_lines(Path(path), lines)


def pairs_of(edges: Rows, path: Path) -> Ints:
    """Ids (M, 2) that edges join. Raises InputError for an edge from a vertex to itself."""
    names = np.array(edges.ids, np.int64).reshape(-1, 2)
    if (names[:, 0] == names[:, 1]).any():
        k = int(np.argmax(names[:, 0] == names[:, 1]))
        raise InputError(
            f"{path}:{edges.lines[k]}: an edge from vertex {names[k, 0]} to itself; remove the line"
        )
    return names


def _known_fixed(fixed: dict[int, int], ids: Ints, path: Path, has_poses: bool) -> list[int]:
    check_fixed(fixed, ids, path)
    if len(fixed) > 1 and not has_poses:
        line = max(fixed.values())
        raise InputError(f"{path}:{line}: several FIX without vertex lines; add their poses")
    return list(fixed)


def check_fixed(fixed: dict[int, int], ids: Ints, path: Path) -> None:
    """Refuse a FIX of a vertex that is not among ``ids``."""
    known = set(ids.tolist())
    for name, line in fixed.items():
        if name not in known:
            raise InputError(f"{path}:{line}: FIX {name}, a vertex that is not there; remove it")


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
