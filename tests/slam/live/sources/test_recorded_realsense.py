"""``realsense:`` on a recording that pyrealsense2 itself makes, of its simulated device."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.extras import load_libusb
from bmask_slam.live.sources.opening import SourceOptions, open_source

load_libusb()
rs = pytest.importorskip("pyrealsense2")
WIDTH, HEIGHT, FRAMES = 64, 48, 6


def stream(kind: Any, form: Any, size: int, number: int) -> Any:
    made = rs.video_stream()
    made.type, made.fmt, made.bpp, made.uid, made.index = kind, form, size, number, 0
    made.width, made.height, made.fps = WIDTH, HEIGHT, 30
    i = rs.intrinsics()
    i.width, i.height, i.fx, i.fy, i.ppx, i.ppy = WIDTH, HEIGHT, 60.0, 61.0, 32.0, 24.0
    i.model, i.coeffs = rs.distortion.none, [0, 0, 0, 0, 0]
    made.intrinsics = i
    return made


def picture(profile: Any, pixels: np.ndarray, number: int) -> Any:
    made = rs.software_video_frame()
    made.bpp = pixels.dtype.itemsize * (3 if pixels.ndim == 3 else 1)
    made.stride, made.pixels = WIDTH * made.bpp, pixels
    made.timestamp, made.frame_number = 1000.0 + 100 * number, number
    made.domain, made.profile = rs.timestamp_domain.hardware_clock, profile
    return made


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six frames of a simulated device, ten a second: depth 1 m and a millimetre more each."""
    path = tmp_path_factory.mktemp("realsense") / "made.db3"
    device = rs.software_device()
    depth_sensor, colour_sensor = (
        device.add_sensor("Stereo Module"),
        device.add_sensor("RGB Camera"),
    )
    depth = depth_sensor.add_video_stream(stream(rs.stream.depth, rs.format.z16, 2, 1))
    colour = colour_sensor.add_video_stream(stream(rs.stream.color, rs.format.rgb8, 3, 2))
    depth_sensor.add_read_only_option(rs.option.depth_units, 0.001)
    same = rs.extrinsics()
    same.rotation, same.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [0, 0, 0]
    depth.register_extrinsics_to(colour, same)
    recorder, queue = rs.recorder(str(path), device), rs.frame_queue(2 * FRAMES)
    sensors = recorder.query_sensors()
    for sensor in sensors:
        sensor.open(sensor.get_stream_profiles())
        sensor.start(queue)
    for k in range(FRAMES):
        stored = np.full((HEIGHT, WIDTH), 1000 + k, np.uint16)
        stored[0] = 0
        depth_sensor.on_video_frame(picture(depth.as_video_stream_profile(), stored, k))
        rgb = np.full((HEIGHT, WIDTH, 3), (10 * k, 20, 200), np.uint8)
        colour_sensor.on_video_frame(picture(colour.as_video_stream_profile(), rgb, k))
        time.sleep(0.03)
    time.sleep(0.2)
    for sensor in sensors:
        sensor.stop()
        sensor.close()
    del recorder, sensors, sensor
    return path


def test_a_recording_of_the_librarys_simulated_device_plays(recording: Path) -> None:
    source = open_source(f"realsense:{recording}", SourceOptions(silence_s=20))
    camera = source.camera
    assert (camera.width, camera.height, camera.fx, camera.cy) == (WIDTH, HEIGHT, 60.0, 24.0)
    assert camera.depth_scale == pytest.approx(1000.0)
    frames = list(source.frames())  # it ends with the recording
    assert len(frames) >= FRAMES - 2
    for frame in frames:
        k = round((frame.timestamp_s - 1.0) / 0.1)
        assert frame.rgb[20, 30].tolist() == [10 * k, 20, 200]
        assert frame.depth_m[20, 30] == pytest.approx(1.0 + 0.001 * k)
        assert np.isnan(frame.depth_m[0]).all()
    assert np.diff([f.timestamp_s for f in frames]).min() > 0


def test_a_recording_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.db3: no such recording"):
        open_source(f"realsense:{tmp_path / 'none.db3'}", SourceOptions())
