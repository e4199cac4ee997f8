"""Folders of numbered images: 7-Scenes, ScanNet as exported, Replica, ICL-NUIM, Open3D."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from pydantic import Field

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError, naming
from bmask_slam.graph.files.json_file import STRICT, read_json
from bmask_slam.graph.files.reading import read_lines
from bmask_slam.graph.geometry import inverse, make_pose
from bmask_slam.graph.trajectory import Trajectory, read_tum
from bmask_slam.semantics.instances.image_files import decode_image
from bmask_slam.sequences.cameras import recorded_camera
from bmask_slam.sequences.formats.numbered import (
    CAMERA_CURE,
    FPS_HZ,
    camera_of_matrix,
    image_list,
    matrix_of,
    numbered,
    read_matrix,
    trajectory_of,
)
from bmask_slam.sequences.lists import read_associations, sorted_list
from bmask_slam.sequences.recording import DepthForm, Recording

Given = Path | Camera | None
_DIGITS = r"(\d{1,9})"

# 7-Scenes (Shotton et al., CVPR 2013): Kinect 1, not registered. The depth camera's f of 585 px is
# published; colour's is OpenNI's, and so is the distance of 25 mm between the two.
SCENES_COLOUR = Camera(640, 480, 525.0, 525.0, 320.0, 240.0, depth_scale=1000.0)
SCENES_DEPTH = Camera(640, 480, 585.0, 585.0, 320.0, 240.0, depth_scale=1000.0)
SCENES_T_COLOUR_DEPTH = make_pose(np.eye(3), np.array([-0.025, 0.0, 0.0]))
SCENES_MISSING = 65535

ICL_CAMERA = Camera(640, 480, 481.2, 480.0, 319.5, 239.5, depth_scale=5000.0)
ICL_FIRST_POSE = 1
"""ICL-NUIM counts images from 0 and poses from 1."""
ICL_FLIP = np.diag([1.0, -1.0, 1.0, 1.0])
REPLICA_CAMERA = Camera(1200, 680, 600.0, 600.0, 599.5, 339.5, depth_scale=6553.5)
"""Of NICE-SLAM's renderings."""


def is_seven_scenes(folder: Path) -> bool:
    """Whether it is a seq-NN folder of 7-Scenes."""
    return next(folder.glob("frame-*.color.png"), None) is not None


def open_seven_scenes(folder: Path, given: Given) -> Recording:
    """Depth is registered; poses are the depth camera's. Raises InputError."""
    colour = numbered(folder, rf"frame-{_DIGITS}\.color\.png")
    depth = numbered(folder, rf"frame-{_DIGITS}\.depth\.png")
    poses = numbered(folder, rf"frame-{_DIGITS}\.pose\.txt")
    T_depth_colour = inverse(SCENES_T_COLOUR_DEPTH)
    truth = trajectory_of(
        (number / FPS_HZ for number in poses),
        (read_matrix(path) @ T_depth_colour for path in poses.values()),
        str(folder),
    )
    source = "7-Scenes, nominal values of a Kinect"
    camera, source = recorded_camera(SCENES_COLOUR, source, folder, given)
    form = DepthForm(SCENES_MISSING, SCENES_DEPTH, SCENES_T_COLOUR_DEPTH)
    return Recording(
        "7-Scenes", folder, image_list(colour, FPS_HZ, folder, "colour"),
        image_list(depth, FPS_HZ, folder, "depth"), camera, source, truth, form,
    )  # fmt: skip


def _scannet_intrinsics(folder: Path, of: str) -> Path:
    """The file of a camera's intrinsics; it need not be there."""
    inside = folder / "intrinsic" / f"intrinsic_{of}.txt"
    return inside if inside.is_file() else folder / f"intrinsic_{of}.txt"


def is_scannet(folder: Path) -> bool:
    """Whether it is a scene as ScanNet's SensReader exports it."""
    return (folder / "color").is_dir() and _scannet_intrinsics(folder, "color").is_file()


def open_scannet(folder: Path, given: Given) -> Recording:
    """Depth is coarser than colour and is registered. Raises InputError."""
    colour = numbered(folder / "color", rf"{_DIGITS}\.(?:jpg|png)")
    depth = numbered(folder / "depth", rf"{_DIGITS}\.png")
    poses = numbered(folder / "pose", rf"{_DIGITS}\.txt")
    lists = [image_list(f, FPS_HZ, folder, n) for f, n in ((colour, "colour"), (depth, "depth"))]
    cameras = []
    for files, name in ((colour, "color"), (depth, "depth")):
        path = _scannet_intrinsics(folder, name)
        first = decode_image(next(iter(files.values())), cv2.IMREAD_UNCHANGED)
        size = (first.shape[1], first.shape[0])
        cameras.append(camera_of_matrix(read_matrix(path), size, 1000.0, str(path)))
    matrices = (read_matrix(path) for path in poses.values())
    truth = trajectory_of((k / FPS_HZ for k in poses), matrices, str(folder / "pose"))
    camera, source = recorded_camera(cameras[0], "intrinsic_color.txt", folder, given)
    form = DepthForm(camera=cameras[1])
    return Recording("ScanNet", folder, lists[0], lists[1], camera, source, truth, form)


@dataclass(frozen=True)
class _ReplicaCamera:
    __pydantic_config__ = STRICT
    w: Annotated[int, Field(gt=0, lt=1 << 16)]
    h: Annotated[int, Field(gt=0, lt=1 << 16)]
    fx: float
    fy: float
    cx: float
    cy: float
    scale: float


@dataclass(frozen=True)
class _ReplicaFile:
    __pydantic_config__ = STRICT
    camera: _ReplicaCamera


def is_replica(folder: Path) -> bool:
    """Whether it is a scene of Replica as NICE-SLAM rendered it."""
    return (folder / "traj.txt").is_file() and (folder / "results").is_dir()


def open_replica(folder: Path, given: Given) -> Recording:
    """The camera is that of cam_params.json, here or a folder above. Raises InputError."""
    colour = numbered(folder / "results", rf"frame{_DIGITS}\.(?:jpg|png)")
    depth = numbered(folder / "results", rf"depth{_DIGITS}\.png")
    path = folder / "traj.txt"
    rows = [(number, text) for number, text in read_lines(path, "restore it")]
    poses = [matrix_of(text, f"{path}:{number}") for number, text in rows]
    truth = trajectory_of(np.arange(len(poses)) / FPS_HZ, poses, str(path))
    own, source = REPLICA_CAMERA, "NICE-SLAM's Replica"
    for file in (folder / "cam_params.json", folder.resolve().parent / "cam_params.json"):
        if file.is_file():
            c = read_json(file, _ReplicaFile, "restore it, or give --camera F").camera
            with naming(str(file), CAMERA_CURE):
                own = Camera(c.w, c.h, c.fx, c.fy, c.cx, c.cy, depth_scale=c.scale)
            source = str(file)
            break
    camera, source = recorded_camera(own, source, folder, given)
    return Recording(
        "Replica", folder, image_list(colour, FPS_HZ, folder, "colour"),
        image_list(depth, FPS_HZ, folder, "depth"), camera, source, truth,
    )  # fmt: skip


def is_icl_nuim(folder: Path) -> bool:
    """Whether it is a sequence of ICL-NUIM in PNG."""
    listed = (folder / "associations.txt").is_file() and not (folder / "rgb.txt").is_file()
    return listed and next(folder.glob("*.gt.freiburg"), None) is not None


def open_icl_nuim(folder: Path, given: Given) -> Recording:
    """Lists hold frame numbers. Raises InputError."""
    rgb, depth = read_associations(folder / "associations.txt")
    lists = [sorted_list(folder, each.timestamps_s / FPS_HZ, each.files) for each in (rgb, depth)]
    camera, source = recorded_camera(ICL_CAMERA, "ICL-NUIM", folder, given)
    truth = icl_truth(folder)
    return Recording("ICL-NUIM", folder, lists[0], lists[1], camera, source, truth)


def icl_truth(folder: Path) -> Trajectory:
    """T_world_camera of a folder's *.gt.freiburg with stamps in seconds.

    ICL-NUIM's camera has y upward (fy < 0), so that its world is mirrored compared with images
    whose y points down: the pose becomes ``F T F`` with F = diag(1, -1, 1, 1).

    Raises:
        InputError: no such file, or a broken one.
    """
    poses = sorted(folder.glob("*.gt.freiburg"))
    if len(poses) != 1:
        raise InputError(f"{folder}: {len(poses)} files *.gt.freiburg, expected one")
    truth = read_tum(poses[0])
    stamps_s = (truth.timestamps_s - ICL_FIRST_POSE) / FPS_HZ
    return Trajectory(stamps_s, ICL_FLIP @ truth.poses_world_camera @ ICL_FLIP)


@dataclass(frozen=True)
class _Open3dCamera:
    __pydantic_config__ = STRICT
    width: Annotated[int, Field(gt=0, lt=1 << 16)]
    height: Annotated[int, Field(gt=0, lt=1 << 16)]
    intrinsic_matrix: Annotated[list[float], Field(min_length=9, max_length=9)]
    depth_scale: float = 1000.0


def _open3d_intrinsics(folder: Path) -> Path:
    """The intrinsics as Open3D's recorders or its readers of .bag and .mkv write them."""
    first = folder / "camera_intrinsic.json"
    return first if first.is_file() else folder / "intrinsic.json"


def is_open3d(folder: Path) -> bool:
    """Whether Open3D recorded or unpacked it."""
    return (folder / "color").is_dir() and _open3d_intrinsics(folder).is_file()


def open_open3d(folder: Path, given: Given) -> Recording:
    """Depth is registered by Open3D already; matrices are by columns. Raises InputError.

    Stamps are numbers over the camera's rate.
    """
    colour = numbered(folder / "color", rf"{_DIGITS}\.(?:jpg|png)")
    depth = numbered(folder / "depth", rf"{_DIGITS}\.png")
    path = _open3d_intrinsics(folder)
    said = read_json(path, _Open3dCamera, "restore it, or give --camera F")
    K = np.array(said.intrinsic_matrix).reshape(3, 3).T
    own = camera_of_matrix(K, (said.width, said.height), said.depth_scale, str(path))
    camera, source = recorded_camera(own, str(path), folder, given)
    return Recording(
        "Open3D", folder, image_list(colour, camera.fps, folder, "colour"),
        image_list(depth, camera.fps, folder, "depth"), camera, source,
    )  # fmt: skip
