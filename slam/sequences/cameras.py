"""The camera of a sequence: camera.yaml, one of TUM's three known cameras, or a preset."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Container
from dataclasses import astuple
from pathlib import Path
from typing import Any

from bmask_slam.graph.camera import MAX_SIDE_PX, NO_DEPTH_DISTORTION, SIDES, Camera, DepthNoise
from bmask_slam.graph.errors import InputError, did_you_mean, naming
from bmask_slam.graph.files.whole_file import whole_file, writing
from bmask_slam.graph.files.yaml_file import format_yaml, read_yaml
from bmask_slam.sequences.camera_presets import (
    PRESETS,
    TUM_CAMERAS,
    completed,
    is_preset,
    nominal_camera,
    preset_of_folder,
)

logger = logging.getLogger(__name__)

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
OTHERS = ("distortion", "depth_noise", "depth_distortion", "up", "covered")
KEYS = (*REQUIRED, *OTHERS, *OPTIONAL)
MAX_DEPTH_DISTORTION = 0.2
"""In 1/m: an error of 20 cm at 1 m."""
LIMITS = {"depth_offset": 1.0, "depth_time_offset": 1.0, "rolling_shutter": 1.0}
"""Largest magnitudes in metres and seconds: a larger value is in another unit."""
COVERED_CURE = (
    "write [[left, top, right, bottom], ...] in whole pixels, such as [[0, 400, 640, 480]]"
)
NOISE_CURE = (
    "write [a, b, c] of its standard deviation a + b z + c z^2 in metres at z metres, such as "
    "[0.0012, 0, 0.0019]"
)


def find_camera(folder: Path, given: Path | None = None) -> tuple[Camera, str]:
    """The camera of a sequence and a description of its source.

    The file ``given`` has precedence over the folder's camera.yaml, and that over its name. What
    none of them says is filled in from the preset ``given``, or else from that of the recording.

    Raises:
        InputError: a broken camera.yaml, or none, no preset and a folder name that is not TUM's.
    """
    preset = str(given) if is_preset(given) else preset_of_folder(folder)
    path = folder / "camera.yaml" if given is None or is_preset(given) else given
    match = re.search(r"(?<![a-z])(?:freiburg|fr)([123])(?![0-9])", folder.resolve().name.lower())
    keys_in_file: Container[str] = ()
    if path == given or path.is_file():
        camera, keys_in_file = _read(path)
        source = str(path)
    elif match:
        name = f"freiburg{match.group(1)}"
        camera = TUM_CAMERAS[name]
        source = f"built-in {name} (folder name {folder.resolve().name!r}, no camera.yaml)"
    elif is_preset(given):
        camera, source = nominal_camera(str(given)), f"preset {given}, not of this very device"
        logger.warning("%s: intrinsics by the %s; a camera.yaml is more accurate", folder, source)
    else:
        raise InputError(
            f"{path}: no such file, and the folder name {folder.resolve().name!r} is not one of "
            f"TUM's (freiburg1, 2, 3); write a camera.yaml such as {CAMERA_EXAMPLE}, or give "
            "--camera NAME"
        )
    camera, added = completed(camera, keys_in_file, preset)
    source = ", ".join(filter(None, (source, added)))
    logger.info(
        "camera: %s; fx %.3f fy %.3f cx %.3f cy %.3f, depth scale %g to the metre, offsets %g m "
        "and %g s, rolling shutter %g s, distortion of depth %s /m",
        source, camera.fx, camera.fy, camera.cx, camera.cy, camera.depth_scale,
        camera.depth_offset_m, camera.depth_time_offset_s, camera.rolling_shutter_s,
        list(camera.depth_distortion),
    )  # fmt: skip
    return camera, source


def recorded_camera(
    own: Camera, source: str, folder: Path, given: Path | Camera | None = None
) -> tuple[Camera, str]:
    """The camera of a recording that tells its ``own``, and a description of its source.

    A camera or file that is given has precedence, then a camera.yaml in the folder. A preset, given
    or that of the recording's name, adds what the files do not say.

    Raises:
        InputError: a broken camera.yaml.
    """
    if isinstance(given, Camera):
        return given, "given"
    preset = str(given) if is_preset(given) else preset_of_folder(folder)
    file, said = folder / "camera.yaml" if given is None or is_preset(given) else given, set[str]()
    if file == given or file.is_file():
        (own, said), source = _read(file), str(file)
    camera, added = completed(own, said, preset)
    return camera, ", ".join(filter(None, (source, added)))


def given_camera(given: Path, own: Camera | None = None) -> Camera:
    """The camera of a device: the file ``given``, or its ``own`` with what a preset adds.

    Raises:
        InputError: a broken file, or a preset that has no intrinsics where there are no own ones.
    """
    if not is_preset(given):
        return read_camera(given)
    return completed(own or nominal_camera(str(given)), (), str(given))[0]


def read_camera(path: Path) -> Camera:
    """Read camera.yaml; its keys are KEYS.

    Raises:
        InputError: naming the key, its value and the cure.
    """
    return _read(path)[0]


def _read(path: Path) -> tuple[Camera, set[str]]:
    """The camera of a file, and the keys that the file has."""
    values = _values(path)
    numbers = {k: _number(path, k, v) for k, v in values.items() if k not in OTHERS}
    _check_range(path, numbers)
    optional = {name: numbers[key] for key, name in OPTIONAL.items() if key in numbers}
    parts: dict[str, Any] = dict(
        width=int(numbers["width"]),
        height=int(numbers["height"]),
        **{key: numbers[key] for key in ("fx", "fy", "cx", "cy", "depth_scale")},
        distortion=_distortion(path, values.get("distortion", [0, 0, 0, 0, 0])),
        depth_noise=_depth_noise(path, values["depth_noise"]) if "depth_noise" in values else None,
        depth_distortion=_depth_distortion(path, values.get("depth_distortion", [0, 0, 0, 0, 0])),
        up=_up(path, values["up"]) if "up" in values else "",
        covered=_covered(path, values.get("covered", [])),
        reduced_by=1,
        **optional,
    )
    with naming(str(path), f"write it as in {CAMERA_EXAMPLE}"):
        camera = Camera(**parts)
    if bad := camera.not_in_image():
        raise InputError(f"{path}: covered has {bad}, no part of the image; {COVERED_CURE}")
    return camera, set(values)


def _values(path: Path) -> dict[str, object]:
    """The values of a camera.yaml by key, none unknown and none missing. Raises InputError."""
    if not path.is_file():
        near = did_you_mean(str(path), PRESETS)
        raise InputError(
            f"{path}: no such file; give a camera.yaml, or one of {', '.join(PRESETS)}{near}"
        )
    try:
        values = read_yaml(path)
    except InputError as error:
        raise InputError(f"{error}; write e.g. {CAMERA_EXAMPLE}") from error
    if not isinstance(values, dict):
        raise InputError(f"{path}: {values!r} is no mapping; write e.g. {CAMERA_EXAMPLE}")
    for key in values:
        if key not in KEYS:
            known = ", ".join(KEYS)
            raise InputError(f"{path}: unknown key {key!r}; the keys are {known}")
    for key in REQUIRED:
        if key not in values:
            raise InputError(f"{path}: {key} is missing; write e.g. {CAMERA_EXAMPLE}")
    return values


def write_camera(path: Path, camera: Camera, comment: str = "") -> None:
    """Write a camera.yaml, the text of ``format_camera``; it appears whole or not at all."""
    with writing(path), whole_file(path) as temporary:
        temporary.write_text(format_camera(camera, comment), encoding="utf-8")


def format_camera(camera: Camera, comment: str = "") -> str:
    """The text of a camera.yaml that ``read_camera`` reads back as the same camera.

    It is that of the images as recorded, and begins with ``comment``, each line after a #.
    """
    camera = camera.recorded()
    values: dict[str, object] = {key: getattr(camera, key) for key in REQUIRED}
    values |= {"distortion": list(camera.distortion)}
    values |= {key: getattr(camera, name) for key, name in OPTIONAL.items()}
    if camera.depth_noise is not None:
        *sigma, in_graph = astuple(camera.depth_noise)
        values["depth_noise"] = sigma if in_graph == 1 else [*sigma, in_graph]
    if any(camera.depth_distortion):
        values["depth_distortion"] = list(camera.depth_distortion)
    if camera.up:
        values["up"] = camera.up
    if camera.covered:
        values["covered"] = [list(rectangle) for rectangle in camera.covered]
    lines = [f"# {line}".rstrip() for line in comment.splitlines()]
    lines.append(format_yaml(values).rstrip())
    return "\n".join(lines) + "\n"


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
        if numbers[key] > MAX_SIDE_PX:
            raise InputError(f"{path}: {key} is {numbers[key]:g}, more than {MAX_SIDE_PX} pixels")
        if numbers[key] != int(numbers[key]):
            raise InputError(f"{path}: {key} is {numbers[key]:g}; it must be a whole number")
    for key, size in (("cx", "width"), ("cy", "height")):
        if not 0 <= numbers[key] <= numbers[size] - 1:
            raise InputError(
                f"{path}: {key} is {numbers[key]:g}, outside the image of {size} "
                f"{numbers[size]:g}; give the principal point in pixels of this image size"
            )


def _up(path: Path, value: object) -> str:
    """The side of the image that is up in the world."""
    if value not in SIDES:
        raise InputError(
            f"{path}: up is {value!r}; it is the side of the image that is up in the world: "
            f"{', '.join(SIDES)}; leave it out and the network finds it"
        )
    return str(value)


def _covered(path: Path, value: object) -> tuple[tuple[int, int, int, int], ...]:
    """Rectangles of the image."""
    rectangles: list[Any] = value if isinstance(value, list) else [value]
    for one in rectangles:
        if not (isinstance(one, list) and len(one) == 4 and all(type(e) is int for e in one)):
            raise InputError(f"{path}: covered has {one!r}; {COVERED_CURE}")
    return tuple((left, top, right, bottom) for left, top, right, bottom in rectangles)


def _distortion(path: Path, value: object) -> tuple[float, float, float, float, float]:
    """OpenCV's (k1, k2, p1, p2, k3); k3 may be left out."""
    if not isinstance(value, list) or len(value) not in (4, 5):
        raise InputError(f"{path}: distortion is {value!r}; write [k1, k2, p1, p2, k3]")
    k1, k2, p1, p2, k3 = [_number(path, "distortion", v) for v in [*value, 0][:5]]
    return k1, k2, p1, p2, k3


def _depth_distortion(path: Path, value: object) -> tuple[float, float, float, float, float]:
    """Coefficients [u, v, uu, uv, vv] in 1/m of an error that a depth sensor can have."""
    if not isinstance(value, list) or len(value) != len(NO_DEPTH_DISTORTION):
        raise InputError(
            f"{path}: depth_distortion is {value!r}; write [u, v, uu, uv, vv] in 1/m, or leave it "
            "out: bmask-slam calibrate RUN finds it"
        )
    u, v, uu, uv, vv = [_number(path, "depth_distortion", number) for number in value]
    if max(map(abs, (u, v, uu, uv, vv))) > MAX_DEPTH_DISTORTION:
        raise InputError(
            f"{path}: depth_distortion is {value}, more than {MAX_DEPTH_DISTORTION:g} either way; "
            "it is in 1/m, 0.01 is 1 cm at 1 m"
        )
    return u, v, uu, uv, vv


def _depth_noise(path: Path, value: object) -> DepthNoise:
    """The coefficients [a, b, c] of a standard deviation that a depth sensor can have.

    And, where there is a fourth, its factor in the graph.
    """
    if not isinstance(value, list) or len(value) not in (3, 4):
        raise InputError(f"{path}: depth_noise is {value!r}; {NOISE_CURE}")
    noise = DepthNoise(*(_number(path, "depth_noise", v) for v in value))
    if fault := noise.fault():
        raise InputError(f"{path}: depth_noise is {value}{fault}; {NOISE_CURE}")
    return noise
