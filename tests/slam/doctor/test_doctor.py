"""What ``bmask-slam doctor`` says, with made libraries, devices and machines."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from repository import ROOT

from bmask_slam.cli import main
from bmask_slam.doctor import cameras, checkup, machine, packages
from bmask_slam.doctor.cameras import Asked, UsbCamera
from bmask_slam.doctor.machine import Machine, Torch
from bmask_slam.doctor.packages import Extra, Package
from bmask_slam.doctor.speed import Speed

SPEED = Speed(5.0, 30.0, 6.0, 12.0, 35.0, 10.0, 58.0)
HARDWARE = {"processor": "P", "cores": "2", "system": "Linux", "Python": "3.11", "memory": "8 GB"}
MACHINE = Machine(HARDWARE, 6.0, {"/home": 50.0}, 4096, None, 4.0)


def extra(name: str, *libraries: Package) -> Extra:
    return Extra(
        name, f"what {name} does", libraries, f"pip install 'bmask-slam[{name}]'", 0.1, 0.2
    )


CORE = Extra("core", "run", (Package("numpy", "2.0"),), "pip install 'bmask-slam'", 0.19, 0.63)
VIEW = extra("view", Package("rerun-sdk", ""))
SEMANTICS = extra("semantics", Package("torch", "2.6"), Package("safetensors", "0.5"))


def plug_in(monkeypatch: pytest.MonkeyPatch, *extras: Extra, usb: tuple = ()) -> None:
    """A made machine with these extras and cameras."""
    monkeypatch.setattr(checkup, "find_extras", lambda: extras)
    monkeypatch.setattr(checkup, "find_machine", lambda: MACHINE)
    monkeypatch.setattr(checkup, "find_torch", lambda: Torch("2.6", "12.4", ()))
    monkeypatch.setattr(checkup, "find_usb_cameras", lambda: usb)
    monkeypatch.setattr(checkup, "ask_libraries", lambda names: (Asked("cv2", "opencv:"),))
    monkeypatch.setattr(
        checkup,
        "_measured",
        lambda network: SPEED if network else replace(SPEED, network_ms=np.nan),
    )


def test_nothing_is_wrong(monkeypatch, capsys) -> None:
    plug_in(monkeypatch, CORE, SEMANTICS, VIEW)
    assert main(["doctor"]) == 0
    text = capsys.readouterr().out
    for part in (
        "view       what view does (0.10 GB, 0.2 GB): pip install 'bmask-slam[view]'",
        "semantics  torch 2.6, safetensors 0.5",
        "50 GB free in /home",
        "4096 open files, 4.0 GB free in /dev/shm",
        "cv2 finds: none",
        "no camera is plugged in",
        "iSAM2 10.0 ms",
        "a camera at 30 Hz is tracked frame by frame",
        "17.2 images a second, enough",
        "built for CUDA 12.4 and sees no GPU",
        "nothing is wrong",
    ):
        assert part in text


def test_a_broken_core_is_status_1_with_the_command(monkeypatch, capsys) -> None:
    plug_in(monkeypatch, replace(CORE, packages=(Package("gtsam", ""), Package("numpy", "2.0"))))
    assert main(["doctor", "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert told["problems"] == ["the core lacks gtsam; pip install 'bmask-slam'"]
    assert told["speed"] is None
    assert told["expectations"] == []


def test_an_installed_library_that_cannot_be_loaded_is_a_problem(monkeypatch, capsys) -> None:
    broken = extra("view", Package("rerun-sdk", "0.30", "ImportError: libGL.so.1"))
    plug_in(monkeypatch, CORE, broken)
    assert main(["doctor", "--quick"]) == 1
    text = capsys.readouterr().out
    assert "rerun-sdk cannot be loaded (ImportError: libGL.so.1); pip install --force" in text
    assert "speed, on made" not in text


def test_a_camera_on_usb_gets_its_extra_its_socket_and_its_rights(monkeypatch, capsys) -> None:
    camera = UsbCamera("Intel RealSense D435", "realsense:", "realsense", 480, False)
    realsense = extra("realsense", Package("pyrealsense2", ""))
    plug_in(monkeypatch, CORE, realsense, usb=(camera,))
    assert main(["doctor", "--quick"]) == 0
    text = capsys.readouterr().out
    assert "D435 is plugged in; pip install 'bmask-slam[realsense]' for live realsense:" in text
    assert "on USB 2" in text
    assert "udev rules" in text
    assert "no camera is plugged in" not in text


@pytest.mark.parametrize(
    ("speed", "words"),
    [
        (replace(SPEED, frame_ms=50.0), "about 11 frames a second: set the camera to 15 Hz"),
        (replace(SPEED, network_ms=900.0), "the network falls behind"),
        (replace(SPEED, network_ms=np.nan), "labels: not measured"),
        (SPEED, "about 1.0 minutes"),
    ],
)
def test_expectations(speed: Speed, words: str) -> None:
    assert any(words in text for text in speed.expectations())


def test_it_needs_none_of_the_libraries_that_it_looks_for() -> None:
    blocked = ("numpy", "gtsam", "cv2", "scipy", "faiss", "matplotlib", "pydantic", "torch", "tqdm")
    code = (
        f"import sys; sys.modules.update(dict.fromkeys({blocked!r}))\n"
        "import bmask_slam.doctor.checkup as c\n"
        "from bmask_slam.cli import main\n"
        "c.find_extras, c.find_torch = lambda: (), lambda: None\n"
        "sys.exit(main(['doctor', '--quick']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "nothing is wrong" in done.stdout


# --- packages ------------------------------------------------------------------------------------


def test_every_extra_of_the_project_has_its_purpose() -> None:
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = set(project["optional-dependencies"]) - set(packages.APART)
    assert extras <= set(packages.PURPOSES)


def test_the_extras_are_those_of_the_metadata() -> None:
    needed = packages.needed_packages(
        ["gtsam<5,>=4.3", "torch<3,>=2.6; extra == \"dense\"", "ruamel.yaml>=0.18",
         "bmask-slam[dense]; extra == \"all\"", "pytest>=8; extra == 'dev'"]
    )  # fmt: skip
    assert needed == {"core": ["gtsam", "ruamel.yaml"], "dense": ["torch"]}
    found = packages.find_extras(lambda names: dict.fromkeys(names, ""))
    by_name = {e.name: e for e in found}
    assert "gtsam" in [p.name for p in by_name["core"].packages]
    assert not by_name["core"].missing
    assert by_name["view"].install == "pip install 'bmask-slam[view]'"


def test_libraries_are_loaded_apart_and_one_that_ends_python_spares_the_others(
    tmp_path: Path, monkeypatch
) -> None:
    (tmp_path / "crashing.py").write_text("import os, signal; os.kill(os.getpid(), signal.SIGILL)")
    (tmp_path / "raising.py").write_text("raise ImportError('libx.so is not there')")
    (tmp_path / "good.py").write_text("print('words')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    errors = packages.load_apart(["raising", "crashing", "good"])
    assert errors == {
        "raising": "ImportError: libx.so is not there",
        "crashing": "ends Python with SIGILL: it is built for another processor",
        "good": "",
    }


def test_what_a_library_writes_as_it_is_loaded_spoils_no_answer(
    tmp_path: Path, monkeypatch
) -> None:
    (tmp_path / "unfinished.py").write_text("import sys; sys.stdout.write('loading ... ')")
    (tmp_path / "pyk4a.py").write_text(
        "import os; os.write(1, b'caf\\xe9\\n')\ndef connected_device_count(): return 1"
    )
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    assert packages.load_apart(["unfinished", "pyk4a"]) == {"unfinished": "", "pyk4a": ""}
    assert cameras.ask_libraries(["pyk4a"]) == (Asked("pyk4a", "azure:", ("device 0",)),)


# --- machine -------------------------------------------------------------------------------------


def test_a_containers_limit_counts(tmp_path: Path, monkeypatch) -> None:
    meminfo = tmp_path / "meminfo"
    meminfo.write_text("MemTotal: 9000000 kB\nMemAvailable:    8000000 kB\n")
    monkeypatch.setattr(machine, "MEMINFO", meminfo)
    monkeypatch.setattr(machine, "CGROUP", tmp_path)
    assert machine.free_memory_gb() == pytest.approx(8.192)
    (tmp_path / "memory.max").write_text("3000000000\n")
    (tmp_path / "memory.current").write_text("1000000000\n")
    assert machine.free_memory_gb() == pytest.approx(2.0)
    (tmp_path / "memory.max").write_text("max\n")
    assert machine.free_memory_gb() == pytest.approx(8.192)


def test_files_that_a_container_has_read_are_not_used_memory(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(machine, "MEMINFO", tmp_path / "meminfo")
    monkeypatch.setattr(machine, "CGROUP", tmp_path)
    (tmp_path / "memory.max").write_text("8000000000\n")
    (tmp_path / "memory.current").write_text("7500000000\n")
    (tmp_path / "memory.stat").write_text("anon 1000000000\ninactive_file 6000000000\n")
    assert machine.free_memory_gb() == pytest.approx(6.5)


def test_too_little_of_something_is_a_problem() -> None:
    poor = replace(MACHINE, memory_gb=0.5, disk_gb={"/var/tmp": 0.2}, open_files=256)
    assert [text.split(";")[0] for text in poor.problems()] == [
        "0.5 GB of memory are free",
        "/var/tmp: 0.2 GB are free",
        "a process may open 256 files",
    ]
    assert MACHINE.problems() == []


def test_a_busy_machine_is_said() -> None:
    (text,) = checkup._busy(replace(MACHINE, load=7.8))
    assert text.startswith("8 programs share 2 cores")
    assert checkup._busy(replace(MACHINE, load=0.5)) == []


def test_this_machine_is_looked_at() -> None:
    found = machine.find_machine()
    assert found.hardware["cores"].isdecimal()
    assert all(free > 0 for free in found.disk_gb.values())


def test_folders_that_are_not_there_are_left_out(tmp_path: Path, monkeypatch) -> None:
    (gone := tmp_path / "gone").mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    monkeypatch.setattr(machine.tempfile, "tempdir", None)  # what it has found before
    monkeypatch.setenv("TMPDIR", str(tmp_path / "none"))
    free = machine.find_machine().disk_gb
    assert len(free) == 1 and all(Path(folder).is_dir() for folder in free)


# --- cameras -------------------------------------------------------------------------------------


def test_cameras_on_usb(tmp_path: Path, monkeypatch) -> None:
    def device(name: str, **lines: str) -> None:
        (tmp_path / name).mkdir()
        for key, text in lines.items():
            (tmp_path / name / key).write_text(f"{text}\n")

    device("2-1", idVendor="8086", idProduct="0b07", product="Intel(R) RealSense(TM) 435",
           speed="5000", busnum="2", devnum="4")  # fmt: skip
    device("1-1", idVendor="8086", idProduct="0033", product="Bluetooth")
    device("1-2", idVendor="03e7", idProduct="2485", product="Movidius MyriadX", speed="480")
    device("usb1")
    monkeypatch.setattr(cameras, "USB", tmp_path)
    monkeypatch.setattr(cameras, "DEVICES", tmp_path / "dev")
    (tmp_path / "dev" / "002").mkdir(parents=True)
    (tmp_path / "dev" / "002" / "004").touch()
    assert cameras.find_usb_cameras() == (
        UsbCamera("Movidius MyriadX", "oak:", "oak", 480, False),
        UsbCamera("Intel(R) RealSense(TM) 435", "realsense:", "realsense", 5000, True),
    )


def fake_libraries() -> dict[str, SimpleNamespace]:
    info = SimpleNamespace(name="n", serial_number="s", usb_type_descriptor="u")
    device = SimpleNamespace(get_info={"n": "D455", "s": "123", "u": "3.2"}.__getitem__)
    oak = SimpleNamespace(name="1.2", deviceId="ABC")
    phone = SimpleNamespace(product_id=4776, udid="U")
    return {
        "pyrealsense2": SimpleNamespace(
            camera_info=info, context=lambda: SimpleNamespace(query_devices=lambda: [device])
        ),
        "depthai": SimpleNamespace(Device=SimpleNamespace(getAllAvailableDevices=lambda: [oak])),
        "pyk4a": SimpleNamespace(connected_device_count=lambda: 2),
        "record3d": SimpleNamespace(
            Record3DStream=SimpleNamespace(get_connected_devices=lambda: [phone])
        ),
    }


def test_every_library_is_asked(monkeypatch) -> None:
    for name, library in fake_libraries().items():
        module = ModuleType(name)
        module.__dict__.update(vars(library))
        monkeypatch.setitem(sys.modules, name, module)
    found = {name: cameras.ask(name).found for name in fake_libraries()}
    assert found == {
        "pyrealsense2": ("D455, serial number 123, USB 3.2",),
        "depthai": ("1.2, ABC",),
        "pyk4a": ("device 0", "device 1"),
        "record3d": ("device 4776, U",),
    }
    assert "without OpenNI 2" in cameras.ask("cv2").error


def test_a_driver_that_ends_the_process_is_an_answer(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "pyk4a.py").write_text("import os; os._exit(3)")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert cameras.ask_libraries(["pyk4a", "numpy"]) == (
        Asked("pyk4a", "azure:", error="its driver ends with status 3"),
    )


@pytest.mark.parametrize("last_words", ["3", "good-bye"])
def test_what_a_driver_writes_as_it_ends_is_not_the_answer(
    tmp_path: Path, monkeypatch, last_words: str
) -> None:
    driver = "def connected_device_count(): return 1\n"
    ending = f"import atexit\natexit.register(print, {last_words!r})\n"
    (tmp_path / "pyk4a.py").write_text(driver + ending)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    assert cameras.ask_libraries(["pyk4a"]) == (Asked("pyk4a", "azure:", ("device 0",)),)
