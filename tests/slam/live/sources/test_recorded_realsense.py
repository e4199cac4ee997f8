"""``realsense:`` on a recording that pyrealsense2 itself makes, of its simulated device."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded_bags import TYPES, BagMaker, image

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.extras import load_libusb
from bmask_slam.graph.geometry import make_pose, so3_exp
from bmask_slam.live.sources.opening import SourceOptions, open_source
from bmask_slam.sequences.bags import topics
from bmask_slam.sequences.bags.bag_file import open_bag
from bmask_slam.sequences.sequence import open_sequence

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


T_COLOUR_DEPTH = make_pose(so3_exp(np.array([0.05, -0.1, 0.2])), np.array([0.1, -0.06, 0.04]))
"""Of the recording in which the two cameras are apart."""
BLOCK = slice(12, 24), slice(8, 20)
"""Pixels of depth that are nearer there."""


def write_recording(path: Path, T_colour_depth: np.ndarray, shape: np.ndarray) -> Path:
    """Six frames of a simulated device, ten a second: stored depth in 1/2 mm, 2 more each."""
    device = rs.software_device()
    depth_sensor, colour_sensor = (
        device.add_sensor("Stereo Module"),
        device.add_sensor("RGB Camera"),
    )
    depth = depth_sensor.add_video_stream(stream(rs.stream.depth, rs.format.z16, 2, 1))
    colour = colour_sensor.add_video_stream(stream(rs.stream.color, rs.format.rgb8, 3, 2))
    depth_sensor.add_read_only_option(rs.option.depth_units, 0.0005)
    to_colour = rs.extrinsics()
    to_colour.rotation = T_colour_depth[:3, :3].T.ravel().tolist()  # by columns
    to_colour.translation = T_colour_depth[:3, 3].tolist()
    depth.register_extrinsics_to(colour, to_colour)
    recorder, queue = rs.recorder(str(path), device), rs.frame_queue(2 * FRAMES)
    sensors = recorder.query_sensors()
    for sensor in sensors:
        sensor.open(sensor.get_stream_profiles())
        sensor.start(queue)
    for k in range(FRAMES):
        stored = np.where(shape > 0, shape + 2 * k, 0).astype(np.uint16)
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


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Depth of 1 m and a millimetre more each frame, none in the first row; cameras in one."""
    shape = np.full((HEIGHT, WIDTH), 2000)
    shape[0] = 0
    return write_recording(tmp_path_factory.mktemp("realsense") / "made.db3", np.eye(4), shape)


@pytest.fixture(scope="module")
def apart(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wall at 2 m and a block at 1 m, by a depth camera that is apart from colour's."""
    shape = np.full((HEIGHT, WIDTH), 4000)
    shape[BLOCK] = 2000
    return write_recording(tmp_path_factory.mktemp("apart") / "made.db3", T_COLOUR_DEPTH, shape)


def test_a_recording_of_the_librarys_simulated_device_plays(recording: Path) -> None:
    source = open_source(f"realsense:{recording}", SourceOptions(silence_s=20))
    camera = source.camera
    assert (camera.width, camera.height, camera.fx, camera.cy) == (WIDTH, HEIGHT, 60.0, 24.0)
    assert camera.depth_scale == pytest.approx(2000.0)
    frames = list(source.frames())  # it ends with the recording
    assert len(frames) >= FRAMES - 2
    for frame in frames:
        k = round((frame.timestamp_s - 1.0) / 0.1)
        assert frame.rgb[20, 30].tolist() == [10 * k, 20, 200]
        assert frame.depth_m[20, 30] == pytest.approx(1.0 + 0.001 * k)
        assert np.isnan(frame.depth_m[0]).all()
    assert np.diff([f.timestamp_s for f in frames]).min() > 0


def test_the_sdks_own_recording_is_a_sequence(recording: Path) -> None:
    sequence = open_sequence(recording)
    camera = sequence.camera
    assert (camera.width, camera.height, camera.fx, camera.cy) == (WIDTH, HEIGHT, 60.0, 24.0)
    assert len(sequence) >= FRAMES - 2
    for frame in sequence.frames():
        k = round(frame.rgb[20, 30, 0] / 10)
        assert frame.rgb[20, 30].tolist() == [10 * k, 20, 200]
        assert frame.depth_m[20, 30] == pytest.approx(1.0 + 0.001 * k)  # the unit is recorded


def test_its_depth_is_registered_as_the_sdk_does(apart: Path, caplog) -> None:
    with caplog.at_level(logging.INFO):
        frame = open_sequence(apart).load(0)
    assert "depth is registered" in caplog.text
    k = frame.rgb[20, 30, 0] / 10
    rows, columns = np.mgrid[BLOCK]
    z_m = 1 + 0.001 * k
    block = np.stack([(columns - 32) / 60 * z_m, (rows - 24) / 61 * z_m, z_m + 0 * rows], axis=-1)
    block = block.reshape(-1, 3) @ T_COLOUR_DEPTH[:3, :3].T + T_COLOUR_DEPTH[:3, 3]
    u, v = (block[:, :2] / block[:, 2:] * [60, 61] + [32, 24]).round().astype(int).T
    seen = (u >= 0) & (u < WIDTH) & (v >= 0) & (v < HEIGHT)
    assert seen.sum() > 50
    assert np.abs(frame.depth_m[v[seen], u[seen]] - block[seen, 2]).max() < 0.02  # half a pixel
    live = next(open_source(f"realsense:{apart}", SourceOptions(silence_s=20)).frames())
    middles = [np.argwhere(one.depth_m < 1.5).mean(axis=0) for one in (frame, live)]
    assert np.abs(middles[0] - middles[1]).max() < 1  # pixels; its values are z of the depth camera


def test_a_unit_of_depth_that_is_no_number_is_said(tmp_path: Path, caplog) -> None:
    unit = TYPES[True].types["std_msgs/msg/String"]("one")
    with BagMaker(tmp_path / "a.bag") as bag:
        bag.write_message(topics._SDK_UNITS, "std_msgs/msg/String", unit)
    with open_bag(tmp_path / "a.bag") as bag, caplog.at_level(logging.WARNING):
        assert topics._depth_scale(bag, image("16UC1", np.ones((2, 2), np.uint16)), "d") == 1000
    assert "Depth_Units/value is no number" in caplog.text


def test_a_recording_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.db3: no such recording"):
        open_source(f"realsense:{tmp_path / 'none.db3'}", SourceOptions())
