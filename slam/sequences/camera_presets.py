"""Cameras by name: what is published about each model, and the recordings that it made.

Nothing is guessed: what is not published is None. The sources are beside the values, and in the
table of docs/data.md.
"""

from __future__ import annotations

import re
from collections.abc import Container
from dataclasses import dataclass, replace
from pathlib import Path

from bmask_slam.graph.camera import KINECT_DISPARITY_SIGMA_PX, Camera, DepthNoise
from bmask_slam.graph.errors import InputError

# TUM RGB-D benchmark, ROS/OpenCV calibrations of the colour cameras; freiburg3's images are
# published undistorted. freiburg2's depth is stored with 5208 to the metre (its depth images
# were scaled by 1.035 against the others' 5000 when they were published), as ORB-SLAM2 uses it.
TUM_CAMERAS = {
    "freiburg1": Camera(
        640, 480, 517.306408, 516.469215, 318.643040, 255.313989,
        distortion=(0.262383, -0.953104, -0.005358, 0.002628, 1.163314), depth_scale=5000.0,
    ),
    "freiburg2": Camera(
        640, 480, 520.908620, 521.007327, 325.141442, 249.701764,
        distortion=(0.231222, -0.784899, -0.003257, -0.000105, 0.917205), depth_scale=5208.0,
    ),
    "freiburg3": Camera(640, 480, 535.4, 539.2, 320.1, 247.6, depth_scale=5000.0),
}  # fmt: skip


@dataclass(frozen=True)
class CameraPreset:
    """What is published about one model of RGB-D camera.

    Attributes:
        title: maker and model.
        nominal: colour camera at its native size by the driver's defaults or the published field
            of view; a device of its own differs by some per cent. None: every device tells its own.
        rolling_shutter_s: from the first to the last row of the colour image; 0: global shutter.
        depth_time_offset_s: from the depth image's stamp to when it was taken, in the colour
            image's clock.
        depth_range_m: recommended, from and to.
        depth_noise: standard deviation of a depth; None: the system's default, a Kinect's.
        depth_unit: stored depth values to the metre, as the driver gives them.
    """

    title: str
    nominal: Camera | None
    rolling_shutter_s: float | None = None
    depth_time_offset_s: float | None = None
    depth_range_m: tuple[float, float] | None = None
    depth_noise: DepthNoise | None = None
    depth_unit: float = 1000.0


def _pinhole(width: int, height: int, focal_px: float, depth_scale: float = 1000.0) -> Camera:
    centre = (width - 1) / 2, (height - 1) / 2
    return Camera(width, height, focal_px, focal_px, *centre, depth_scale=depth_scale)


KINECT = replace(DepthNoise.of_disparity(KINECT_DISPARITY_SIGMA_PX, 40.0), in_graph=2.0)
"""2.0 mm z^2, not what laboratories find on a still wall (Khoshelham and Elberink 2012: 1.4 mm z^2;
Nguyen, Izadi, Lovell 2012: 1.2 mm + 1.9 mm (z - 0.4)^2): the depths of one point from two keyframes
differ by 0.9 to 1.4 times this on real recordings, and smaller values lose tracked frames."""

PRESETS = {
    # OpenNI's default focal length; rows 54.21 us apart at 30 Hz, 480 of them (measured on the
    # MT9M112 by exposure, libfreenect pull request 670); range: Kinect for Windows SDK 1.8.
    "kinect-v1": CameraPreset(
        "Microsoft Kinect for Xbox 360", _pinhole(640, 480, 525.0), 0.0260,
        depth_range_m=(0.8, 4.0), depth_noise=KINECT,
    ),
    # The same reference design. Readout: nothing published; 31.0 +- 2.3 ms by this project's
    # self-calibration on Bonn's rgbd_bonn_crowd; range: ASUS.
    "xtion": CameraPreset(
        "ASUS Xtion Pro Live", _pinhole(640, 480, 525.0), 0.0310,
        depth_range_m=(0.8, 3.5), depth_noise=KINECT,
    ),
    # Colour camera: libfreenect2's defaults; range: Microsoft.
    "kinect-v2": CameraPreset(
        "Microsoft Kinect for Xbox One", _pinhole(1920, 1080, 1081.37), depth_range_m=(0.5, 4.5)
    ),
    # Range and random error (<= 17 mm) of NFOV unbinned: Azure Kinect DK hardware specification.
    # Both stamps are of the middle of the exposure (Azure-Kinect-Sensor-SDK issue 868), with no
    # delay unless depth_delay_off_color_usec is set; no readout time is published (issue 1062).
    "azure-kinect": CameraPreset(
        "Microsoft Azure Kinect DK", None, depth_time_offset_s=0.0,
        depth_range_m=(0.5, 3.86), depth_noise=DepthNoise(0.017),
    ),
    # Field of view 69.4 deg, rolling colour shutter of unpublished time: D400 datasheet. Noise:
    # subpixel error 0.08 px, focal length 645 px at 1280 columns, baseline 50 mm (Intel, tuning).
    "realsense-d435": CameraPreset(
        "Intel RealSense D435", _pinhole(1920, 1080, 1386.0),
        depth_range_m=(0.3, 3.0), depth_noise=DepthNoise.of_disparity(0.08, 645 * 0.050),
    ),
    # Field of view 90 deg, global shutter, baseline 95 mm: D400 datasheet; noise as above.
    "realsense-d455": CameraPreset(
        "Intel RealSense D455", _pinhole(1280, 800, 640.0), 0.0,
        depth_range_m=(0.6, 6.0), depth_noise=DepthNoise.of_disparity(0.08, 640 * 0.095),
    ),
    # IMX378, field of view 66 deg, rolling shutter of unpublished time: docs.luxonis.com.
    "oak-d": CameraPreset(
        "Luxonis OAK-D", _pinhole(1920, 1080, 1478.0), depth_range_m=(0.7, 12.0)
    ),
    # Colour is the tablet's. Precision 0.5 mm at 0.4 m and 30 mm at 3 m, range: Occipital.
    "structure": CameraPreset(
        "Occipital Structure Sensor", None,
        depth_range_m=(0.4, 3.5), depth_noise=DepthNoise(c_per_m=0.03 / 9),
    ),
    # ARKit gives the intrinsics of every frame; range: Apple.
    "iphone-lidar": CameraPreset("Apple iPhone, iPad with LiDAR", None, depth_range_m=(0.3, 5.0)),
}  # fmt: skip

FOLDERS = (
    (re.compile(r"(?<![a-z])(?:freiburg|fr)[12](?![0-9])"), "kinect-v1"),
    (re.compile(r"(?<![a-z])(?:freiburg|fr)3(?![0-9])"), "xtion"),
    (re.compile(r"(?<![a-z])bonn(?![a-z])"), "xtion"),
    (re.compile(r"(?<![a-z])red_?kitchen(?![a-z])|7-?scenes(?![a-z])"), "kinect-v1"),
)
"""Names of published recordings, and what took them: the TUM RGB-D benchmark (the third room by
an Xtion, all others by a Kinect), Bonn's dynamic dataset, and 7-Scenes (a Kinect: Shotton et al.
2013). Of the last one's rooms only one has a name that nobody else uses."""


def is_preset(given: Path | None) -> bool:
    """Whether what was given as a camera is the name of a preset, and no file of that name."""
    return given is not None and str(given) in PRESETS and not given.is_file()


def preset_of_folder(folder: Path) -> str | None:
    """The preset of a published recording, by the name of its folder."""
    name = folder.resolve().name.lower()
    return next((preset for pattern, preset in FOLDERS if pattern.search(name)), None)


def nominal_camera(name: str) -> Camera:
    """The camera of a preset alone. Raises InputError where no intrinsics are published."""
    preset = PRESETS[name]
    if preset.nominal is None:
        raise InputError(
            f"--camera {name}: every {preset.title} has intrinsics of its own, which it tells; "
            "write them into the sequence's camera.yaml, the rest is known"
        )
    return replace(preset.nominal, depth_scale=preset.depth_unit)


def completed(camera: Camera, keys_in_file: Container[str], name: str | None) -> tuple[Camera, str]:
    """The camera with what a preset knows and nothing else said, and that as text.

    ``keys_in_file`` are the keys of camera.yaml that are known; a value there, also 0, stays.
    """
    if name is None:
        return camera, ""
    preset, values, parts = PRESETS[name], camera, []
    if preset.rolling_shutter_s is not None and "rolling_shutter" not in keys_in_file:
        values = replace(values, rolling_shutter_s=preset.rolling_shutter_s)
        parts.append(f"rolling_shutter {1e3 * preset.rolling_shutter_s:g} ms")
    if preset.depth_time_offset_s is not None and "depth_time_offset" not in keys_in_file:
        values = replace(values, depth_time_offset_s=preset.depth_time_offset_s)
        parts.append(f"depth_time_offset {1e3 * preset.depth_time_offset_s:g} ms")
    if preset.depth_noise is not None and "depth_noise" not in keys_in_file:
        values = replace(values, depth_noise=preset.depth_noise)
        parts.append("depth noise")
    return values, f"{', '.join(parts)} of {name}" if parts else ""
