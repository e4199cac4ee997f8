"""Odometry of OpenCV and Open3D from frame to frame, to be set beside the system's figures.

    python -m benchmarks.cameras.frame_to_frame METHOD SEQUENCE --out FOLDER [--max-frames N]

The library's own defaults, with the published camera; images are undistorted first, which these
libraries leave to their users. Poses are chained. Where the library says that it failed, the camera
is taken to stand still and the pair counts as not tracked. FOLDER gets trajectory.txt, and
odometry.json with the share of tracked frames and the milliseconds of the processor that each pair
took. OpenCV's is not in ``opencv-python-headless`` 4: its wheels are unpacked beside the runs where
they are missing (60 MB each), and only the process that measures imports them.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.paths import ROOT
from bmask_slam.graph.arrays import Array, Floats, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse
from bmask_slam.graph.trajectory import Trajectory, write_tum
from bmask_slam.mapping.open3d_loader import load_open3d
from bmask_slam.sequences.cameras import read_camera
from bmask_slam.sequences.sequence import open_sequence

MODULE = "benchmarks.cameras.frame_to_frame"
WHEELS = {
    "opencv4": "opencv-contrib-python-headless==4.13.0.92",
    "opencv5": "opencv-python-headless==5.0.0.93",
}
"""What has to be installed, and where it is not what the project uses, a folder of its own."""

Step = Callable[[Any, Any], tuple[bool, Array]]
"""Of two prepared frames: whether it worked, and T_second_first."""
Prepare = Callable[[Image, Floats], Any]
"""Of colour (H, W, 3) and depth (H, W) in metres, 0 where missing."""


def open3d_hybrid(camera: Camera) -> tuple[Prepare, Step]:
    """Open3D's ``compute_rgbd_odometry`` with the hybrid Jacobian (Park et al. 2017)."""
    o3d = load_open3d()
    odometry = o3d.pipelines.odometry
    intrinsic = o3d.camera.PinholeCameraIntrinsic(
        camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
    )
    term, option = odometry.RGBDOdometryJacobianFromHybridTerm(), odometry.OdometryOption()

    def prepare(rgb: Image, depth_m: Floats) -> Any:
        images = o3d.geometry.Image(rgb), o3d.geometry.Image(depth_m)
        return o3d.geometry.RGBDImage.create_from_color_and_depth(*images, depth_scale=1.0)

    def step(first: Any, second: Any) -> tuple[bool, Array]:
        worked, T_second_first, _ = odometry.compute_rgbd_odometry(
            first, second, intrinsic, np.eye(4), term, option
        )
        return bool(worked), np.array(T_second_first)

    return prepare, step


def open3d_tensor(camera: Camera) -> tuple[Prepare, Step]:
    """Open3D's ``rgbd_odometry_multi_scale`` on tensors; its default method is the hybrid one."""
    o3d = load_open3d()
    intrinsic = o3d.core.Tensor(camera.K)

    def prepare(rgb: Image, depth_m: Floats) -> Any:
        tensors = (o3d.core.Tensor(np.ascontiguousarray(image)) for image in (rgb, depth_m))
        return o3d.t.geometry.RGBDImage(*(o3d.t.geometry.Image(tensor) for tensor in tensors))

    def step(first: Any, second: Any) -> tuple[bool, Array]:
        try:
            found = o3d.t.pipelines.odometry.rgbd_odometry_multi_scale(
                first, second, intrinsic, depth_scale=1.0
            )
        except RuntimeError:  # it raises where too few pixels overlap
            return False, np.eye(4)
        T_second_first = found.transformation.numpy()
        return bool(np.isfinite(T_second_first).all()), T_second_first

    return prepare, step


def opencv4(camera: Camera) -> tuple[Prepare, Step]:
    """``RgbdOdometry`` of OpenCV 4's contrib (Steinbruecker et al. 2011)."""
    odometry = cv2.rgbd.RgbdOdometry_create(camera.K)

    def prepare(rgb: Image, depth_m: Floats) -> Any:
        mask = np.where(depth_m > 0, 255, 0).astype(np.uint8)
        missing = np.where(depth_m > 0, depth_m, np.nan).astype(np.float32)
        return cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), missing, mask

    def step(first: Any, second: Any) -> tuple[bool, Array]:
        worked, T_second_first = odometry.compute(*first, *second)
        return bool(worked), np.eye(4) if T_second_first is None else T_second_first

    return prepare, step


def opencv5(camera: Camera) -> tuple[Prepare, Step]:
    """``Odometry`` of OpenCV 5 with colour and depth."""
    settings = cv2.OdometrySettings()
    settings.setCameraMatrix(camera.K.astype(np.float32))
    odometry = cv2.Odometry(cv2.OdometryType_RGB_DEPTH, settings, cv2.OdometryAlgoType_COMMON)

    def prepare(rgb: Image, depth_m: Floats) -> Any:
        missing = np.where(depth_m > 0, depth_m, np.nan).astype(np.float32)
        return cv2.OdometryFrame(missing, cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))

    def step(first: Any, second: Any) -> tuple[bool, Array]:
        odometry.prepareFrames(first, second)
        worked, T_second_first = odometry.compute(first, second)
        usable = worked and T_second_first is not None
        return bool(usable), T_second_first if usable else np.eye(4)

    return prepare, step


METHODS = {
    "open3d-hybrid": open3d_hybrid,
    "open3d-tensor": open3d_tensor,
    "opencv4": opencv4,
    "opencv5": opencv5,
}


def undistorter(camera: Camera) -> Callable[[Image, Floats], tuple[Image, Floats]]:
    """Images as a camera without distortion, of the same intrinsics, would have taken them."""
    size = (camera.width, camera.height)
    K, distortion = camera.K, np.array(camera.distortion)
    maps = cv2.initUndistortRectifyMap(K, distortion, None, K, size, cv2.CV_32FC1)

    def undistort(rgb: Image, depth_m: Floats) -> tuple[Image, Floats]:
        depth_m = np.nan_to_num(depth_m, nan=0.0)
        if not distortion.any():
            return rgb, depth_m
        straight = cv2.remap(rgb, *maps, cv2.INTER_LINEAR)
        return straight, cv2.remap(depth_m, *maps, cv2.INTER_NEAREST)

    return undistort


def track(method: str, folder: Path, out: Path, max_frames: int | None) -> None:
    """Chain the poses of a sequence and write them, the share of tracked frames and the times."""
    camera = read_camera(folder / "camera.yaml")
    undistort = undistorter(camera)
    prepare, step = METHODS[method](camera)
    T_world_camera, poses, stamps_s, times_ms = np.eye(4), [], [], []
    failed, previous = 0, None
    for frame in open_sequence(folder, camera=camera).frames(stop=max_frames):
        images = undistort(frame.rgb, frame.depth_m)
        start_s = time.process_time()
        prepared = prepare(*images)
        if previous is not None:
            worked, T_now_before = step(previous, prepared)
            times_ms.append(1e3 * (time.process_time() - start_s))
            failed += not worked
            if worked:
                T_world_camera = T_world_camera @ inverse(T_now_before)
        previous = prepared
        poses.append(T_world_camera)
        stamps_s.append(frame.timestamp_s)
    out.mkdir(parents=True, exist_ok=True)
    write_tum(out / "trajectory.txt", Trajectory(np.array(stamps_s), np.stack(poses)))
    said = {"frames": len(poses), "tracked": 1 - failed / len(poses), "times_ms": times_ms}
    (out / "odometry.json").write_text(json.dumps(said), encoding="utf-8")


def in_its_own_process(method: str, folder: Path, out: Path, wheels: Path) -> None:
    """Track a sequence in a process that finds the wheel of the method, fetched if missing."""
    command = [MODULE, method, str(folder.resolve()), "--out", str(out.resolve())]
    call_with_wheel(command, WHEELS.get(method), wheels.resolve() / method)


def call_with_wheel(command: list[str], wheel: str | None, target: Path) -> None:
    """Run a module in a process that finds a wheel in a folder, fetched there if missing."""
    environment = dict(os.environ)
    if wheel is not None:
        if not target.is_dir():
            pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target"]
            subprocess.run([*pip, str(target), wheel], check=True)
        found = [str(target), environment.get("PYTHONPATH", "")]
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, found))
    whole = [sys.executable, "-m", *command]
    done = subprocess.run(
        whole, cwd=ROOT, env=environment, check=False, capture_output=True, text=True
    )
    if done.returncode:
        raise SystemExit(f"error: {' '.join(command)} failed:\n{done.stderr[-2000:]}")


def main() -> None:
    """Parse and track."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("method", choices=METHODS)
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--max-frames", type=int)
    given = parser.parse_args()
    track(given.method, given.sequence, given.out, given.max_frames)


if __name__ == "__main__":
    main()
