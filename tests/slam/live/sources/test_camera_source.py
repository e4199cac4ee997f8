"""Camera sources with fake devices in place of the libraries."""

from __future__ import annotations

import sys
import threading
import time
from itertools import islice
from pathlib import Path
from types import ModuleType, SimpleNamespace

import cv2
import numpy as np
import pytest

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.live.sources.cameras.camera_source import fit_distortion
from bmask_slam.live.sources.cameras.opencv_camera import OpenCvSource
from bmask_slam.live.sources.cameras.realsense_camera import RealSenseSource
from bmask_slam.live.sources.source_clock import SourceClock
from bmask_slam.sequences.cameras import write_camera

SILENCE_S = 0.3
DISCONNECTED = object()


def pixels_of(k: int, height: int = 480, width: int = 640) -> tuple[np.ndarray, np.ndarray]:
    """RGB colour, and depth in millimetres with missing values."""
    rgb = np.full((height, width, 3), (10 * k, 20, 200), np.uint8)
    stored = np.full((height, width), 1000 + k, np.uint16)
    stored[0] = 0
    return rgb, stored


# --- RealSense -----------------------------------------------------------------------------------


class Device:
    """The device of a fake pyrealsense2: framesets (colour, depth), stamps in ms."""

    def __init__(self, framesets: list, coeffs: tuple = (0, 0, 0, 0, 0), scale: float = 0.001):
        self.framesets, self.coeffs, self.scale = framesets, coeffs, scale
        self.started = self.stopped = 0
        self.requests: dict[str, tuple] = {}
        self.aligned_to: list[str] = []


def image(stamp_ms: float, data: np.ndarray, domain: str = "hardware") -> SimpleNamespace:
    return SimpleNamespace(
        get_data=lambda: data,
        get_timestamp=lambda: stamp_ms,
        get_frame_timestamp_domain=lambda: domain,
    )


def frameset(k: int, stamp_ms: float, lag_ms: float = 0.0) -> tuple:
    rgb, stored = pixels_of(k)
    return image(stamp_ms, rgb), image(stamp_ms + lag_ms, stored)


def plug_in(monkeypatch: pytest.MonkeyPatch, device: Device | None) -> None:
    """Install a fake module pyrealsense2 with this device."""
    rs = ModuleType("pyrealsense2")
    rs.stream = SimpleNamespace(color="color", depth="depth")
    rs.format = SimpleNamespace(rgb8="rgb8", z16="z16")
    intrinsics = SimpleNamespace(
        width=640, height=480, fx=610.0, fy=611.0, ppx=321.5, ppy=238.25,
        coeffs=list(device.coeffs) if device else [], model="inverse_brown_conrady",
    )  # fmt: skip

    class Pipeline:
        def start(self, config):
            if device is None:
                raise RuntimeError("No device connected")
            device.started += 1
            device.requests = config.streams
            sensor = SimpleNamespace(get_depth_scale=lambda: device.scale)
            video = SimpleNamespace(get_intrinsics=lambda: intrinsics)
            stream = SimpleNamespace(as_video_stream_profile=lambda: video)
            return SimpleNamespace(
                get_device=lambda: SimpleNamespace(first_depth_sensor=lambda: sensor),
                get_stream=lambda kind: stream if kind == "color" else None,
            )

        def try_wait_for_frames(self, timeout_ms):
            if device.framesets and device.framesets[0] is not DISCONNECTED:
                return True, device.framesets.pop(0)
            time.sleep(timeout_ms / 1000)
            return False, None

        def stop(self):
            device.stopped += 1

    class Config:
        def __init__(self):
            self.streams = {}

        def enable_stream(self, stream, *rest):
            self.streams[stream] = rest

    class Align:
        def __init__(self, to):
            device and device.aligned_to.append(to)

        def process(self, images):
            colour, depth = images
            return SimpleNamespace(get_color_frame=lambda: colour, get_depth_frame=lambda: depth)

    def deproject(i, pixel, depth):
        """Inverse Brown-Conrady: the polynomial gives the undistorted ray."""
        x, y = (pixel[0] - i.ppx) / i.fx, (pixel[1] - i.ppy) / i.fy
        k1, k2, p1, p2, k3 = i.coeffs
        r2 = x * x + y * y
        f = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        u = x * f + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        v = y * f + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
        return [depth * u, depth * v, depth]

    rs.pipeline, rs.config, rs.align = Pipeline, Config, Align
    rs.rs2_deproject_pixel_to_point = deproject
    monkeypatch.setitem(sys.modules, "pyrealsense2", rs)


def test_realsense_frames_and_camera(monkeypatch) -> None:
    device = Device([frameset(k, 1000 + 33 * k) for k in range(3)], scale=0.00025)
    plug_in(monkeypatch, device)
    source = RealSenseSource(silence_s=SILENCE_S)
    assert device.requests == {"color": (640, 480, "rgb8", 30), "depth": (640, 480, "z16", 30)}
    assert device.aligned_to == ["color"]
    assert source.camera == Camera(640, 480, 610.0, 611.0, 321.5, 238.25, depth_scale=4000.0)
    with pytest.raises(InputError, match=r"no frame for 0\.3 s; is the camera still plugged in"):
        list(source.frames())
    assert device.stopped == 1


def test_realsense_gives_metres_seconds_and_red_first(monkeypatch) -> None:
    device = Device([frameset(k, 1000 + 33 * k) for k in range(3)])
    plug_in(monkeypatch, device)
    stream = RealSenseSource(silence_s=SILENCE_S).frames()
    frames = [next(stream) for _ in range(3)]
    assert [frame.timestamp_s for frame in frames] == pytest.approx([1.0, 1.033, 1.066])
    assert [frame.rgb[5, 5].tolist() for frame in frames] == [[10 * k, 20, 200] for k in range(3)]
    assert [float(frame.depth_m[5, 5]) for frame in frames] == pytest.approx([1.0, 1.001, 1.002])
    assert np.isnan(frames[0].depth_m[0]).all()
    stream.close()
    assert device.stopped == 1


def test_realsense_counts_incomplete_framesets(monkeypatch) -> None:
    """Framesets without depth, with old depth, repeated, and after the clock was set back."""
    sets = [frameset(0, 10_000), (frameset(1, 10_033)[0], None), frameset(2, 10_066, lag_ms=-33)]
    sets += [frameset(3, 10_100), frameset(3, 10_100), frameset(4, 50.0)]
    plug_in(monkeypatch, Device(sets))
    source = RealSenseSource(silence_s=SILENCE_S)
    stream = source.frames()
    frames = [next(stream) for _ in range(3)]
    assert [int(frame.rgb[0, 0, 0]) for frame in frames] == [0, 30, 40]
    assert np.all(np.diff([frame.timestamp_s for frame in frames]) > 0)
    assert [frame.index for frame in frames] == [0, 1, 2]
    counts = source.counts
    assert (counts.unpaired_rgb, counts.unpaired_depth) == (2, 1)
    assert (counts.duplicates, counts.clock_jumps) == (1, 1)


@pytest.mark.parametrize("wrong_s", [0.0, 3600.0, 106.2, 98.0])
def test_one_wrong_stamp_leaves_the_time_of_later_frames(monkeypatch, wrong_s: float) -> None:
    stamps_s = [100 + k / 30 for k in range(20)]
    given_s = [*stamps_s[:10], wrong_s, *stamps_s[11:]]
    plug_in(monkeypatch, Device([frameset(k, 1000 * s) for k, s in enumerate(given_s)]))
    stream, clock = RealSenseSource(silence_s=SILENCE_S).frames(), SourceClock()
    found_s = []
    for frame in islice(stream, 19):
        found_s.append(clock.checked(frame.timestamp_s))
        clock.used(found_s[-1])
    assert found_s == pytest.approx([*stamps_s[:10], *stamps_s[11:]])


def test_the_last_image_of_a_recording_comes_also_after_a_pause(monkeypatch) -> None:
    plug_in(monkeypatch, Device([frameset(k, 1000 * s) for k, s in enumerate((1.0, 1.03, 5.0))]))
    source = RealSenseSource(silence_s=SILENCE_S)
    capture = source._capture_images
    monkeypatch.setattr(source, "_capture_images", lambda: capture() or source.close())
    assert [frame.timestamp_s for frame in source.frames()] == [1.0, 1.03, 5.0]


def test_a_missing_realsense_is_refused(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(InputError, match=r"needs pyrealsense2.*bmask-slam\[realsense\]"):
        RealSenseSource()
    plug_in(monkeypatch, None)
    with pytest.raises(InputError, match="No device connected"):
        RealSenseSource()
    device = Device([])
    plug_in(monkeypatch, device)
    write_camera(tmp_path / "camera.yaml", Camera(640, 480, 600, 600, 320, 240))
    with pytest.raises(InputError, match="write depth_scale: 1000"):
        RealSenseSource(tmp_path / "camera.yaml")
    assert device.stopped == 1


def test_the_devices_distortion_is_converted_to_opencvs(monkeypatch) -> None:
    """OpenCV's undistortion of a pixel must give the ray that the device gives."""
    coeffs = (-0.05, 0.06, 0.001, -0.0015, -0.02)
    plug_in(monkeypatch, Device([], coeffs))
    camera = RealSenseSource().camera
    assert np.abs(np.subtract(camera.distortion, coeffs)).min() > 1e-5  # it is the inverse model
    intrinsics = SimpleNamespace(fx=610.0, fy=611.0, ppx=321.5, ppy=238.25, coeffs=coeffs)
    pixels = np.array([[20.0, 15.0], [320.0, 240.0], [600.0, 100.0], [130.0, 460.0]])
    deproject = sys.modules["pyrealsense2"].rs2_deproject_pixel_to_point
    rays = np.array([deproject(intrinsics, pixel, 1.0)[:2] for pixel in pixels])
    found = cv2.undistortPoints(pixels, camera.K, np.array(camera.distortion))[:, 0]
    assert np.abs(found - rays).max() * camera.fx < 0.1


@pytest.mark.parametrize("seed", range(3))
def test_the_fit_finds_opencvs_own_distortion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    plain = Camera(640, 480, 525.0, 520.0, 318.0, 242.0)
    truth = rng.normal(0, [0.1, 0.05, 0.002, 0.002, 0.02])
    rays: Array = rng.uniform([-0.6, -0.45], [0.6, 0.45], (200, 2))
    points = np.column_stack([rays, np.ones(200)])
    pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), plain.K, truth)[0][:, 0]
    found = fit_distortion(plain, pixels, rays)
    assert np.allclose(found.distortion, truth, atol=1e-9)
    assert found.K.tolist() == plain.K.tolist()
    angles = np.arctan(np.hypot(*rays.T))[:, None]
    fisheye = 525 * angles * rays / np.hypot(*rays.T)[:, None] * 1.3 + [318, 242]
    with pytest.raises(InputError, match=r"differs from OpenCV's by .* px.*--camera"):
        fit_distortion(plain, fisheye + rng.normal(0, 2, fisheye.shape), rays)


# --- OpenCV --------------------------------------------------------------------------------------


class Capture:
    """A fake cv2.VideoCapture on an OpenNI 2 device."""

    made: Capture

    def __init__(self, device: int, backend: int) -> None:
        assert backend == cv2.CAP_OPENNI2
        self.device, self.registers, self.released = device, 0, False
        self.current = -1
        self.missing: set[tuple[int, int]] = set()
        Capture.made = self

    def isOpened(self) -> bool:
        return self.device < 5

    def set(self, what: int, value: float) -> bool:
        if what == cv2.CAP_OPENNI_DEPTH_GENERATOR_REGISTRATION and self.device != 4:
            self.registers = value
        return True

    def get(self, what: int) -> float:
        return self.registers if what == cv2.CAP_OPENNI_DEPTH_GENERATOR_REGISTRATION else 0

    def grab(self) -> bool:
        self.current += 1
        return self.current < 4

    def retrieve(self, _: None, flag: int) -> tuple[bool, np.ndarray | None]:
        rgb, stored = pixels_of(self.current, 24, 32)
        if (self.current, flag) in self.missing:
            return False, None
        return True, stored if flag == cv2.CAP_OPENNI_DEPTH_MAP else rgb[..., ::-1].copy()

    def release(self) -> None:
        self.released = True


@pytest.fixture
def camera_file(tmp_path: Path, monkeypatch) -> Path:
    monkeypatch.setattr(cv2, "VideoCapture", Capture)
    path = tmp_path / "camera.yaml"
    write_camera(path, Camera(32, 24, 30, 31, 15, 12, depth_scale=1000))
    return path


def test_opencv_gives_metres_and_red_first_until_it_is_disconnected(camera_file: Path) -> None:
    source = OpenCvSource(2, camera_file, SILENCE_S)
    assert source.name == "opencv-2"
    Capture.made.missing = {(1, cv2.CAP_OPENNI_DEPTH_MAP)}
    frames, begin_s = [], time.time()
    with pytest.raises(InputError, match="opencv-2: no frame for"):
        for frame in source.frames():
            frames.append(frame)
    assert [frame.rgb[1, 1].tolist() for frame in frames] == [[10 * k, 20, 200] for k in (0, 2, 3)]
    assert [float(f.depth_m[1, 1]) for f in frames] == pytest.approx([1.0, 1.002, 1.003])
    assert all(begin_s <= frame.timestamp_s <= time.time() for frame in frames)
    assert (source.counts.unpaired_rgb, source.counts.unpaired_depth) == (1, 0)
    assert Capture.made.released


def test_opencv_refuses_devices_that_it_cannot_use(camera_file: Path) -> None:
    with pytest.raises(InputError, match="does not know the intrinsics; give --camera"):
        OpenCvSource(0, None)
    with pytest.raises(InputError, match="opencv-5: cannot be opened"):
        OpenCvSource(5, camera_file)
    assert Capture.made.released
    with pytest.raises(InputError, match="does not register depth"):
        OpenCvSource(4, camera_file)
    write_camera(camera_file, Camera(640, 480, 30, 31, 15, 12, depth_scale=1000))
    with pytest.raises(InputError, match="colour has 32x24 pixels"):
        next(OpenCvSource(0, camera_file).frames())


def test_close_ends_it_and_releases_the_device(camera_file: Path) -> None:
    source = OpenCvSource(0, camera_file, silence_s=60)
    threading.Timer(0.1, source.close).start()
    assert len(list(source.frames())) == 4
    assert Capture.made.released


def test_close_releases_a_device_whose_frames_never_began(monkeypatch) -> None:
    device = Device([frameset(0, 1000)])
    plug_in(monkeypatch, device)
    source = RealSenseSource(silence_s=SILENCE_S)
    stream = source.frames()
    source.close()
    assert device.stopped == 1
    assert list(stream) == []
    source.close()
    assert device.stopped == 1


def test_close_leaves_the_device_to_the_frames_that_have_begun(monkeypatch) -> None:
    device = Device([frameset(0, 1000)])
    plug_in(monkeypatch, device)
    source = RealSenseSource(silence_s=SILENCE_S)
    stream = source.frames()
    next(stream)
    source.close()
    assert device.stopped == 0
    assert list(stream) == []
    source.close()
    assert device.stopped == 1
