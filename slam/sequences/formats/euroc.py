"""The layout of EuRoC (ASL) with a depth camera: mav0/cam0, mav0/depth0, sensor.yaml, data.csv."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.file_names import check_name
from bmask_slam.graph.files.reading import read_lines
from bmask_slam.graph.files.yaml_file import read_yaml
from bmask_slam.graph.geometry import inverse, make_pose, rotation_from_quaternion
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.sequences.cameras import recorded_camera
from bmask_slam.sequences.formats.numbered import camera_of_matrix, numbers_in, trajectory_of
from bmask_slam.sequences.lists import ImageList, sorted_list
from bmask_slam.sequences.recording import DepthForm, Recording

NANOSECONDS = 1e-9
TRUTHS = ("state_groundtruth_estimate0", "vicon0", "leica0")
_MODELS = ("radial-tangential", "radtan", "plumb_bob")


def _root(folder: Path) -> Path:
    return folder / "mav0" if (folder / "mav0").is_dir() else folder


def is_euroc(folder: Path) -> bool:
    """Whether it has cam0 and depth0 with their lists, in mav0 or at once."""
    root = _root(folder)
    return all((root / name / "data.csv").is_file() for name in ("cam0", "depth0"))


def open_euroc(folder: Path, given: Path | Camera | None) -> Recording:
    """Depth of a camera with intrinsics of its own is registered. Raises InputError.

    Both cameras' ``T_BS`` are their poses on the body. The truth is that of the first of
    ``TRUTHS``, by its own ``T_BS``.
    """
    root = _root(folder)
    own, T_body_colour = _camera(root / "cam0" / "sensor.yaml")
    depth, T_body_depth = _camera(root / "depth0" / "sensor.yaml")
    if own is None:
        raise InputError(f"{root / 'cam0' / 'sensor.yaml'}: no intrinsics; give them")
    scale = 1000.0 if depth is None else depth.depth_scale
    own = Camera(**{**vars(own), "depth_scale": scale})
    camera, source = recorded_camera(own, str(root / "cam0" / "sensor.yaml"), folder, given)
    T_colour_depth = inverse(T_body_colour) @ T_body_depth
    form = DepthForm()
    if depth is not None and (depth != own or not np.allclose(T_colour_depth, np.eye(4))):
        form = DepthForm(camera=depth, T_colour_depth=T_colour_depth)
    lists = [_images(root / name) for name in ("cam0", "depth0")]
    truth = _truth(root, T_body_colour)
    return Recording("EuRoC", folder, lists[0], lists[1], camera, source, truth, form)


def _images(folder: Path) -> ImageList:
    """The images of data.csv: nanoseconds, file name in data/. Raises InputError."""
    path = folder / "data.csv"
    stamps_s, files = [], []
    for number, line in read_lines(path, "restore it"):
        stamp, _, name = line.partition(",")
        if name.strip():
            numbers = numbers_in(stamp, f"{path}:{number}")
            if len(numbers) != 1:
                raise InputError(f"{path}:{number}: {stamp[:80]!r} is no stamp in nanoseconds")
            stamps_s += [numbers[0] * NANOSECONDS]
            files.append(folder / "data" / check_name(name.strip(), f"{path}:{number}"))
    if not files or not np.isfinite(stamps_s).all():
        raise InputError(f"{path}: no lines of 'nanoseconds,file', or a stamp without end")
    return sorted_list(path, np.array(stamps_s), files)


def _camera(path: Path) -> tuple[Camera | None, Array]:
    """The camera of a sensor.yaml, None if it has no intrinsics, and T_body_camera."""
    if not path.is_file():
        return None, np.eye(4)
    said = read_yaml(path)
    if not isinstance(said, dict):
        raise InputError(f"{path}: no mapping; give one with intrinsics: [fu, fv, cu, cv]")
    T_bs = said.get("T_BS", {})
    pose = _numbers(T_bs.get("data") if isinstance(T_bs, dict) else T_bs, 16, path, "T_BS")
    T_body_camera = np.eye(4) if pose is None else np.array(pose).reshape(4, 4)
    if trajectory_of([0.0], [T_body_camera], f"{path}: T_BS") is None:
        raise InputError(f"{path}: T_BS is no pose; correct it")
    f = _numbers(said.get("intrinsics"), 4, path, "intrinsics")
    size = _numbers(said.get("resolution"), 2, path, "resolution")
    if f is None or size is None:
        return None, T_body_camera
    K = np.array([[f[0], 0, f[2]], [0, f[1], f[3]], [0, 0, 1]])
    scale = said.get("depth_scale", 1000.0)
    scale = float(scale) if isinstance(scale, int | float) else 0.0
    camera = camera_of_matrix(K, (int(size[0]), int(size[1])), scale, str(path))
    lens = _numbers(said.get("distortion_coefficients"), 4, path, "distortion_coefficients")
    if lens is None or not any(lens):
        return camera, T_body_camera
    if said.get("distortion_model", "") not in _MODELS:
        raise InputError(f"{path}: distortion_model is not radial-tangential; undistort the images")
    return Camera(**{**vars(camera), "distortion": (*lens, 0.0)}), T_body_camera


def _numbers(value: Any, count: int, path: Path, name: str) -> list[float] | None:
    """So many finite numbers of a YAML file; None if it has none."""
    if value is None:
        return None
    rows = value if isinstance(value, list) else [value]
    good = [v for v in rows if isinstance(v, int | float) and not isinstance(v, bool)]
    if len(good) != count or len(rows) != count or not all(abs(v) < 1e9 for v in good):
        raise InputError(f"{path}: {name} must be {count} numbers")
    return [float(v) for v in good]


def _truth(root: Path, T_body_colour: Array) -> Trajectory | None:
    """T_world_camera by data.csv: nanoseconds, position, quaternion w x y z of the truth's sensor.

    The sensor.yaml beside it says where that sensor S is on the body B; vicon0's are its markers:
    ``T_world_camera = T_world_S inverse(T_BS) T_body_colour``.
    """
    path = next((p for n in TRUTHS if (p := root / n / "data.csv").is_file()), None)
    if path is None:
        return None
    rows = [numbers_in(line, f"{path}:{number}") for number, line in read_lines(path, "restore it")]
    if any(len(row) < 8 for row in rows):
        return None  # a position alone, as Leica's
    table = np.array([row[:8] for row in rows]).reshape(-1, 8)
    lengths = np.linalg.norm(table[:, 4:], axis=1)
    if not (np.isfinite(table).all() and ((lengths > 0.5) & (lengths < 2)).all()):
        raise InputError(f"{path}: a pose that is not finite, or no unit quaternion; remove it")
    R = rotation_from_quaternion(table[:, [5, 6, 7, 4]])
    _, T_body_sensor = _camera(path.with_name("sensor.yaml"))
    poses = make_pose(R, table[:, 1:4]) @ inverse(T_body_sensor) @ T_body_colour
    return trajectory_of(table[:, 0] * NANOSECONDS, poses, str(path))
