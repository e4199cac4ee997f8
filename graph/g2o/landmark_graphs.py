"""The g2o text format of graphs with landmarks: keyframe poses, points and observations.

The types are those of g2o's library slam3d:

==========================  ===================================================================
PARAMS_CAMERACALIB 0        pose of the camera in its vertex (none: the two are the same), then
                            fx fy cx cy in pixels
PARAMS_STEREOCAMERACALIB 1  the same and the baseline in metres; no edge refers to it
PARAMS_SE3OFFSET 2          the pose in its vertex that a prior is about (the vertex itself)
VERTEX_SE3:QUAT             id, T_world_camera
VERTEX_TRACKXYZ             id, point in the world in metres
EDGE_PROJECT_DISPARITY      keyframe, point, 0; u v in pixels and 1/z in 1/m; upper triangle of
                            the information of these three
EDGE_SE3:QUAT               keyframe a, keyframe b; T_a_b; information
EDGE_SE3_PRIOR              keyframe, 2; T_world_camera; information
FIX                         fixed keyframes (read, never written)
==========================  ===================================================================

**Exact:** an observation with depth. g2o's disparity is normalised, 1/z = d / bf, so sigma_d
becomes sigma_d / bf; the errors of u, v and d are independent in both. An observation without depth
is the same edge without information on 1/z: the two equations of a monocular observation remain.
(g2o's monocular edges belong to its library sba, with another pose vertex and one focal length for
both axes.) Poses and information: as in ``graph.g2o.lines``.

**In comments**, since g2o has no tags for it: image size, bf and distortion; which ids are
landmarks' (g2o's vertices share one range), which poses reference frames' (they follow the
keyframes, also when read back); kind and kernel of the next relative pose. Kernels of
observations and a user's own factors are not written.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_update import (
    FIRST_FRAME,
    Observations,
    PosePrior,
    RelativePose,
)
from bmask_slam.graph.files.reading import read_lines
from bmask_slam.graph.g2o.lines import (
    Tag,
    information_columns,
    numbers_text,
    pose_columns,
    write_lines,
)

VIEW = "EDGE_PROJECT_DISPARITY"
CAMERA, STEREO, OFFSET = "PARAMS_CAMERACALIB", "PARAMS_STEREOCAMERACALIB", "PARAMS_SE3OFFSET"
POSE, POINT = "VERTEX_SE3:QUAT", "VERTEX_TRACKXYZ"
RELATIVE, PRIOR = "EDGE_SE3:QUAT", "EDGE_SE3_PRIOR"
TAGS = {
    CAMERA: Tag(1, 7 + 4, 3),
    STEREO: Tag(1, 7 + 5, 3),
    OFFSET: Tag(1, 7, 3),
    POSE: Tag(1, 7, 3),
    POINT: Tag(1, 3),
    VIEW: Tag(3, 3 + 6),
    RELATIVE: Tag(2, 7 + 21, 3),
    PRIOR: Tag(2, 7 + 21, 3),
}
MARK = "# bmask-slam"
_NO_OFFSET = np.array([0, 0, 0, 0, 0, 0, 1.0])
_ABOUT = """\
# Graph of bmask-slam: keyframes T_world_camera, landmarks, observations. Metres, radians, pixels.
# EDGE_PROJECT_DISPARITY: keyframe, landmark, camera, u, v, 1/z; no information on 1/z: no depth.
# Rotational information of EDGE_SE3:QUAT and EDGE_SE3_PRIOR is per radian, as GTSAM has it; g2o
# itself takes it per quaternion component, half an angle.
# Not in here: the robust kernels of observations (bmask-slam: Huber)."""


def has_landmarks(path: Path) -> bool:
    """Whether a g2o file holds observations of landmarks."""
    if not path.is_file():
        return False
    return any(line.split(maxsplit=1)[0] == VIEW for _, line in read_lines(path, "give a graph"))


def write_landmark_graph(path: Path, tables: FactorTables, camera: Camera) -> None:
    """Write a graph as ``read_landmark_graph`` reads it; it appears whole or not at all."""
    ids = _Numbers.of(tables.keyframes.ids)
    offset = ids.begin + len(ids.frames)
    intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy]
    rest = [camera.width, camera.height, camera.stereo_bf_px_m, camera.depth_scale, camera.fps]
    lines = [
        _ABOUT,
        f"{MARK} camera {numbers_text(np.array([*rest, *camera.distortion]))}",
        f"{MARK} landmarks {offset}",
        *(f"# {ids.of_pose(frame)}: reference frame (z up) of a map" for frame in ids.frames),
        f"{CAMERA} 0 {numbers_text(np.array([*_NO_OFFSET, *intrinsics]))}",
        f"{STEREO} 1 {numbers_text(np.array([*_NO_OFFSET, *intrinsics, camera.baseline_m]))}",
        f"{OFFSET} 2 {numbers_text(_NO_OFFSET)}",
    ]
    keyframes, landmarks = tables.keyframes, tables.landmarks
    lines += _lines(POSE, ids.of_poses(keyframes.ids), pose_columns(keyframes.values))
    lines += _lines(POINT, offset + landmarks.ids, landmarks.values)
    for number in sorted(tables.pose_factors):
        lines += _pose_factor_lines(tables.pose_factors[number].factor, ids)
    observations = tables.observations.all()
    names = np.stack(
        [
            observations.keyframe_ids,
            offset + observations.landmark_ids,
            0 * observations.keyframe_ids,
        ],
        axis=1,
    )
    write_lines(path, [*lines, *_lines(VIEW, names, _view_columns(observations, camera))])


def _lines(tag: str, names: Ints, numbers: Array) -> list[str]:
    if not len(numbers):
        return []
    rows = zip(names.reshape(len(numbers), -1).tolist(), numbers, strict=True)
    return [f"{tag} {' '.join(map(str, ids))} {numbers_text(row)}" for ids, row in rows]


@dataclass(frozen=True)
class _Numbers:
    """Numbers of poses: keyframes keep theirs, reference frames follow, since g2o's have 32 bits.

    Attributes:
        begin: number of the first of the reference frames. frames: their ids.
    """

    begin: int
    frames: list[int]

    @classmethod
    def of(cls, ids: Ints) -> _Numbers:
        """Of sorted ids (N,)."""
        are_frames = ids >= FIRST_FRAME
        return cls(1 + int(ids[~are_frames].max(initial=-1)), ids[are_frames].tolist())

    def of_pose(self, pose_id: int) -> int:
        """The number of a pose."""
        return pose_id if pose_id < FIRST_FRAME else self.begin + self.frames.index(pose_id)

    def of_poses(self, ids: Ints) -> Ints:
        """The numbers (N,) of poses (N,)."""
        return np.array([self.of_pose(i) for i in ids.tolist()], np.int64)


def _pose_factor_lines(factor: RelativePose | PosePrior, ids: _Numbers) -> list[str]:
    inverse: Array = np.asarray(np.linalg.inv(factor.covariance), float)
    information = information_columns(inverse[None])
    if isinstance(factor, PosePrior):
        numbers = np.hstack([pose_columns(factor.T_world_camera[None]), information])
        return _lines(PRIOR, np.array([[ids.of_pose(factor.keyframe_id), 2]]), numbers)
    numbers = np.hstack([pose_columns(factor.T_a_b[None]), information])
    edge = ids.of_poses(np.array(factor.keyframe_ids))[None]
    note = f"{MARK} edge {factor.kind} {factor.robust or 'none'}"
    return [note, *_lines(RELATIVE, edge, numbers)]


def _view_columns(observations: Observations, camera: Camera) -> Array:
    """(M, 9) of u, v, 1/z and the upper triangle of their information."""
    u, v, u_right = observations.measurements.T
    stereo = np.isfinite(u_right)
    inverse_depth = np.where(stereo, u - u_right, 0.0) / camera.stereo_bf_px_m
    information = 1 / observations.sigmas_px**2
    information[:, 2] = np.where(stereo, information[:, 2] * camera.stereo_bf_px_m**2, 0.0)
    nothing = np.zeros(len(u))
    i_u, i_v, i_z = information.T
    return np.stack([u, v, inverse_depth, i_u, nothing, nothing, i_v, nothing, i_z], axis=1)
