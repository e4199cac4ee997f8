"""Reading g2o files of graphs with landmarks; their format is in ``graph.g2o.landmark_graphs``."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError, finite_number, naming, whole_number
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_update import (
    FIRST_FRAME,
    KERNELS,
    Observations,
    PosePrior,
    RelativePose,
)
from bmask_slam.graph.factors.observability import component_labels
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.g2o.landmark_graphs import (
    CAMERA,
    MARK,
    OFFSET,
    POINT,
    POSE,
    PRIOR,
    RELATIVE,
    STEREO,
    TAGS,
    VIEW,
)
from bmask_slam.graph.g2o.lines import (
    Rows,
    indices_of,
    information_matrices,
    poses_of_columns,
    read_rows,
    vertex_ids,
)
from bmask_slam.graph.g2o.pose_graphs import check_fixed, pairs_of
from bmask_slam.graph.smoother.anchoring import anchor_components

logger = logging.getLogger(__name__)

CAMERA_NUMBERS = 10
"""Width, height, bf, depth scale, frame rate, and five of distortion."""
_FIXED_COVARIANCE = 1e-12 * np.eye(6)  # micrometres, microradians


@dataclass
class _Notes:
    """What bmask-slam's comments in a file say."""

    camera: list[float] = field(default_factory=list)
    landmark_offset: int = 0
    edges: dict[int, tuple[str, str | None]] = field(default_factory=dict)

    def read(self, path: Path, line: str, number: int) -> None:
        """Read a comment line; those of other programs are ignored."""
        words, where = line.removeprefix(MARK).split(), f"{path}:{number}"
        if not line.startswith(MARK + " ") or len(words) < 2:
            return
        if words[0] == "camera":
            self.camera = [finite_number(word, where) for word in words[1:]]
            if len(self.camera) != CAMERA_NUMBERS:
                raise InputError(
                    f"{where}: {len(self.camera)} numbers of the camera, expected "
                    f"{CAMERA_NUMBERS}: its size, bf, depth scale, rate and distortion; correct or "
                    "remove the comment"
                )
        elif words[0] == "landmarks":
            self.landmark_offset = whole_number(words[1], where)
        elif words[0] == "edge" and len(words) == 3:
            kind, kernel = words[1:]
            if kernel not in ("none", *KERNELS):
                known = ", ".join(("none", *KERNELS))
                raise InputError(f"{where}: the kernel {kernel[:40]!r}; use one of {known}")
            self.edges[number + 1] = kind, None if kernel == "none" else kernel


def read_landmark_graph(
    path: Path, config: SmootherConfig | None = None, repair: bool = False
) -> tuple[FactorTables, Camera]:
    """Read a graph with landmarks; of several connected components, those with a prior.

    Fixed keyframes get a very firm prior. Without any prior the largest component is read and its
    first keyframe gets the smoother's prior. Landmarks without an observation are left out, with a
    warning, as are lines of other types. ``repair``: as ``graph.g2o.pose_graphs.read_g2o``.

    Raises:
        InputError: naming file and line, as ``graph.g2o.pose_graphs.read_g2o``; also cameras that
            differ or are not at their vertex, and information that correlates u, v and 1/z.
    """
    notes, tables = _Notes(), FactorTables()
    rows, fixed = read_rows(path, TAGS, lambda line, k: notes.read(path, line, k))
    if not rows[VIEW].lines:
        raise InputError(f"{path}: no {VIEW} line; nothing was seen")
    camera = _camera(rows, notes, path)
    names = np.array(rows[VIEW].ids, np.int64)
    _add_vertices(tables, rows, names, notes.landmark_offset, path)
    tables.observations.add(_views(rows[VIEW], names, notes.landmark_offset, camera, path))
    tables.add_pose_factors(_pose_factors(rows, notes, tables.keyframes.ids, path, repair))
    check_fixed(fixed, tables.keyframes.ids, path)
    fixed_poses = tables.keyframes.get(np.array(sorted(fixed), np.int64))
    priors = zip(sorted(fixed), fixed_poses, strict=True)
    tables.add_pose_factors([PosePrior(k, T, _FIXED_COVARIANCE) for k, T in priors])
    _keep_components_with_priors(tables, path)
    anchor_components(tables, config or SmootherConfig())
    return tables, camera


def _add_vertices(
    tables: FactorTables, rows: dict[str, Rows], views: Ints, offset: int, path: Path
) -> None:
    """Keyframes, and the landmarks that ``views`` (M, 3) name; their ids are less ``offset``."""
    keyframe_ids, keyframe_rows = vertex_ids(rows[POSE], path)
    landmark_ids, landmark_rows = vertex_ids(rows[POINT], path)
    both = np.intersect1d(keyframe_ids, landmark_ids)
    if len(both):
        at = rows[POINT].lines[landmark_rows[np.searchsorted(landmark_ids, both[0])]]
        raise InputError(f"{path}:{at}: vertex {both[0]} is there twice; remove one")
    indices_of(views[:, 0], rows[VIEW].lines, keyframe_ids, path)
    indices_of(views[:, 1], rows[VIEW].lines, landmark_ids, path)
    _check_numbers(rows[POSE], 0, path)
    _check_numbers(rows[POINT], offset, path)
    poses = poses_of_columns(np.array(rows[POSE].numbers)[keyframe_rows])
    tables.keyframes.insert(keyframe_ids, poses)
    observed = np.isin(landmark_ids, views[:, 1])
    if not observed.all():
        logger.warning("%s: %d landmarks without observations left out", path, np.sum(~observed))
    points = np.array(rows[POINT].numbers)[landmark_rows]
    tables.landmarks.insert(landmark_ids[observed] - offset, points[observed])


def _check_numbers(vertices: Rows, begin: int, path: Path) -> None:
    """Refuse vertices that are not numbered as ids from ``begin`` on can be."""
    end = begin + FIRST_FRAME
    for (number,), line in zip(vertices.ids, vertices.lines, strict=True):
        if not begin <= number < end:
            raise InputError(
                f"{path}:{line}: a vertex {number} of this type, where they are numbered from "
                f"{begin} to below {end}; number it anew"
            )


def _camera(rows: dict[str, Rows], notes: _Notes, path: Path) -> Camera:
    """The one camera that all views share."""
    for tag in (CAMERA, STEREO, OFFSET):
        for numbers, line in zip(rows[tag].numbers, rows[tag].lines, strict=True):
            if not np.allclose(poses_of_columns(np.array([numbers[:7]]))[0], np.eye(4)):
                raise InputError(
                    f"{path}:{line}: an offset between vertex and camera is not supported; put "
                    "the vertices where the cameras are"
                )
    _check_parameters(VIEW, CAMERA, rows, path)
    _check_parameters(PRIOR, OFFSET, rows, path)
    intrinsics = np.array(rows[CAMERA].numbers)[:, 7:11]
    for row, line in zip(intrinsics, rows[CAMERA].lines, strict=True):
        if (row[:2] <= 0).any():
            raise InputError(f"{path}:{line}: a focal length that is not positive; correct it")
        if (row != intrinsics[0]).any():
            raise InputError(
                f"{path}:{line}: another camera; only one is supported, split the file"
            )
    fx, fy, cx, cy = intrinsics[0].tolist()
    bf = {"stereo_bf_px_m": fx * rows[STEREO].numbers[0][11]} if len(rows[STEREO]) else {}
    with naming(str(path), f"correct {CAMERA} and {MARK} camera"):
        if not notes.camera:
            return Camera(round(2 * cx + 1), round(2 * cy + 1), fx, fy, cx, cy, **bf)
        width, height, bf_px_m, depth_scale, fps, k1, k2, p1, p2, k3 = notes.camera
        return Camera(
            round(width),
            round(height),
            fx,
            fy,
            cx,
            cy,
            distortion=(k1, k2, p1, p2, k3),
            depth_scale=depth_scale,
            fps=fps,
            stereo_bf_px_m=bf_px_m,
        )


def _check_parameters(edge: str, parameter: str, rows: dict[str, Rows], path: Path) -> None:
    """Refuse an edge whose last id names a parameter that is not there."""
    known = {ids[0] for ids in rows[parameter].ids}
    for ids, line in zip(rows[edge].ids, rows[edge].lines, strict=True):
        if ids[-1] not in known:
            raise InputError(
                f"{path}:{line}: {edge} with the parameter {ids[-1]}, but there is no {parameter} "
                "of this id; add it"
            )


def _views(rows: Rows, names: Ints, offset: int, camera: Camera, path: Path) -> Observations:
    """Observations from lines of u, v, 1/z and their information."""
    values = np.array(rows.numbers)
    u, v, inverse_depth = values[:, :3].T
    correlated = (values[:, [4, 5, 7]] != 0).any(axis=1)
    i_u, i_v, i_z = values[:, [3, 6, 8]].T
    indefinite = (i_u <= 0) | (i_v <= 0) | (i_z < 0)
    for wrong, reason in (
        (indefinite, "an information matrix that is not positive definite"),
        (correlated, "information that correlates u, v and 1/z, which is not supported"),
    ):
        if wrong.any():
            where = f"{path}:{rows.lines[int(np.argmax(wrong))]}"
            raise InputError(f"{where}: {reason}; correct or remove the edge")
    pairs, first = np.unique(names[:, :2], axis=0, return_index=True)
    if len(pairs) < len(names):
        again = np.setdiff1d(np.arange(len(names)), first)[0]
        raise InputError(
            f"{path}:{rows.lines[again]}: vertex {names[again, 0]} sees vertex {names[again, 1]} "
            "twice; remove one"
        )
    bf_px_m = camera.stereo_bf_px_m
    stereo = i_z > 0
    sigmas_px = 1 / np.sqrt(np.stack([i_u, i_v, np.where(stereo, i_z / bf_px_m**2, 1.0)], axis=1))
    u_right = np.where(stereo, u - bf_px_m * inverse_depth, np.nan)
    measurements = np.stack([u, v, u_right], axis=1)
    return Observations(names[:, 0], names[:, 1] - offset, measurements, sigmas_px)


def _pose_factors(
    rows: dict[str, Rows], notes: _Notes, keyframe_ids: Ints, path: Path, repair: bool
) -> list[RelativePose | PosePrior]:
    """Priors, then relative poses; without a comment edges between ids in a row are odometry."""
    factors: list[RelativePose | PosePrior] = []
    priors, edges = rows[PRIOR], rows[RELATIVE]
    names = np.array(priors.ids, np.int64).reshape(-1, 2)[:, 0]
    indices_of(names, priors.lines, keyframe_ids, path)
    for k, T, covariance in zip(names.tolist(), *_measured(priors, path, repair), strict=True):
        factors.append(PosePrior(k, T, covariance))
    pairs = pairs_of(edges, path)
    indices_of(pairs, edges.lines, keyframe_ids, path)
    for (a, b), line, T, covariance in zip(
        pairs.tolist(), edges.lines, *_measured(edges, path, repair), strict=True
    ):
        usual = ("odometry" if abs(a - b) == 1 else "loop", None)
        kind, robust = notes.edges.get(line, usual)
        factors.append(RelativePose(a, b, T, covariance, robust, kind))
    return factors


def _measured(rows: Rows, path: Path, repair: bool) -> tuple[Array, Array]:
    """Poses (M, 4, 4) and covariances (M, 6, 6) of edge lines."""
    numbers = np.array(rows.numbers).reshape(-1, 28)
    information = information_matrices(numbers[:, 7:], rows.lines, path, repair)
    covariances = np.linalg.inv(information)
    covariances = (covariances + covariances.swapaxes(1, 2)) / 2
    return poses_of_columns(numbers[:, :7]), covariances


def _keep_components_with_priors(tables: FactorTables, path: Path) -> None:
    """Keep the connected components with a prior; if there is none, the largest."""
    ids = tables.keyframes.ids
    edges = [factor.keyframes for factor in tables.pose_factors.values()]
    observed = tables.observations.select(tables.observations.used_rows())
    labels = component_labels(ids, observed, edges)
    fixed_poses = labels[np.searchsorted(ids, [edge[0] for edge in edges if len(edge) == 1])]
    keep = (
        np.isin(labels, fixed_poses)
        if len(fixed_poses)
        else labels == np.argmax(np.bincount(labels))
    )
    if keep.all():
        return
    removed = ids[~keep].tolist()
    rows = tables.observations.rows_of_keyframes(removed)
    landmarks = np.unique(tables.observations.select(rows).landmark_ids)
    tables.observations.remove(rows)
    tables.landmarks.remove(landmarks)
    tables.remove_pose_factors(tables.numbers_of_keyframes(removed))
    tables.keyframes.remove(ids[~keep])
    logger.warning(
        "%s: %d parts that no edge connects; the %s taken, %d keyframes and %d landmarks are left "
        "out",
        path,
        labels.max() + 1,
        "parts with a prior are" if len(fixed_poses) else "largest is",
        len(removed),
        len(landmarks),
    )
