"""OAK, Azure Kinect and Record3D with fakes of their libraries' interfaces; no device was there."""

from __future__ import annotations

import sys
import threading
import time
from datetime import timedelta
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.live.sources.cameras import oak_camera, record3d_camera
from bmask_slam.live.sources.cameras.azure_camera import AzureSource
from bmask_slam.live.sources.cameras.oak_camera import OakSource
from bmask_slam.live.sources.cameras.record3d_camera import Record3dSource
from bmask_slam.live.sources.opening import SourceOptions, open_source
from bmask_slam.sequences.cameras import write_camera

SILENCE_S = 0.3
K = np.array([[500.0, 0, 318.0], [0, 501.0, 242.0], [0, 0, 1]])
RATIONAL = np.array([0.52, -2.72, 4e-4, -2e-4, 1.58, 0.40, -2.54, 1.50])
"""k1 k2 p1 p2 k3 k4 k5 k6 as an Azure Kinect's colour camera has them, about."""


def images(width: int, height: int, k: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Colour, blue first, and depth in mm, 0 in the first row."""
    bgr = np.full((height, width, 3), (200, 20, 10 * k), np.uint8)
    stored = np.full((height, width), 1000 + k, np.uint16)
    stored[0] = 0
    return bgr, stored


# --- OAK -----------------------------------------------------------------------------------------


class FakeOak:
    """depthai 3: what is made and linked, and the groups that come."""

    def __init__(self, groups: list, platform: str = "RVC2", is_there: bool = True) -> None:
        self.links: list[tuple[str, str]] = []
        self.groups, self.stopped, self.requests = groups, 0, {}
        fake = self

        class Port:
            def __init__(self, name: str) -> None:
                self.name = name

            def link(self, other: Port) -> None:
                fake.links.append((self.name, other.name))

            def createOutputQueue(self, maxSize: int, blocking: bool) -> Any:
                return SimpleNamespace(tryGet=fake.next_group)

        class Node:
            def __init__(self, kind: str) -> None:
                self.kind, self.threshold = kind, None
                ports = "left right depth inputAlignTo input outputAligned out"
                self.__dict__ |= {name: Port(f"{kind}.{name}") for name in ports.split()}
                self.inputs = {n: Port(f"{kind}[{n}]") for n in ("colour", "depth")}

            def build(self, where: str) -> Node:
                self.kind = where
                return self

            def requestOutput(self, size: tuple, *rest: Any, **named: Any) -> Port:
                fake.requests[self.kind] = (size, *rest, *named.values())
                return Port(self.kind)

            def setRectifyEdgeFillColor(self, value: int) -> None:
                assert value == 0  # depth of the rim is missing, not made up

            def setSyncThreshold(self, value: timedelta) -> None:
                assert value == timedelta(seconds=0.02)

        class Pipeline:
            def __init__(self) -> None:
                if not is_there:
                    raise RuntimeError("No available devices")

            def create(self, kind: str) -> Node:
                return Node(kind)

            def getDefaultDevice(self) -> Any:
                return SimpleNamespace(getPlatform=lambda: platform)

            def start(self) -> None:
                """Nothing."""

            def stop(self) -> None:
                fake.stopped += 1

        names = ("Camera", "StereoDepth", "ImageAlign", "Sync")
        self.module = ModuleType("depthai")
        self.module.__dict__.update(
            Pipeline=Pipeline,
            node=SimpleNamespace(**{name: name for name in names}),
            CameraBoardSocket=SimpleNamespace(CAM_A="A", CAM_B="B", CAM_C="C"),
            ImgFrame=SimpleNamespace(Type=SimpleNamespace(RGB888i="rgb")),
            ImgResizeMode=SimpleNamespace(CROP="crop"),
            Platform=SimpleNamespace(RVC2="RVC2", RVC4="RVC4"),
        )

    def next_group(self) -> Any:
        group = self.groups.pop(0) if self.groups else None
        if group == "unplugged":
            raise RuntimeError("X_LINK_ERROR")
        return group


def oak_group(k: int) -> dict[str, Any]:
    bgr, stored = images(640, 480, k)
    colour = SimpleNamespace(
        getCvFrame=lambda: bgr,
        getTimestamp=lambda: timedelta(seconds=10 + k / 30),
        getWidth=lambda: 640,
        getHeight=lambda: 480,
        getTransformation=lambda: SimpleNamespace(getIntrinsicMatrix=K.tolist),
    )
    return {"colour": colour, "depth": SimpleNamespace(getFrame=lambda: stored)}


def test_oak_gives_metres_seconds_and_red_first(monkeypatch) -> None:
    oak = FakeOak([oak_group(k) for k in range(3)])
    monkeypatch.setitem(sys.modules, "depthai", oak.module)
    source = open_source("oak:", SourceOptions(silence_s=SILENCE_S))
    assert source.camera == Camera(640, 480, 500.0, 501.0, 318.0, 242.0, depth_scale=1000.0)
    frames = []
    with pytest.raises(InputError, match="oak: no frame for"):
        for frame in source.frames():
            frames.append(frame)
    assert [f.rgb[5, 5].tolist() for f in frames] == [[10 * k, 20, 200] for k in range(3)]
    assert [float(f.depth_m[5, 5]) for f in frames] == pytest.approx([1.0, 1.001, 1.002])
    assert np.isnan(frames[0].depth_m[0]).all()
    assert np.diff([f.timestamp_s for f in frames]) == pytest.approx(1 / 30, abs=1e-5)
    assert oak.stopped == 1
    assert oak.requests["A"] == ((640, 480), "rgb", "crop", 30, True)  # undistorted
    assert ("A", "StereoDepth.inputAlignTo") in oak.links
    assert ("StereoDepth.depth", "Sync[depth]") in oak.links


def test_an_oak_4_aligns_by_a_node_of_its_own(monkeypatch) -> None:
    oak = FakeOak([oak_group(0)], platform="RVC4")
    monkeypatch.setitem(sys.modules, "depthai", oak.module)
    OakSource()
    assert ("StereoDepth.depth", "ImageAlign.input") in oak.links
    assert ("ImageAlign.outputAligned", "Sync[depth]") in oak.links


def test_a_missing_or_silent_oak_is_refused(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "depthai", None)
    with pytest.raises(InputError, match=r"oak:: needs depthai.*bmask-slam\[oak\]"):
        OakSource()
    monkeypatch.setitem(sys.modules, "depthai", FakeOak([], is_there=False).module)
    with pytest.raises(InputError, match=r"oak: cannot start \(No available devices\)"):
        OakSource()
    silent = FakeOak([])
    monkeypatch.setitem(sys.modules, "depthai", silent.module)
    monkeypatch.setattr(oak_camera, "FIRST_S", 0.05)
    with pytest.raises(InputError, match=r"no frame within 0\.05 s; use a USB 3 cable"):
        OakSource()
    assert silent.stopped == 1


# --- Azure Kinect --------------------------------------------------------------------------------


def fake_pyk4a(captures: list, is_there: bool = True) -> tuple[ModuleType, dict[str, Any]]:
    """A fake pyk4a, and what it was asked for."""
    asked: dict[str, Any] = {"stopped": 0}

    class K4AException(Exception):  # noqa: N818 - the library's name
        """As the library has it."""

    class K4ATimeoutException(K4AException):
        """As the library has it."""

    class PyK4A:
        def __init__(self, config: dict, device_id: int) -> None:
            asked.update(config=config, device=device_id)
            self.calibration = SimpleNamespace(
                get_camera_matrix=lambda kind: np.array(
                    [[610.0, 0, 640], [0, 611, 365], [0, 0, 1]]
                ),
                get_distortion_coefficients=lambda kind: RATIONAL,
            )

        def start(self) -> None:
            if not is_there:
                raise K4AException

        def get_capture(self, timeout: int) -> Any:
            if captures:
                capture = captures.pop(0)
                if capture == "unplugged":
                    raise K4AException
                return capture
            time.sleep(timeout / 1000)
            raise K4ATimeoutException

        def stop(self) -> None:
            asked["stopped"] += 1

    module = ModuleType("pyk4a")
    module.__dict__.update(
        Config=lambda **named: named,
        PyK4A=PyK4A,
        K4AException=K4AException,
        K4ATimeoutException=K4ATimeoutException,
        ColorResolution=SimpleNamespace(RES_720P="720p"),
        ImageFormat=SimpleNamespace(COLOR_BGRA32="bgra"),
        DepthMode=SimpleNamespace(NFOV_UNBINNED="nfov"),
        FPS=SimpleNamespace(FPS_30="30"),
        CalibrationType=SimpleNamespace(COLOR="color"),
    )
    return module, asked


def azure_capture(k: int) -> SimpleNamespace:
    bgr, stored = images(1280, 720, k)
    bgra = np.dstack([bgr, np.full(bgr.shape[:2], 255, np.uint8)])
    usec = 5_000_000 + 33_333 * k
    return SimpleNamespace(color=bgra, transformed_depth=stored, color_timestamp_usec=usec)


def test_azure_gives_metres_seconds_and_red_first(monkeypatch) -> None:
    half = SimpleNamespace(color=None, transformed_depth=images(4, 4)[1], color_timestamp_usec=0)
    module, asked = fake_pyk4a([azure_capture(0), half, azure_capture(1)])
    monkeypatch.setitem(sys.modules, "pyk4a", module)
    source = open_source("azure:1", SourceOptions(silence_s=SILENCE_S))
    frames = []
    with pytest.raises(InputError, match="azure-1: no frame for"):
        for frame in source.frames():
            frames.append(frame)
    assert (asked["device"], asked["stopped"]) == (1, 1)
    assert asked["config"]["synchronized_images_only"]
    assert [f.rgb[180, 320].tolist() for f in frames] == [[0, 20, 200], [10, 20, 200]]
    assert [float(f.depth_m[180, 320]) for f in frames] == pytest.approx([1.0, 1.001])
    assert [f.timestamp_s for f in frames] == pytest.approx([5.0, 5.033333])
    assert (source.counts.unpaired_rgb, source.counts.unpaired_depth) == (0, 1)


def test_a_missing_azure_is_refused(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pyk4a", None)
    with pytest.raises(InputError, match=r"azure:: needs pyk4a.*bmask-slam\[azure\]"):
        AzureSource(0)
    monkeypatch.setitem(sys.modules, "pyk4a", fake_pyk4a([], is_there=False)[0])
    with pytest.raises(InputError, match=r"azure-2: cannot start \(K4AException\)"):
        AzureSource(2)


def test_a_camera_that_is_unplugged_is_said(monkeypatch) -> None:
    oak, (module, asked) = FakeOak([oak_group(0), "unplugged"]), fake_pyk4a(["unplugged"])
    monkeypatch.setitem(sys.modules, "depthai", oak.module)
    monkeypatch.setitem(sys.modules, "pyk4a", module)
    with pytest.raises(InputError, match=r"oak: gives no more frames \(X_LINK_ERROR\)"):
        list(OakSource().frames())
    with pytest.raises(InputError, match=r"azure-0: gives no more frames \(K4AException\)"):
        list(AzureSource(0).frames())
    assert (oak.stopped, asked["stopped"]) == (1, 1)


@pytest.mark.parametrize("is_given", [False, True], ids=["its own camera", "a run's camera.yaml"])
def test_azures_images_are_undistorted(is_given: bool, monkeypatch, tmp_path: Path) -> None:
    """A point is where the pinhole has it, in colour and in depth."""
    pinhole = Camera(1280, 720, 610.0, 611.0, 640.0, 365.0, depth_scale=1000.0)
    points = np.array([[0.0, 0, 2], [1.4, 0.6, 2], [-1.2, -0.7, 2], [-1.0, 0.8, 2]])
    none = np.zeros(3)
    seen = cv2.projectPoints(points, none, none, pinhole.K, RATIONAL)[0][:, 0]
    capture = azure_capture(0)
    for u, v in seen.round().astype(int):
        capture.color[v - 3 : v + 4, u - 3 : u + 4] = 255
        capture.transformed_depth[v - 3 : v + 4, u - 3 : u + 4] = 2000
    monkeypatch.setitem(sys.modules, "pyk4a", fake_pyk4a([capture])[0])
    path = tmp_path / "camera.yaml"
    write_camera(path, pinhole)
    source = AzureSource(0, path if is_given else None, SILENCE_S)
    frame, pixels = next(source.frames()), pinhole.project(points)
    for u, v in pixels.round().astype(int):
        assert frame.rgb[v, u].min() > 200
        assert frame.depth_m[v, u] == 2.0
    assert np.abs(seen - pixels).max() > 5  # it was not for nothing


# --- Record3D ------------------------------------------------------------------------------------


class FakePhone:
    """A phone that streams frames of 0.04 s, LiDAR or TrueDepth."""

    def __init__(self, device_type: int, frames: int = 3) -> None:
        self.device_type, self.left, self.number = device_type, frames, 0
        self.is_connected = True
        phone = self

        class Record3DStream:
            get_connected_devices = staticmethod(lambda: [SimpleNamespace(udid="U")])

            def connect(self, device: Any) -> bool:
                assert device.udid == "U"
                threading.Thread(target=self.stream, daemon=True).start()
                return True

            def stream(self) -> None:
                for k in range(phone.left):
                    phone.number = k
                    self.on_new_frame()
                    time.sleep(0.04)

            def disconnect(self) -> None:
                phone.is_connected = False

            def get_device_type(self) -> int:
                return phone.device_type

            def get_rgb_frame(self) -> np.ndarray:
                rgb = np.full((48, 64, 3), (10, 20, 200), np.uint8)
                rgb[:, :32] = (90, 20, 200)
                return rgb

            def get_depth_frame(self) -> np.ndarray:
                depth_m = np.full((12, 16), 2.0, np.float32)
                depth_m[:, :8], depth_m[0] = 1.0, 0.0
                return depth_m

            def get_intrinsic_mat(self) -> Any:
                return SimpleNamespace(fx=60.0, fy=61.0, tx=30.0, ty=24.0)

        self.module = ModuleType("record3d")
        self.module.Record3DStream = Record3DStream  # type: ignore[attr-defined]


@pytest.mark.parametrize(("device_type", "cx"), [(1, 30.0), (0, 33.0)])
def test_record3d_turns_back_what_is_mirrored(monkeypatch, device_type: int, cx: float) -> None:
    phone = FakePhone(device_type)
    monkeypatch.setitem(sys.modules, "record3d", phone.module)
    source = open_source("record3d:", SourceOptions(silence_s=SILENCE_S))
    assert source.camera == Camera(64, 48, 60.0, 61.0, cx, 24.0, depth_scale=1.0)
    frames, began_s = [], time.time()
    with pytest.raises(InputError, match="record3d-0: no frame for"):
        for frame in source.frames():
            frames.append(frame)
    assert 1 <= len(frames) <= 3
    assert all(began_s - 1 < frame.timestamp_s < time.time() for frame in frames)
    near = slice(None, 32) if device_type else slice(32, None)  # left, or mirrored back: right
    far = slice(32, None) if device_type else slice(None, 32)
    assert frames[0].depth_m.shape == (48, 64)
    assert np.nanmax(frames[0].depth_m[:, near]) == 1.0
    assert np.nanmin(frames[0].depth_m[:, far]) == 2.0  # near and far are not mixed
    assert (frames[0].rgb[:, near, 0] == 90).all()
    assert np.isnan(frames[0].depth_m[:4]).all()
    assert not phone.is_connected


def test_a_phone_that_is_not_there_or_silent_is_refused(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "record3d", None)
    with pytest.raises(InputError, match=r"record3d:: needs record3d.*bmask-slam\[record3d\]"):
        Record3dSource(0)
    silent = FakePhone(1, frames=0)
    monkeypatch.setitem(sys.modules, "record3d", silent.module)
    with pytest.raises(InputError, match="record3d-1: 1 devices are connected; plug it in"):
        Record3dSource(1)
    monkeypatch.setattr(record3d_camera, "FIRST_S", 0.05)
    with pytest.raises(InputError, match="start the streaming"):
        Record3dSource(0)
    assert not silent.is_connected
    monkeypatch.setitem(sys.modules, "record3d", FakePhone(1).module)
    write_camera(tmp_path / "camera.yaml", Camera(64, 48, 60, 60, 32, 24, depth_scale=1000))
    with pytest.raises(InputError, match="write depth_scale: 1"):
        Record3dSource(0, tmp_path / "camera.yaml")


@pytest.mark.parametrize("text", ["azure:x", "record3d:-1", "opencv:a"])
def test_what_is_no_number_of_a_device_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=f"{text}: not the number of a device"):
        open_source(text, SourceOptions())
