"""A saved graph: every factor, value and id as named arrays, in one file (`graph.files`).

ISAM2 itself cannot be saved; it is rebuilt from these, independent of GTSAM's version. A saved map
contains the same arrays as a part.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from bmask_slam.graph.arrays import Array, Arrays
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_update import (
    FIRST_FRAME,
    KERNELS,
    Observations,
    PosePrior,
    RelativePose,
)
from bmask_slam.graph.files.array_file import (
    FileKind,
    Header,
    check_like,
    fitting,
    read_arrays,
    write_arrays,
)
from bmask_slam.graph.files.json_file import check_json
from bmask_slam.graph.inertial.tables import example_arrays, read_inertial
from bmask_slam.graph.smoother.marginalised_storage import (
    SHAPES,
    marginalised_arrays,
    read_marginalised,
)

GRAPH_FILE = FileKind("graph", 3)
_SHAPES: dict[str, tuple[str, tuple[int, ...]]] = {
    "keyframe_ids": ("keyframe", ()),
    "poses_world_camera": ("keyframe", (4, 4)),
    "landmark_ids": ("landmark", ()),
    "points_world": ("landmark", (3,)),
    "observation_keyframe_ids": ("observation", ()),
    "observation_landmark_ids": ("observation", ()),
    "measurements": ("observation", (3,)),
    "sigmas_px": ("observation", (3,)),
    "pose_factor_keyframes": ("pose factor", (2,)),
    "pose_factor_T": ("pose factor", (4, 4)),
    "pose_factor_covariances": ("pose factor", (6, 6)),
    "pose_factor_kinds": ("pose factor", ()),
    "pose_factor_robust": ("pose factor", ()),
    **SHAPES,
}
END_OF_IDS = 2 * FIRST_FRAME
"""All ids of keyframes, reference frames and landmarks are below."""


def write_graph(path: Path, tables: FactorTables, camera: Camera) -> None:
    """Save a graph and its camera in one file, atomically. Raises InputError if it cannot."""
    write_arrays(path, GRAPH_FILE, {"camera": dataclasses.asdict(camera)}, graph_arrays(tables))


def read_graph(path: Path) -> tuple[FactorTables, Camera]:
    """Load what write_graph saved. Raises InputError for a missing, foreign or broken file."""
    header, arrays = read_arrays(path, GRAPH_FILE)
    return factor_tables_of(arrays, path), read_camera(header, path)


def graph_arrays(tables: FactorTables) -> Arrays:
    """All of the factor tables but for the slots of the factors in ISAM2."""
    observations = tables.observations.all()
    factors = [tables.pose_factors[number].factor for number in sorted(tables.pose_factors)]
    return {
        "keyframe_ids": tables.keyframes.ids,
        "poses_world_camera": np.ascontiguousarray(tables.keyframes.values),
        "landmark_ids": tables.landmarks.ids,
        "points_world": np.ascontiguousarray(tables.landmarks.values),
        "observation_keyframe_ids": observations.keyframe_ids,
        "observation_landmark_ids": observations.landmark_ids,
        "measurements": observations.measurements,
        "sigmas_px": observations.sigmas_px,
        "pose_factor_keyframes": np.array(
            [(factor.keyframe_ids[0], factor.keyframe_ids[-1]) for factor in factors], np.int64
        ).reshape(-1, 2),
        "pose_factor_T": np.array([_measured(f) for f in factors], float).reshape(-1, 4, 4),
        "pose_factor_covariances": np.array(
            [factor.covariance for factor in factors], float
        ).reshape(-1, 6, 6),
        "pose_factor_kinds": np.array([factor.kind for factor in factors], np.str_),
        "pose_factor_robust": np.array([getattr(f, "robust", "") or "" for f in factors], np.str_),
        **marginalised_arrays(tables),
        **_own_arrays(tables),
        **tables.inertial.arrays(),
    }


def _own_arrays(tables: FactorTables) -> Arrays:
    if not (tables.own_factors or tables.next_own):
        return {}
    from bmask_slam.graph.factors.own_factors import own_arrays  # noqa: PLC0415 - loads GTSAM

    return own_arrays(tables)


def _measured(factor: RelativePose | PosePrior) -> Array:
    return factor.T_world_camera if isinstance(factor, PosePrior) else factor.T_a_b


def _check(arrays: Arrays, path: Path) -> None:
    """Check that all arrays are there, their types and shapes, sorted ids, ids that factors refer
    to, and values.
    """
    counts: dict[str, int] = {}
    for name, (what, shape) in _SHAPES.items():
        array = arrays.get(name)
        if array is None or array.shape[1:] != shape or array.ndim != 1 + len(shape):
            raise InputError(f"{path}: array {name!r} is missing or misshapen; save it again")
        if counts.setdefault(what, len(array)) != len(array):
            raise InputError(f"{path}: array {name!r} has {len(array)} rows; save it again")
    for ids, references in (
        (
            "keyframe_ids",
            (
                "observation_keyframe_ids",
                "pose_factor_keyframes",
                "archived_keyframe_ids",
                "summary_keyframe_ids",
            ),
        ),
        ("landmark_ids", ("observation_landmark_ids",)),
    ):
        if (np.diff(arrays[ids]) <= 0).any():
            raise InputError(f"{path}: {ids} are not ascending; save it again")
        for name in references:
            unknown = np.setdiff1d(arrays[name], arrays[ids])
            if len(unknown):
                raise InputError(f"{path}: {name} has unknown id {unknown[0]}; save it again")
    example = graph_arrays(FactorTables())
    if "imu_factors" in arrays:
        example |= example_arrays()
    check_like({name: a for name, a in arrays.items() if name in example}, example, path)
    if name := _impossible(arrays):
        raise InputError(f"{path}: array {name!r} has a value that no graph has; save it again")


def _impossible(arrays: Arrays) -> str:
    """The first array with a value on which GTSAM or numpy would fail; "" if there is none."""
    for name in ("keyframe_ids", "landmark_ids"):
        if ((arrays[name] < 0) | (arrays[name] >= END_OF_IDS)).any():
            return name
    for name in ("poses_world_camera", "points_world", "pose_factor_T", "pose_factor_covariances"):
        if not np.isfinite(arrays[name]).all():
            return name
    u_left_v, u_right = np.split(arrays["measurements"], [2], axis=1)
    if not np.isfinite(u_left_v).all() or np.isinf(u_right).any():
        return "measurements"
    used = np.isfinite(arrays["measurements"])  # no disparity without a u_right
    if not ((arrays["sigmas_px"] > 0) & np.isfinite(arrays["sigmas_px"]))[used].all():
        return "sigmas_px"
    if not (np.diagonal(arrays["pose_factor_covariances"], axis1=1, axis2=2) > 0).all():
        return "pose_factor_covariances"
    known_kernels = np.isin(arrays["pose_factor_robust"], ["", *KERNELS])
    return "" if known_kernels.all() else "pose_factor_robust"


def factor_tables_of(arrays: Arrays, path: Path) -> FactorTables:
    """The factor tables of ``graph_arrays`` that were read from a file.

    Raises:
        InputError: the arrays do not fit together.
    """
    with fitting(path):
        _check(arrays, path)
        return _tables(arrays)


def _tables(arrays: Arrays) -> FactorTables:
    """The factor tables of arrays that were checked."""
    tables = FactorTables()
    tables.keyframes.insert(arrays["keyframe_ids"], arrays["poses_world_camera"])
    tables.landmarks.insert(arrays["landmark_ids"], arrays["points_world"])
    tables.observations.add(
        Observations(
            arrays["observation_keyframe_ids"],
            arrays["observation_landmark_ids"],
            arrays["measurements"],
            arrays["sigmas_px"],
        )
    )
    columns = (
        arrays["pose_factor_keyframes"].tolist(),
        arrays["pose_factor_T"],
        arrays["pose_factor_covariances"],
        arrays["pose_factor_kinds"].tolist(),
        arrays["pose_factor_robust"].tolist(),
    )
    for (a, b), T, covariance, kind, robust in zip(*columns, strict=True):
        factor: RelativePose | PosePrior = PosePrior(a, T, covariance)
        if kind != PosePrior.kind:
            factor = RelativePose(a, b, T, covariance, robust or None, kind)
        tables.add_pose_factors([factor])
    tables.marginalised = read_marginalised(arrays)
    tables.inertial = read_inertial(arrays, tables.keyframes.ids)
    if "own_factors" in arrays or "own_next" in arrays:
        from bmask_slam.graph.factors.own_factors import read_own  # noqa: PLC0415 - loads GTSAM

        read_own(arrays, tables)
    return tables


def read_camera(header: Header, path: Path) -> Camera:
    """The camera of a file's header. Raises InputError if it is none."""
    camera = check_json(header.get("camera"), Camera, f"{path}: its camera", "save it again")
    if fault := camera.fault():
        raise InputError(f"{path}: its camera has {fault}; save it again")
    return camera
