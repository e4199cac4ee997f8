"""Depth cameras that are plugged in: by USB, and by every camera library that is installed.

``python -m bmask_slam.doctor.cameras LIBRARY`` prints what one library finds: drivers are asked in
a process of their own, since a broken one may end it.
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bmask_slam.graph.extras import load_libusb
from bmask_slam.graph.files.reading import in_short

USB = Path("/sys/bus/usb/devices")
DEVICES = Path("/dev/bus/usb")
USB_2_MBIT = 480
ASK_S = 60.0
_ANSWER = "bmask-slam: "
"""Begins the line with the answer; a driver may write others, before it or as it ends."""
KNOWN = (
    ("8086", "", "RealSense", "realsense:", "realsense"),
    ("03e7", "", "", "oak:", "oak"),
    ("045e", "097c", "", "azure:", "azure"),
    ("2bc5", "", "", "opencv:0", ""),
    ("1d27", "", "", "opencv:0", ""),
    ("05ac", "", "iPhone", "record3d:", "record3d"),
    ("05ac", "", "iPad", "record3d:", "record3d"),
)
"""USB vendor and product ("": any), a word of the product's name, the source, its extra."""


@dataclass(frozen=True)
class UsbCamera:
    """A depth camera on USB.

    Attributes:
        name: what the device calls itself.
        source: of ``live``.
        extra: that ``source`` needs; "" for none.
        speed_mbit: of the connection; 480 is USB 2.
        is_allowed: whether this user may open it.
    """

    name: str
    source: str
    extra: str
    speed_mbit: int
    is_allowed: bool


@dataclass(frozen=True)
class Asked:
    """A library that was asked for cameras: those that it names, or why it could not say."""

    library: str
    source: str
    found: tuple[str, ...] = ()
    error: str = ""


def find_usb_cameras() -> tuple[UsbCamera, ...]:
    """Known depth cameras on USB, from Linux's /sys; none elsewhere."""
    found = []
    for folder in sorted(USB.iterdir()) if USB.is_dir() else ():
        vendor, product, name = (_line(folder / n) for n in ("idVendor", "idProduct", "product"))
        for known_vendor, known_product, word, source, extra in KNOWN:
            if vendor == known_vendor and product.startswith(known_product) and word in name:
                speed, path = _line(folder / "speed"), _device(folder)
                number = int(float(speed)) if speed.replace(".", "").isdecimal() else 0
                allowed = os.access(path, os.R_OK | os.W_OK)
                found.append(UsbCamera(name or vendor, source, extra, number, allowed))
                break
    return tuple(found)


def _line(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""


def _device(folder: Path) -> Path:
    bus, number = (_line(folder / name) for name in ("busnum", "devnum"))
    return DEVICES / bus.zfill(3) / number.zfill(3)


def ask_libraries(libraries: list[str]) -> tuple[Asked, ...]:
    """What each of the installed camera libraries finds, each in a process of its own."""
    return tuple(_ask_apart(name) for name in FINDERS if name in libraries)


def _ask_apart(library: str) -> Asked:
    source = FINDERS[library][0]
    try:
        done = subprocess.run(  # nosec B603 # this module, a name of our own table
            [sys.executable, "-P", "-m", "bmask_slam.doctor.cameras", library],
            capture_output=True, encoding="utf-8", errors="replace", timeout=ASK_S, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return Asked(library, source, error=f"does not answer within {ASK_S:g} s")
    told = [line for line in done.stdout.splitlines() if line.startswith(_ANSWER)]
    if not told:
        return Asked(library, source, error=f"its driver ends with status {done.returncode}")
    answer = json.loads(told[-1].removeprefix(_ANSWER))
    return Asked(library, source, tuple(answer["found"]), answer["error"])


def ask(library: str) -> Asked:
    """What a library finds, in this process."""
    source, find = FINDERS[library]
    load_libusb()
    try:
        return Asked(library, source, tuple(find(importlib.import_module(library))))
    except (ImportError, OSError, RuntimeError, AttributeError, TypeError) as error:
        return Asked(library, source, error=in_short(error))


def _realsense(rs: Any) -> list[str]:
    info = rs.camera_info
    return [
        f"{d.get_info(info.name)}, serial number {d.get_info(info.serial_number)}, "
        f"USB {d.get_info(info.usb_type_descriptor)}"
        for d in rs.context().query_devices()
    ]


def _oak(dai: Any) -> list[str]:
    found = dai.Device.getAllAvailableDevices()
    return [f"{getattr(d, 'name', '') or 'OAK'}, {_id_of(d)}" for d in found]


def _id_of(device: Any) -> str:
    """depthai 3 has an attribute, depthai 2 a method."""
    if hasattr(device, "deviceId"):
        return str(device.deviceId)
    return str(device.getMxId())


def _azure(pyk4a: Any) -> list[str]:
    return [f"device {k}" for k in range(pyk4a.connected_device_count())]


def _record3d(record3d: Any) -> list[str]:
    devices = record3d.Record3DStream.get_connected_devices()
    return [f"device {d.product_id}, {d.udid}" for d in devices]


def _openni(cv2: Any) -> list[str]:
    backends = cv2.videoio_registry.getCameraBackends()
    if cv2.CAP_OPENNI2 not in backends:
        raise RuntimeError("this OpenCV is built without OpenNI 2, as pip's is")
    found = []
    for number in range(4):
        capture = cv2.VideoCapture(number, cv2.CAP_OPENNI2)
        found += [f"device {number}"] if capture.isOpened() else []
        capture.release()
    return found


FINDERS: dict[str, tuple[str, Callable[[Any], list[str]]]] = {
    "pyrealsense2": ("realsense:", _realsense),
    "depthai": ("oak:", _oak),
    "pyk4a": ("azure:", _azure),
    "record3d": ("record3d:", _record3d),
    "cv2": ("opencv:", _openni),
}
"""The source of ``live`` and how cameras are found, by the library's module."""


def main(library: str) -> None:
    """Write what a library finds to stdout, as JSON in one line that begins with _ANSWER."""
    told = ask(library)
    answer = json.dumps({"found": told.found, "error": told.error})
    sys.stdout.write(f"\n{_ANSWER}{answer}\n")


if __name__ == "__main__":
    main(sys.argv[1])
