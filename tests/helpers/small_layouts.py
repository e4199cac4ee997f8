"""Small recordings in every layout: three frames of a wall, by each layout's conventions."""

from __future__ import annotations

import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, quaternion_from_rotation, se3_exp

FRAMES = 3
COLOUR = Camera(32, 24, 30.0, 30.0, 15.5, 11.5, depth_scale=1000.0)
COARSE = Camera(16, 12, 15.0, 15.0, 7.5, 5.5, depth_scale=1000.0)
"""The camera of coarser depth with the same view."""
WALL_M = 2.0
POSES = [se3_exp(np.array([0.3, 0.2 * k, 0.1, 0.5, 0.2 * k, -0.3])) for k in range(FRAMES)]
"""T_world_camera, x right, y down, z forward."""
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def colour(k: int, camera: Camera = COLOUR) -> np.ndarray:
    """An image (H, W, 3), red first: a ramp of the frame's colour."""
    ramp = np.linspace(0, 200, camera.width, dtype=np.uint8)
    rows = np.tile(ramp, (camera.height, 1))
    return np.stack([rows, np.full_like(rows, 40 * k), np.full_like(rows, 250)], axis=-1)


def depth_m(camera: Camera = COLOUR) -> np.ndarray:
    """A wall before the camera, without depth in the second quarter of the columns."""
    wall = np.full((camera.height, camera.width), WALL_M)
    wall[:, hole(camera)] = 0
    return wall


def hole(camera: Camera) -> slice:
    """The columns without depth."""
    return slice(camera.width // 4, camera.width // 2)


def _image(path: Path, rgb: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), rgb[..., ::-1])


def _depth(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.rint(values).astype(np.uint16))


def _matrix(path: Path, T: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(" ".join(f"{v:.9f}" for v in row) for row in T) + "\n")


def write_tum(folder: Path) -> None:
    lines = [f"{k / 30:.6f} {{0}}/{k}.png\n" for k in range(FRAMES)]
    for k in range(FRAMES):
        _image(folder / f"rgb/{k}.png", colour(k))
        _depth(folder / f"depth/{k}.png", 1000 * depth_m())
    for kind in ("rgb", "depth"):
        (folder / f"{kind}.txt").write_text("".join(lines).format(kind))
    (folder / "camera.yaml").write_text(
        "{width: 32, height: 24, fx: 30, fy: 30, cx: 15.5, cy: 11.5, depth_scale: 1000}"
    )
    rows = [
        f"{k / 30:.6f} {' '.join(map(str, [*T[:3, 3], *quaternion_from_rotation(T[:3, :3])]))}\n"
        for k, T in enumerate(POSES)
    ]
    (folder / "groundtruth.txt").write_text("".join(rows))


SCENES_COLOUR = Camera(640, 480, 525.0, 525.0, 320.0, 240.0)
SCENES_DEPTH = replace(SCENES_COLOUR, fx=585.0, fy=585.0)


def write_seven_scenes(folder: Path) -> None:
    """Depth of a camera 25 mm to the left of colour's; missing is 65535; poses are its own."""
    T_depth_colour = np.eye(4)
    T_depth_colour[0, 3] = 0.025
    for k, T in enumerate(POSES):
        _image(folder / f"frame-{k:06d}.color.png", colour(k, SCENES_COLOUR))
        values = 1000 * depth_m(SCENES_DEPTH)
        _depth(folder / f"frame-{k:06d}.depth.png", np.where(values > 0, values, 65535))
        _matrix(folder / f"frame-{k:06d}.pose.txt", T @ inverse(T_depth_colour))


def _square(camera: Camera) -> np.ndarray:
    K = np.eye(4)
    K[:3, :3] = camera.K
    return K


def write_scannet(folder: Path) -> None:
    for k, T in enumerate(POSES):
        _image(folder / f"color/{k}.jpg", colour(k))
        _depth(folder / f"depth/{k}.png", 1000 * depth_m(COARSE))
        _matrix(folder / f"pose/{k}.txt", T)
    _matrix(folder / "pose/1.txt", np.full((4, 4), -np.inf))
    _matrix(folder / "intrinsic/intrinsic_color.txt", _square(COLOUR))
    _matrix(folder / "intrinsic/intrinsic_depth.txt", _square(COARSE))


def write_sens(path: Path) -> None:
    """Two extrinsics, of which that of depth is 10 cm to the right of colour's on the rig."""
    T_rig_depth = np.eye(4)
    T_rig_depth[0, 3] = 0.1
    matrices = [_square(COLOUR), np.eye(4), _square(COARSE), T_rig_depth]
    data = struct.pack("<IQ", 4, 5) + b"Kinec"
    data += struct.pack("<64f", *np.ravel(matrices))
    data += struct.pack("<2i4IfQ", 2, 1, 32, 24, 16, 12, 1000.0, FRAMES)
    for k, T in enumerate(POSES):
        image = cv2.imencode(".jpg", colour(k)[..., ::-1])[1].tobytes()
        packed = zlib.compress(np.rint(1000 * depth_m(COARSE)).astype("<u2").tobytes())
        ticks = round(1e6 + 1e6 * k / 30)
        data += struct.pack("<16f4Q", *T.ravel(), ticks, ticks, len(image), len(packed))
        data += image + packed
    path.write_bytes(data)


def write_replica(folder: Path) -> None:
    said = {"w": 32, "h": 24, "fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 11.5, "scale": 6553.5}
    for k in range(FRAMES):
        _image(folder / f"results/frame{k:06d}.jpg", colour(k))
        _depth(folder / f"results/depth{k:06d}.png", 6553.5 * depth_m())
    (folder / "cam_params.json").write_text(json.dumps({"camera": said}))
    lines = [" ".join(f"{v:.9e}" for v in T.ravel()) for T in POSES]
    (folder / "traj.txt").write_text("\n".join(lines) + "\n")


def write_icl_nuim(folder: Path) -> None:
    """Lists of frame numbers, depth first; poses count from 1, of a camera with y upward."""
    icl = Camera(640, 480, 481.2, 480.0, 319.5, 239.5)
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    lines, rows = [], []
    for k, T in enumerate(POSES):
        _image(folder / f"rgb/{k}.png", colour(k, icl))
        _depth(folder / f"depth/{k}.png", 5000 * depth_m(icl))
        lines.append(f"{k} depth/{k}.png {k} rgb/{k}.png\n")
        M = mirror @ T @ mirror
        words = [*M[:3, 3], *quaternion_from_rotation(M[:3, :3])]
        rows.append(f"{k + 1} {' '.join(map(str, words))}\n")
    (folder / "associations.txt").write_text("".join(lines))
    (folder / "livingRoom0.gt.freiburg").write_text("".join(rows))


def write_euroc(folder: Path) -> None:
    """The depth camera is coarser and 10 cm to the right of colour's; the body turned by both."""
    T_body_colour = se3_exp(np.array([0.2, -0.1, 0.4, 0.1, 0.0, -0.2]))
    T_colour_depth = np.eye(4)
    T_colour_depth[0, 3] = 0.1
    truth = ["#timestamp, p_x, p_y, p_z, q_w, q_x, q_y, q_z\n"]
    for name, camera, T in (
        ("cam0", COLOUR, T_body_colour),
        ("depth0", COARSE, T_body_colour @ T_colour_depth),
    ):
        lines = ["#timestamp [ns],filename\n"]
        for k in range(FRAMES):
            stamp = f"{round(1e9 * (1 + k / 30))}"
            lines.append(f"{stamp},{stamp}.png\n")
            if name == "cam0":
                _image(folder / f"mav0/cam0/data/{stamp}.png", colour(k))
            else:
                _depth(folder / f"mav0/depth0/data/{stamp}.png", 1000 * depth_m(COARSE))
        (folder / f"mav0/{name}/data.csv").write_text("".join(lines))
        (folder / f"mav0/{name}/sensor.yaml").write_text(
            f"sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: {T.ravel().tolist()}\n"
            f"resolution: [{camera.width}, {camera.height}]\n"
            f"intrinsics: [{camera.fx}, {camera.fy}, {camera.cx}, {camera.cy}]\n"
            "distortion_model: radial-tangential\ndistortion_coefficients: [0, 0, 0, 0]\n"
        )
    for k, T in enumerate(POSES):
        B = T @ inverse(T_body_colour)
        x, y, z, w = quaternion_from_rotation(B[:3, :3])
        words = [round(1e9 * (1 + k / 30)), *B[:3, 3], w, x, y, z, 0, 0, 0]
        truth.append(",".join(map(str, words)) + "\n")
    (folder / "mav0/state_groundtruth_estimate0").mkdir()
    (folder / "mav0/state_groundtruth_estimate0/data.csv").write_text("".join(truth))


def write_open3d(folder: Path) -> None:
    for k in range(FRAMES):
        _image(folder / f"color/{k:06d}.jpg", colour(k))
        _depth(folder / f"depth/{k:06d}.png", 1000 * depth_m())
    said = {"width": 32, "height": 24, "intrinsic_matrix": COLOUR.K.T.ravel().tolist()}
    (folder / "camera_intrinsic.json").write_text(json.dumps(said))


def raw_lzfse(data: bytes) -> bytes:
    """A stream of one block that is not packed."""
    return b"bvx-" + struct.pack("<I", len(data)) + data + b"bvx$"


def write_r3d(path: Path, pack: Callable[[bytes], bytes] = raw_lzfse) -> None:
    rows = []
    for T in POSES:
        A = T @ FLIP
        rows.append([*quaternion_from_rotation(A[:3, :3]).tolist(), *A[:3, 3].tolist()])
    said = {
        "w": 32, "h": 24, "dw": 16, "dh": 12, "fps": 30, "K": COLOUR.K.T.ravel().tolist(),
        "poses": rows, "frameTimestamps": [1 + k / 30 for k in range(FRAMES)],
    }  # fmt: skip
    with zipfile.ZipFile(path, "w") as packed:
        packed.writestr("metadata", json.dumps(said))
        for k in range(FRAMES):
            image = cv2.imencode(".jpg", colour(k)[..., ::-1])[1].tobytes()
            packed.writestr(f"rgbd/{k}.jpg", image)
            values = np.where(depth_m(COARSE) > 0, depth_m(COARSE), np.nan).astype("<f4")
            packed.writestr(f"rgbd/{k}.depth", pack(values.tobytes()))


def write_polycam(folder: Path) -> None:
    for k, T in enumerate(POSES):
        name = f"{round(1e6 * (1 + k / 30))}"
        _image(folder / f"keyframes/images/{name}.jpg", colour(k))
        _depth(folder / f"keyframes/depth/{name}.png", 1000 * depth_m(COARSE))
        A = T @ FLIP
        said = {f"t_{i}{j}": A[i, j] for i in range(3) for j in range(4)}
        said |= {"width": 32, "height": 24, "fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 11.5}
        path = folder / f"keyframes/cameras/{name}.json"
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps(said))


@dataclass(frozen=True)
class SmallLayout:
    """A layout: the name of what is written, its writer, and what it should read back as.

    Attributes:
        camera, depth: of colour and of depth.
        begin_s: stamp of the first frame.
        poses: that can be used.
        shift_m: place of the depth camera, to the right of colour's.
    """

    name: str
    file: str
    write: Callable[[Path], None]
    camera: Camera = COLOUR
    depth: Camera = COLOUR
    begin_s: float = 0.0
    poses: int = FRAMES
    shift_m: float = 0.0


ICL = Camera(640, 480, 481.2, 480.0, 319.5, 239.5)
SMALL_LAYOUTS = (
    SmallLayout("TUM", "tum", write_tum),
    SmallLayout(
        "7-Scenes", "seq-01", write_seven_scenes, SCENES_COLOUR, SCENES_DEPTH, shift_m=-0.025
    ),
    SmallLayout("ScanNet", "scene", write_scannet, depth=COARSE, poses=2),
    SmallLayout("ScanNet .sens", "scene.sens", write_sens, COLOUR, COARSE, 1.0, shift_m=0.1),
    SmallLayout("Replica", "room0", write_replica),
    SmallLayout("ICL-NUIM", "lr0", write_icl_nuim, ICL, ICL),
    SmallLayout("EuRoC", "V1", write_euroc, COLOUR, COARSE, 1.0, shift_m=0.1),
    SmallLayout("Open3D", "realsense", write_open3d, poses=0),
    SmallLayout("Record3D", "a.r3d", write_r3d, COLOUR, COARSE, 1.0),
    SmallLayout("Polycam", "poly", write_polycam, COLOUR, COARSE, 1.0),
)


def write_small(layout: SmallLayout, parent: Path) -> Path:
    """The recording in a layout, in a folder of its own or as a file."""
    path = parent / layout.file
    if not path.suffix:
        path.mkdir(parents=True)
    layout.write(path)
    return path
