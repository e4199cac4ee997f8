"""The camera of a sequence: camera.yaml, or one of TUM's three known cameras."""

from __future__ import annotations

import logging
import math
import re
from pathlib import Path

from bmask_slam.config.yaml import format_yaml, parse_yaml
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.whole_file import whole_file

logger = logging.getLogger(__name__)

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

CAMERA_EXAMPLE = (
    "{width: 640, height: 480, fx: 525.0, fy: 525.0, cx: 319.5, cy: 239.5, "
    "distortion: [0, 0, 0, 0, 0], depth_scale: 5000, fps: 30}"
)
REQUIRED = ("width", "height", "fx", "fy", "cx", "cy", "depth_scale")
OPTIONAL = {
    "fps": "fps",
    "stereo_bf": "stereo_bf_px_m",
    "depth_offset": "depth_offset_m",
    "depth_time_offset": "depth_time_offset_s",
    "rolling_shutter": "rolling_shutter_s",
}
"""Optional numbers by the name of Camera's attribute."""
KEYS = (*REQUIRED, "distortion", *OPTIONAL)
LIMITS = {"depth_offset": 1.0, "depth_time_offset": 1.0, "rolling_shutter": 1.0}
"""Largest magnitudes in metres and seconds: a larger value is in another unit."""


def find_camera(folder: Path, given: Path | None = None) -> tuple[Camera, str]:
    """The camera of a sequence and a description of its source.

    The file ``given`` has precedence over the folder's camera.yaml, and that over its name.

    Raises:
        InputError: a broken camera.yaml, or none and a folder name that is not TUM's.
    """
    path = given or folder / "camera.yaml"
    match = re.search(r"(?<![a-z])(?:freiburg|fr)([123])(?![0-9])", folder.resolve().name.lower())
    if given or path.is_file():
        camera, source = read_camera(path), str(path)
    elif match:
        name = f"freiburg{match.group(1)}"
        camera = TUM_CAMERAS[name]
        source = f"built-in {name} (folder name {folder.resolve().name!r}, no camera.yaml)"
    else:
        raise InputError(
            f"{path}: no such file, and the folder name {folder.resolve().name!r} is not one of "
            f"TUM's (freiburg1, 2, 3); write a camera.yaml such as {CAMERA_EXAMPLE}"
        )
    logger.info(
        "camera: %s; fx %.3f fy %.3f cx %.3f cy %.3f, "
        "depth scale %g to the metre, offsets %g m and %g s",
        source, camera.fx, camera.fy, camera.cx, camera.cy,
        camera.depth_scale, camera.depth_offset_m, camera.depth_time_offset_s,
    )  # fmt: skip
    return camera, source


def read_camera(path: Path) -> Camera:
    """Read camera.yaml: the keys are REQUIRED, ``distortion`` and OPTIONAL.

    Raises:
        InputError: naming the key, its value and the cure.
    """
    try:
        values = parse_yaml(path.read_text(encoding="utf-8"), path.name)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); give a camera.yaml"
        ) from error
    except (InputError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not YAML ({error}); write e.g. {CAMERA_EXAMPLE}") from error
    if not isinstance(values, dict):
        raise InputError(f"{path}: {values!r} is no mapping; write e.g. {CAMERA_EXAMPLE}")
    for key in values:
        if key not in KEYS:
            known = ", ".join(KEYS)
            raise InputError(f"{path}: unknown key {key!r}; the keys are {known}")
    for key in REQUIRED:
        if key not in values:
            raise InputError(f"{path}: {key} is missing; write e.g. {CAMERA_EXAMPLE}")
    numbers = {k: _number(path, k, v) for k, v in values.items() if k != "distortion"}
    _check_range(path, numbers)
    optional = {name: numbers[key] for key, name in OPTIONAL.items() if key in numbers}
    return Camera(
        width=int(numbers["width"]),
        height=int(numbers["height"]),
        **{key: numbers[key] for key in ("fx", "fy", "cx", "cy", "depth_scale")},
        distortion=_distortion(path, values.get("distortion", [0, 0, 0, 0, 0])),
        **optional,
    )


def write_camera(path: Path, camera: Camera, comment: str = "") -> None:
    """Write a camera.yaml that ``read_camera`` reads back as the same camera.

    The file begins with ``comment``, each line after a #. It appears whole or not at all.
    """
    values: dict[str, object] = {key: getattr(camera, key) for key in REQUIRED}
    values |= {"distortion": list(camera.distortion)}
    values |= {key: getattr(camera, name) for key, name in OPTIONAL.items()}
    lines = [f"# {line}".rstrip() for line in comment.splitlines()]
    lines.append(format_yaml(values).rstrip())
    try:
        with whole_file(path) as temporary:
            temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from error


def _number(path: Path, key: str, value: object) -> float:
    """The value as a finite number; truth values and text are refused."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{path}: {key} is {value!r}; it must be a number, e.g. 525.0")
    return float(value)


def _check_range(path: Path, numbers: dict[str, float]) -> None:
    """Refuse sizes, focal lengths and scales that are impossible."""
    for key, value in numbers.items():
        if key not in ("cx", "cy", *LIMITS) and value <= 0:
            raise InputError(f"{path}: {key} is {value:g}; it must be positive")
        if abs(value) > LIMITS.get(key, math.inf):
            raise InputError(
                f"{path}: {key} is {value:g}, more than {LIMITS[key]:g} either way; "
                "depth_offset is in metres, depth_time_offset and rolling_shutter in seconds"
            )
    for key in ("width", "height"):
        if numbers[key] != int(numbers[key]):
            raise InputError(f"{path}: {key} is {numbers[key]:g}; it must be a whole number")
    for key, size in (("cx", "width"), ("cy", "height")):
        if not 0 <= numbers[key] <= numbers[size] - 1:
            raise InputError(
                f"{path}: {key} is {numbers[key]:g}, outside the image of {size} "
                f"{numbers[size]:g}; give the principal point in pixels of this image size"
            )


def _distortion(path: Path, value: object) -> tuple[float, float, float, float, float]:
    """OpenCV's (k1, k2, p1, p2, k3); k3 may be left out."""
    if not isinstance(value, list) or len(value) not in (4, 5):
        raise InputError(f"{path}: distortion is {value!r}; write [k1, k2, p1, p2, k3]")
    k1, k2, p1, p2, k3 = [_number(path, "distortion", v) for v in [*value, 0][:5]]
    return k1, k2, p1, p2, k3
