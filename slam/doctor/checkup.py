"""All that ``bmask-slam doctor`` finds, what is wrong with it, and how it reads."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bmask_slam import __version__
from bmask_slam.doctor.cameras import USB_2_MBIT, Asked, UsbCamera, ask_libraries, find_usb_cameras
from bmask_slam.doctor.machine import Machine, Torch, find_machine, find_torch
from bmask_slam.doctor.packages import CORE, Extra, find_extras, import_name

if TYPE_CHECKING:
    from bmask_slam.doctor.speed import Speed

NETWORK = "semantics"
SLOW_USB = "on USB 2, where 640x480 at 30 Hz is too much for it; use a blue socket (USB 3)"
NO_RIGHT = "this user may not open it; install the udev rules of its maker, and plug it in again"


@dataclass(frozen=True)
class Checkup:
    """What was found; ``speed`` and ``torch`` are None where they were not asked for or not there.

    Attributes:
        problems: what keeps this program, or what was installed of it, from working.
        hints: what is worth knowing, and no fault.
    """

    version: str
    extras: tuple[Extra, ...]
    torch: Torch | None
    machine: Machine
    usb: tuple[UsbCamera, ...]
    asked: tuple[Asked, ...]
    speed: Speed | None
    problems: tuple[str, ...]
    hints: tuple[str, ...]


def check(with_speed: bool = True) -> Checkup:
    """Look at everything; some seconds, most of them for loading the libraries."""
    extras, machine, usb = find_extras(), find_machine(), find_usb_cameras()
    working = {p.name for extra in extras for p in extra.packages if p.works}
    networks = all(p.works for extra in extras if extra.name == NETWORK for p in extra.packages)
    core_works = all(p.works for extra in extras if extra.name == CORE for p in extra.packages)
    torch = find_torch() if "torch" in working else None
    asked = ask_libraries([import_name(name) for name in working])
    return Checkup(
        __version__, extras, torch, machine, usb, asked,
        _measured(networks) if with_speed and core_works else None,
        (*_faults(extras), *machine.problems()),
        (*_hints(extras, torch, usb), *_busy(machine)),
    )  # fmt: skip


def _busy(machine: Machine) -> list[str]:
    cores = int(machine.hardware["cores"])
    if machine.load is None or machine.load < cores:
        return []
    return [f"{machine.load:.0f} programs share {cores} cores: the speed is what they leave"]


def _measured(networks: bool) -> Speed:
    """The speed; all else works without the libraries of the core, which may be broken."""
    from bmask_slam.doctor.speed import measure_speed  # noqa: PLC0415 - loads them

    return measure_speed(networks)


def _faults(extras: tuple[Extra, ...]) -> list[str]:
    found = []
    for extra in extras:
        if extra.name == CORE and extra.missing:
            found.append(f"the core lacks {', '.join(extra.missing)}; {extra.install}")
        for package in extra.broken:
            cure = f"pip install --force-reinstall {package.name}"
            found.append(f"{package.name} cannot be loaded ({package.error}); {cure}")
    return list(dict.fromkeys(found))


def _hints(extras: tuple[Extra, ...], torch: Torch | None, usb: tuple[UsbCamera, ...]) -> list[str]:
    found = []
    if torch is not None and torch.built_for != "CPU" and not torch.gpus:
        text = f"torch is built for CUDA {torch.built_for} and sees no GPU"
        found.append(f"{text}; torch for the CPU is 2 GB smaller (docs/install.md)")
    missing = {extra.name: extra for extra in extras if extra.missing}
    for camera in usb:
        if camera.extra in missing:
            cure = missing[camera.extra].install
            found.append(f"{camera.name} is plugged in; {cure} for live {camera.source}")
        if 0 < camera.speed_mbit <= USB_2_MBIT:
            found.append(f"{camera.name}: {SLOW_USB}")
        if not camera.is_allowed:
            found.append(f"{camera.name}: {NO_RIGHT}")
    return found


def format_checkup(found: Checkup) -> str:
    """The whole of it as text, problems last."""
    parts = [
        _machine_lines(found),
        _extra_lines(found.extras),
        _camera_lines(found),
        _speed_lines(found.speed),
        ["", *(f"note     {text}" for text in found.hints)] if found.hints else [],
        ["", *(f"PROBLEM  {text}" for text in found.problems)],
        [] if found.problems else ["nothing is wrong"],
    ]
    return "\n".join(line for part in parts for line in part)


def _machine_lines(found: Checkup) -> list[str]:
    machine, torch = found.machine, found.torch
    hardware, prefix = machine.hardware, sys.prefix
    lines = [
        f"bmask-slam {found.version}, Python {hardware['Python']} in {prefix}",
        f"{hardware['processor']}, {hardware['cores']} cores, {hardware['system']}",
    ]
    memory = [f"{machine.memory_gb:.1f} GB free"] if machine.memory_gb is not None else []
    memory += [f"{hardware['memory']} in all"] if "memory" in hardware else []
    memory += [f"limited to {machine.address_gb:.1f} GB"] if machine.address_gb is not None else []
    lines.append(f"memory   {', '.join(memory) or 'unknown'}")
    lines += [f"disk     {free:.0f} GB free in {path}" for path, free in machine.disk_gb.items()]
    shm = f", {machine.shm_gb:.1f} GB free in /dev/shm" if machine.shm_gb is not None else ""
    lines.append(f"limits   {machine.open_files or 'unknown'} open files{shm}")
    if torch is not None:
        gpus = ", ".join(torch.gpus) or "no GPU; everything runs without one"
        lines.append(f"torch    {torch.version}, built for {torch.built_for}; {gpus}")
    return lines


def _extra_lines(extras: tuple[Extra, ...]) -> list[str]:
    lines = ["", "installed"]
    for extra in (e for e in extras if not e.missing):
        names = ", ".join(
            f"{p.name} {p.version}{' BROKEN' * bool(p.error)}" for p in extra.packages
        )
        lines.append(f"  {extra.name:<11}{names}")
    missing = [e for e in extras if e.missing]
    if missing:
        lines += ["", "not installed (download, disk)"]
    for extra in missing:
        size = f"{extra.download_gb:.2f} GB, {extra.disk_gb:.1f} GB" if extra.disk_gb else "small"
        if extra.disk_gb is None:
            size = "size not measured"
        lines.append(f"  {extra.name:<11}{extra.purpose} ({size}): {extra.install}")
    return lines


def _camera_lines(found: Checkup) -> list[str]:
    lines = ["", "cameras"]
    lines += [f"  on USB: {c.name}, for live {c.source}" for c in found.usb]
    for asked in found.asked:
        answer = "; ".join(asked.found) or asked.error or "none"
        lines.append(f"  {asked.source:<11}{asked.library} finds: {answer}")
    seen = found.usb or any(asked.found for asked in found.asked)
    return lines if seen else [*lines, "  no camera is plugged in; recordings need none"]


def _speed_lines(speed: Speed | None) -> list[str]:
    if speed is None:
        return []
    return [
        "",
        "speed, on made images of 640x480",
        f"  corners    OpenCV's ORB {speed.orb_ms:.1f} ms, its BRISK {speed.brisk_ms:.1f} ms, "
        f"this program's {speed.features_ms:.1f} ms an image",
        f"  tracking   {speed.frame_ms:.1f} ms a frame, {speed.keyframe_ms:.1f} ms a keyframe, "
        f"of which iSAM2 {speed.isam2_ms:.1f} ms",
        *(
            []
            if math.isnan(speed.network_ms)
            else [f"  network    {speed.network_ms:.0f} ms an image"]
        ),
        *(f"  {text}" for text in speed.expectations()),
    ]
