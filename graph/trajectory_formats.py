"""Trajectories in the formats of KITTI and EuRoC, and recognition of a file's format.

TUM's format is in ``graph.trajectory``.
"""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Literal

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError, finite_number, is_whole
from bmask_slam.graph.files.reading import read_lines
from bmask_slam.graph.files.whole_file import whole_file
from bmask_slam.graph.geometry import make_pose, quaternion_from_rotation, rotation_from_quaternion
from bmask_slam.graph.trajectory import Trajectory, check_quaternion, read_tum

EUROC_HEADER = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
)
EUROC_COLUMNS = (8, 17)  # 17 in the data sets' own ground truth: velocity and biases follow
MAX_SKEWNESS = 1e-3
MIN_STEP_NS = 1e5  # ten thousand poses a second; whole seconds are never that far apart
KITTI_COLUMNS = 12
TrajectoryFormat = Literal["tum", "kitti", "euroc"]


def read_trajectory(path: Path, stamps_s: Array | None = None) -> Trajectory:
    """Read a trajectory in any of the three formats, recognised by its lines.

    KITTI has no stamps: ``stamps_s`` (N,) are those of its lines; ignored for other formats.

    Raises:
        InputError: no file, what the format's reader refuses, or KITTI without stamps, or with
            another number of them than poses.
    """
    form = recognise(path)
    if form == "euroc":
        return read_euroc(path)
    if form == "tum":
        return read_tum(path)
    poses = read_kitti(path)
    if stamps_s is None:
        raise InputError(
            f"{path}: {KITTI_COLUMNS} columns, the format of KITTI, which has no stamps; give them "
            "with --times, a file with a stamp in seconds a line"
        )
    if len(stamps_s) != len(poses):
        raise InputError(
            f"{path}: {len(poses)} poses for {len(stamps_s)} stamps; in the format of KITTI a line "
            "belongs to a frame; give the stamps of these poses with --times"
        )
    return Trajectory(stamps_s, poses)


def recognise(path: Path) -> TrajectoryFormat:
    """The format of a trajectory file; TUM's if it is none of the others.

    KITTI has twelve columns. EuRoC has commas and whole stamps, which are steps of nanoseconds
    apart: a TUM file may have commas too.
    """
    lines = [line for _, line in _lines(path)]
    if lines and len(lines[0].split()) == KITTI_COLUMNS:
        return "kitti"
    if not lines or not all("," in line for line in (lines[0], lines[-1])):
        return "tum"
    ends = [lines[k].split(",")[0].strip() for k in (0, -1)]
    if not all(map(is_whole, ends)):
        return "tum"
    step = (int(ends[-1]) - int(ends[0])) / max(len(lines) - 1, 1)
    return "euroc" if step > MIN_STEP_NS or (len(lines) == 1 and int(ends[0]) > 1e12) else "tum"


def read_times(path: Path) -> Array:
    """Stamps (N,) in seconds, the first word of each line: KITTI's times.txt, or a TUM file.

    Raises:
        InputError: no file, no line, a value that is no finite number, or stamps that do not
            increase.
    """
    words = [(where, line.replace(",", " ").split()) for where, line in _lines(path)]
    rows = [(where, of_line[0]) for where, of_line in words if of_line]
    stamps_s = np.array([finite_number(word, where) for where, word in rows])
    if not len(stamps_s):
        raise InputError(f"{path}: no stamp in the file; expected one in seconds a line")
    if (np.diff(stamps_s) <= 0).any():
        where = rows[int(np.argmax(np.diff(stamps_s) <= 0)) + 1][0]
        raise InputError(f"{where}: a stamp that is not later than the one before; correct it")
    return stamps_s


def write_times(path: Path, stamps_s: Array) -> None:
    """Write stamps (N,) in seconds as ``read_times`` reads them."""
    _write(path, [f"{stamp:.6f}" for stamp in stamps_s.tolist()])


def write_kitti(path: Path, poses_world_camera: Array) -> None:
    """Write (N, 4, 4) poses: the upper three rows of T_world_camera, row by row, a pose a line.

    The format has no stamps; the k-th line belongs to the k-th frame.
    """
    rows = poses_world_camera[:, :3].reshape(-1, 12)
    _write(path, [" ".join(f"{value:.12g}" for value in row) for row in rows.tolist()])


def read_kitti(path: Path) -> Array:
    """Poses T_world_camera (N, 4, 4) in metres, a line each.

    Raises:
        InputError: no file, no pose, another number of columns than 12, a value that is no finite
            number, or a matrix that is no rotation.
    """
    rows = [_numbers(line.split(), where, (KITTI_COLUMNS,)) for where, line in _lines(path)]
    if not rows:
        raise InputError(f"{path}: no pose in the file; expected 12 numbers a line")
    top = np.array(rows).reshape(-1, 3, 4)
    R = top[:, :, :3]
    skewness = np.abs(R @ R.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
    bad = ~(skewness <= MAX_SKEWNESS) | (np.linalg.det(R) < 0)
    if bad.any():
        k = int(np.argmax(bad))
        raise InputError(f"{path}: pose {k + 1} holds no rotation; correct or remove it")
    return make_pose(R, top[:, :, 3])


def write_euroc(path: Path, trajectory: Trajectory) -> None:
    """Write a EuRoC csv: nanoseconds, position in metres, quaternion w x y z with w >= 0."""
    quaternions = quaternion_from_rotation(trajectory.poses_world_camera[:, :3, :3])
    numbers = np.hstack([trajectory.positions_world, np.roll(quaternions, 1, axis=1)])
    stamps_ns = [round(Fraction(stamp) * 10**9) for stamp in trajectory.timestamps_s.tolist()]
    rows = [
        f"{stamp}," + ",".join(f"{value:.12g}" for value in row)
        for stamp, row in zip(stamps_ns, numbers.tolist(), strict=True)
    ]
    _write(path, [EUROC_HEADER, *rows])


def read_euroc(path: Path) -> Trajectory:
    """Read ``ns,px,py,pz,qw,qx,qy,qz`` lines; further columns are ignored.

    Stamps become seconds in float64, which keeps them to a quarter of a microsecond today.

    Raises:
        InputError: no file, no pose, a wrong number of columns, a value that is no finite number,
            stamps that are not whole or not each there once, or a zero quaternion.
    """
    stamps_s, rows = [], []
    for where, line in _lines(path):
        words = [word.strip() for word in line.split(",")]
        if not is_whole(words[0]):
            raise InputError(f"{where}: {words[0][:40]!r} is no stamp in whole nanoseconds")
        row = _numbers(words, where, EUROC_COLUMNS)[1:8]
        check_quaternion(row[3:], where)
        stamps_s.append(int(words[0]) / 10**9)
        rows.append(row)
    if not rows:
        raise InputError(f"{path}: no pose in the file; expected lines of {EUROC_HEADER[1:]}")
    if len(set(stamps_s)) < len(stamps_s):
        raise InputError(f"{path}: a stamp is there more than once; each pose needs its own")
    values = np.array(rows)
    R = rotation_from_quaternion(np.roll(values[:, 3:], -1, axis=1))
    return Trajectory(np.array(stamps_s), make_pose(R, values[:, :3]))


def _lines(path: Path) -> list[tuple[str, str]]:
    """Place (file and line number) and text of every line that is neither empty nor a comment."""
    if not Path(path).is_file():
        raise InputError(f"{path}: no such trajectory file")
    return [(f"{path}:{k}", line) for k, line in read_lines(Path(path), "give a trajectory")]


def _numbers(words: list[str], where: str, counts: tuple[int, ...]) -> list[float]:
    """The finite numbers of one line."""
    if len(words) not in counts:
        raise InputError(f"{where}: {len(words)} columns, expected {' or '.join(map(str, counts))}")
    return [finite_number(word, where) for word in words]


def _write(path: Path, lines: list[str]) -> None:
    with whole_file(Path(path)) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="ascii", newline="\n")
