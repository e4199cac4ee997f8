"""The layout of EuRoC (ASL) with a depth camera: mav0/cam0, mav0/depth0, sensor.yaml, data.csv."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

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
SAME_PLACE = 1e-3
"""Largest difference, in metres and of rotation matrices, of two poses that are the same."""


class _Sensor(NamedTuple):
    """What a sensor.yaml says; ``camera`` is None without intrinsics, ``T_BS`` if not told."""

    camera: Camera | None = None
    T_BS: Array | None = None
    depth_scale: float = 1000.0

    @property
    def T_body_sensor(self) -> Array:
        return np.eye(4) if self.T_BS is None else self.T_BS


def _root(folder: Path) -> Path:
    return folder / "mav0" if (folder / "mav0").is_dir() else folder


def is_euroc(folder: Path) -> bool:
    """Whether it has cam0 and depth0 with their lists, in mav0 or at once."""
    root = _root(folder)
    return all((root / name / "data.csv").is_file() for name in ("cam0", "depth0"))


def open_euroc(folder: Path, given: Path | Camera | None) -> Recording:
    """Depth of a camera with intrinsics of its own is registered; else it is so already.

    Raises InputError, also for depth without intrinsics that is said to be elsewhere than colour.
    Both cameras' ``T_BS`` are their poses on the body. The truth is that of the first of
    ``TRUTHS``, by its own ``T_BS``.
    """
    root = _root(folder)
    colour_file, depth_file = (root / name / "sensor.yaml" for name in ("cam0", "depth0"))
    colour, depth = _sensor(colour_file), _sensor(depth_file)
    if colour.camera is None:
        raise InputError(f"{colour_file}: no intrinsics; give them")
    own = Camera(**{**vars(colour.camera), "depth_scale": depth.depth_scale})
    camera, source = recorded_camera(own, str(colour_file), folder, given)
    form = _form(own, colour, depth, depth_file)
    lists = [_images(root / name) for name in ("cam0", "depth0")]
    truth = _truth(root, colour.T_body_sensor)
    return Recording("EuRoC", folder, lists[0], lists[1], camera, source, truth, form)


def _form(own: Camera, colour: _Sensor, depth: _Sensor, path: Path) -> DepthForm:
    """How depth is registered to colour, whose camera is ``own``; ``path`` is of depth."""
    T_body_colour = colour.T_body_sensor
    if depth.camera is not None:
        T_colour_depth = inverse(T_body_colour) @ depth.T_body_sensor
        if depth.camera != own or not np.allclose(T_colour_depth, np.eye(4)):
            return DepthForm(camera=depth.camera, T_colour_depth=T_colour_depth)
    elif depth.T_BS is not None and not np.allclose(depth.T_BS, T_body_colour, 0, SAME_PLACE):
        raise InputError(
            f"{path}: T_BS is another than cam0's, but there are no intrinsics and resolution to "
            "register depth by; give both, or cam0's T_BS if depth is registered to colour"
        )
    return DepthForm()


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


def _sensor(path: Path) -> _Sensor:
    """What a sensor.yaml says, if there is one. Raises InputError."""
    if not path.is_file():
        return _Sensor()
    said = read_yaml(path)
    if not isinstance(said, dict):
        raise InputError(f"{path}: no mapping; give one with intrinsics: [fu, fv, cu, cv]")
    T_bs = said.get("T_BS", {})
    pose = _numbers(T_bs.get("data") if isinstance(T_bs, dict) else T_bs, 16, path, "T_BS")
    T_BS = None if pose is None else np.array(pose).reshape(4, 4)
    if T_BS is not None and trajectory_of([0.0], [T_BS], f"{path}: T_BS") is None:
        raise InputError(f"{path}: T_BS is no pose; correct it")
    scale = said.get("depth_scale", 1000.0)
    if isinstance(scale, bool) or not isinstance(scale, int | float) or not 0 < scale < 1e9:
        raise InputError(f"{path}: depth_scale is {scale!r}; it must be a number such as 1000")
    return _Sensor(_camera(said, float(scale), path), T_BS, float(scale))


def _camera(said: dict[str, Any], scale: float, path: Path) -> Camera | None:
    """The camera of a sensor.yaml, None if it has no intrinsics or resolution."""
    f = _numbers(said.get("intrinsics"), 4, path, "intrinsics")
    size = _numbers(said.get("resolution"), 2, path, "resolution")
    if f is None or size is None:
        return None
    K = np.array([[f[0], 0, f[2]], [0, f[1], f[3]], [0, 0, 1]])
    camera = camera_of_matrix(K, (int(size[0]), int(size[1])), scale, str(path))
    lens = _numbers(said.get("distortion_coefficients"), 4, path, "distortion_coefficients")
    if lens is None or not any(lens):
        return camera
    if said.get("distortion_model", "") not in _MODELS:
        raise InputError(f"{path}: distortion_model is not radial-tangential; undistort the images")
    return Camera(**{**vars(camera), "distortion": (*lens, 0.0)})


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
    T_body_sensor = _sensor(path.with_name("sensor.yaml")).T_body_sensor
    poses = make_pose(R, table[:, 1:4]) @ inverse(T_body_sensor) @ T_body_colour
    return trajectory_of(table[:, 0] * NANOSECONDS, poses, str(path))
