"""Bags as sequences: any frame at any time, known topics, depth of a camera of its own."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded_bags import (
    BEGIN_S,
    RGB,
    STEP_S,
    TYPES,
    BagMaker,
    camera_info,
    compressed,
    image,
    view,
    write_bag,
)
from small_layouts import COARSE, COLOUR, WALL_M, colour, depth_m, hole

from bmask_slam.cli import main
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse, se3_exp
from bmask_slam.live.sources.bag_source import BagSource
from bmask_slam.sequences.bags import bag_recording
from bmask_slam.sequences.bags.topics import KNOWN_TOPICS, BagTopics, split_path
from bmask_slam.sequences.sequence import open_sequence


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3", "folder"])
def test_frames_are_read_in_any_order(tmp_path: Path, name: str, monkeypatch) -> None:
    monkeypatch.setattr(bag_recording, "KEPT_MESSAGES", 3)
    monkeypatch.setattr(bag_recording, "AHEAD_NS", 4_000_000)  # of 1 ms a message
    monkeypatch.setattr(bag_recording, "BEFORE_NS", 1_000_000)
    sequence = open_sequence(write_bag(tmp_path / name, 12))
    assert len(sequence) == 12
    for index in (0, 1, 11, 3, 2, 3, 7, 0):
        frame, expected = sequence.load(index), view(index % 4)
        assert frame.timestamp_s == pytest.approx(BEGIN_S + index * STEP_S, abs=1e-6)
        assert np.array_equal(frame.rgb, expected.rgb)
        assert np.array_equal(frame.depth_m, expected.depth_m, equal_nan=True)


@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
def test_of_messages_with_one_stamp_the_first_is_kept(tmp_path: Path, name: str) -> None:
    """As of the lines of a list, whether or not the others are read before it."""
    with BagMaker(tmp_path / name) as bag:
        bag.write("/camera/rgb/camera_info", BEGIN_S, info_of(COLOUR))
        for k in range(6):
            stamp_s = BEGIN_S + k // 2
            bag.write("/camera/rgb/image_color", stamp_s, image("rgb8", colour(k)))
            depth = image("16UC1", np.full((24, 32), 1000 + k, np.uint16))
            bag.write("/camera/depth/image", stamp_s, depth)
    sequence = open_sequence(tmp_path / name)
    assert len(sequence) == 3
    for k in (0, 1, 2, 0, 2, 1):
        frame = sequence.load(k)
        assert np.array_equal(frame.rgb, colour(2 * k))
        assert frame.depth_m[0, 0] == pytest.approx(1.0 + 0.002 * k)


@pytest.mark.parametrize("name", ["a.bag", "a.db3"])
def test_a_bag_is_converted(name: str, tmp_path: Path, capsys) -> None:
    path, out = write_bag(tmp_path / name), tmp_path / "out"
    assert main(["convert", f"{path}", f"{out}", "--rgb-topic", RGB]) == 0
    assert "ROS bag: 4 colour and 4 depth images" in capsys.readouterr().out
    before, after = open_sequence(path), open_sequence(out)
    assert after.recording.layout == "TUM"
    assert after.camera == replace(before.camera, depth_scale=after.camera.depth_scale)
    assert np.allclose(after.timestamps_s, before.timestamps_s, atol=1e-6)
    for k in range(4):
        assert np.array_equal(after.load(k).rgb, before.load(k).rgb)
        depths = after.load(k).depth_m, before.load(k).depth_m
        assert np.allclose(*depths, atol=1.1e-4, equal_nan=True)


@pytest.mark.parametrize("begin_s", [0.0, 1.0])
@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "folder"])
def test_a_clock_may_begin_at_zero(tmp_path: Path, name: str, begin_s: float) -> None:
    with BagMaker(tmp_path / name, begin_s=begin_s) as bag:
        bag.write("/camera/rgb/camera_info", begin_s, info_of(COLOUR))
        for k in range(2):
            bag.write("/camera/rgb/image_color", begin_s + k, image("rgb8", colour(k)))
            depth = image("16UC1", np.full((24, 32), 1500, np.uint16))
            bag.write("/camera/depth/image", begin_s + k, depth)
    sequence = open_sequence(tmp_path / name)
    for k in (0, 1, 0):
        assert np.array_equal(sequence.load(k).rgb, colour(k))


def info_of(camera) -> object:
    info = camera_info((0.0,) * 5)
    info.width, info.height, info.k = camera.width, camera.height, camera.K.ravel()
    info.p = np.hstack([camera.K, np.zeros((3, 1))]).ravel()
    return info


T_COLOUR_DEPTH = np.eye(4)
T_COLOUR_DEPTH[0, 3] = 0.1
SDK = "/device_0/sensor_{}/{}_0"


def write_unregistered(path: Path, known: bool = True, packed: bool = False) -> Path:
    """Coarse depth 10 cm to the right of colour, by /tf_static over a common base.

    It is rectified: what the depth camera's lens did to the images as they were does not count.
    """
    of_depth = info_of(COARSE)
    of_depth.d[0] = 0.5
    T_base_colour = se3_exp(np.array([0.1, -0.2, 0.3, 1.0, 2.0, 3.0]))
    with BagMaker(path) as bag:
        if known:
            bag.write_transform("/tf_static", T_base_colour, ("base", "/rgb"))
            bag.write_transform("/tf_static", T_base_colour @ T_COLOUR_DEPTH, ("base", "ir"))
        bag.write("/camera/color/camera_info", 1.0, info_of(COLOUR))
        bag.write("/camera/depth/camera_info", 1.0, of_depth)
        for k in range(3):
            bag.write("/camera/color/image_raw", 1 + k / 30, image("rgb8", colour(k)), "rgb")
            values = np.rint(1000 * depth_m(COARSE)).astype(np.uint16)
            topic, depth = "/camera/depth/image_rect_raw", image("16UC1", values)
            if packed:
                topic = f"{topic}/compressedDepth"
                depth = compressed("16UC1; compressedDepth png", ".png", values, bytes(12))
            bag.write(topic, 1 + k / 30, depth, "/ir")
    return path


def write_sdk(path: Path) -> Path:
    """As RealSense's SDK records: transforms are T_stream_reference, the unit of depth 0.5 mm."""
    T_colour_reference = se3_exp(np.array([0.1, -0.2, 0.3, 0.01, 0.02, 0.03]))
    rgb, depth = SDK.format(1, "Color"), SDK.format(0, "Depth")
    with BagMaker(path) as bag:
        bag.write_transform(f"{rgb}/tf/0", T_colour_reference, None)
        bag.write_transform(f"{depth}/tf/0", inverse(T_COLOUR_DEPTH) @ T_colour_reference, None)
        bag.write(f"{rgb}/info/camera_info", 1.0, info_of(COLOUR))
        bag.write(f"{depth}/info/camera_info", 1.0, info_of(COARSE))
        unit = TYPES[True].types["std_msgs/msg/Float32"](0.0005)
        bag.write_message(
            "/device_0/sensor_0/option/Depth_Units/value", "std_msgs/msg/Float32", unit
        )
        for k in range(3):
            bag.write(f"{rgb}/image/data", 1 + k / 30, image("rgb8", colour(k)), "0")
            values = np.rint(2000 * depth_m(COARSE)).astype(np.uint16)
            bag.write(f"{depth}/image/data", 1 + k / 30, image("mono16", values), "0")
    return path


@pytest.mark.parametrize(("write", "name"), [(write_unregistered, "a"), (write_sdk, "a.bag")])
def test_depth_of_its_own_camera_is_registered(write, name: str, tmp_path: Path) -> None:
    path = write(tmp_path / name)
    recorded = open_sequence(path).load(1)
    live = list(BagSource(path).frames())[1]
    assert np.array_equal(recorded.depth_m, live.depth_m, equal_nan=True)
    middle = recorded.depth_m[12]
    assert np.nanmax(np.abs(middle - WALL_M)) < 1e-3
    missing = np.flatnonzero(np.isnan(middle[4:20])) + 4
    edges = hole(COARSE)
    for found, written in ((missing[0], edges.start), (missing[-1] + 1, edges.stop)):
        ray = (written - 0.5 - COARSE.cx) / COARSE.fx + 0.1 / WALL_M
        assert found - 0.5 == pytest.approx(COLOUR.fx * ray + COLOUR.cx, abs=1.01)


def test_depth_in_its_compressed_form_is_of_the_same_camera(tmp_path: Path) -> None:
    plain, packed = (
        open_sequence(write_unregistered(tmp_path / name, packed=name == "packed")).load(1)
        for name in ("plain", "packed")
    )
    assert np.array_equal(packed.depth_m, plain.depth_m, equal_nan=True)


def test_depth_whose_place_is_not_told_is_refused(tmp_path: Path, caplog) -> None:
    with caplog.at_level(logging.WARNING), pytest.raises(InputError, match="depth 16x12"):
        open_sequence(write_unregistered(tmp_path / "a", known=False))
    assert "does not tell where they are" in caplog.text


@pytest.mark.parametrize(("rgb", "depth"), [known[1:] for known in KNOWN_TOPICS[:-5]])
def test_the_topics_of_known_cameras_need_not_be_given(rgb: str, depth: str, tmp_path) -> None:
    with BagMaker(tmp_path / "a.bag") as bag:
        info = f"{rgb.removesuffix('/image/data')}/info/camera_info"
        beside = f"{rgb.rpartition('/')[0]}/camera_info"
        bag.write(info if rgb.endswith("/data") else beside, 1.0, info_of(COLOUR))
        bag.write(rgb, 1.0, image("rgb8", colour(0)))
        bag.write("/other/image", 1.0, image("rgb8", colour(1)))
        bag.write(depth, 1.0, image("16UC1", np.full((24, 32), 1500, np.uint16)))
    assert open_sequence(tmp_path / "a.bag").camera.fx == COLOUR.fx


def test_topics_are_a_part_of_the_path(tmp_path: Path) -> None:
    topics = BagTopics("/a/rgb", "/b")
    path = topics.of_path(tmp_path / "a.bag")
    assert split_path(path) == (tmp_path / "a.bag", topics)
    assert split_path(tmp_path / "a.bag") == (tmp_path / "a.bag", BagTopics())
    write_bag(tmp_path / "a.bag")
    with pytest.raises(InputError, match="no images on /a/rgb; give --rgb-topic"):
        open_sequence(path)
