"""Bags are read back."""

from __future__ import annotations

import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded_bags import (
    BEGIN_S,
    DEPTH,
    INFO,
    RGB,
    STEP_S,
    BagMaker,
    camera_info,
    compressed,
    image,
    view,
    write_bag,
)

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.live.sources.bag_source import BagSource
from bmask_slam.sequences.bags import bag_file as bags
from bmask_slam.sequences.bags.bag_file import format_topics, is_bag, open_bag
from bmask_slam.sequences.bags.topics import BagTopics
from bmask_slam.sequences.cameras import write_camera
from bmask_slam.sequences.frame import Frame

FORMS = [("a.bag", ""), ("a.mcap", ""), ("folder", "sqlite3"), ("folder", "mcap")]


def assert_same(found: list[Frame], indices: list[int]) -> None:
    """Check that frames are exactly the views of these numbers, with indices from 0."""
    assert [frame.index for frame in found] == list(range(len(indices)))
    for frame, index in zip(found, indices, strict=True):
        expected = view(index)
        assert frame.timestamp_s == pytest.approx(expected.timestamp_s, abs=1e-6)
        assert np.array_equal(frame.rgb, expected.rgb)
        assert frame.depth_m.dtype == np.float32
        assert np.array_equal(frame.depth_m, expected.depth_m, equal_nan=True)


@pytest.mark.parametrize(("name", "storage"), FORMS)
def test_frames_are_read_from_every_bag_format(tmp_path: Path, name: str, storage: str) -> None:
    path = write_bag(tmp_path / name, storage=storage)
    assert is_bag(path)
    source = BagSource(path)
    assert_same(list(source.frames()), [0, 1, 2, 3])
    assert_same(list(source.frames()), [0, 1, 2, 3])
    assert source.counts.line() == ""
    assert source.waits
    camera = source.camera
    assert (camera.width, camera.height, camera.depth_scale) == (160, 120, 1.0)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (131.25, 130.0, 79.625, 60.375)
    assert camera.distortion == (0.1, -0.2, 0.001, 0.002, 0.05)


def test_depth_of_later_frames_is_straightened_by_a_camera_that_was_found(tmp_path: Path) -> None:
    source = BagSource(write_bag(tmp_path / "a.bag"))
    frames = source.frames()
    assert_same([next(frames)], [0])
    bent = replace(source.camera, depth_distortion=(0.01, -0.02, 0.03, 0.0, 0.01))
    source.use(bent)
    pixels = np.stack(np.meshgrid(np.arange(160.0), np.arange(120.0)), axis=-1)
    for index, frame in enumerate(frames, start=1):
        bend = 1 / view(index).depth_m - 1 / frame.depth_m
        measured = np.isfinite(bend)
        np.testing.assert_allclose(bend[measured], bent.depth_bend(pixels)[measured], atol=1e-6)
        assert measured.mean() > 0.5


def test_realtime_gives_frames_at_the_recorded_rate(tmp_path: Path) -> None:
    import time

    source = BagSource(write_bag(tmp_path / "a.bag", 6), realtime=True)
    begin_s = time.monotonic()
    assert len(list(source.frames())) == 6
    assert time.monotonic() - begin_s > 5 * STEP_S - 0.01
    assert not source.waits


def test_unusable_images_are_counted_and_skipped(tmp_path: Path) -> None:
    """Frame 1 without depth, 2 twice, 4 broken, 6 and 7 missing, then the clock is set back."""
    path = tmp_path / "a.bag"
    with BagMaker(path) as bag:
        bag.write(INFO, BEGIN_S, camera_info())
        for k in (0, 1, 2, 3, 4, 5, 8, 9):
            frame = view(k)
            stamp_s = frame.timestamp_s - (60 if k == 9 else 0)
            message = image("rgb8", frame.rgb)
            if k == 4:
                message.data = message.data[:-1]
            for _ in range(1 + (k == 2)):
                bag.write(RGB, stamp_s, message)
                if k != 1:
                    bag.write(DEPTH, stamp_s, image("32FC1", frame.depth_m))
    source = BagSource(path)
    found = list(source.frames())
    assert [int(frame.rgb[0, 0, 1]) for frame in found] == [0, 20, 30, 50, 80, 90]
    assert np.all(np.diff([frame.timestamp_s for frame in found]) > 0)
    counts = source.counts
    assert (counts.unpaired_rgb, counts.unpaired_depth, counts.broken) == (1, 0, 1)
    assert (counts.duplicates, counts.clock_jumps) == (2, 1)
    assert counts.gaps == 1  # before frame 9; two frames missing is a step of three


def test_other_topics_and_compressed_images(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with BagMaker(path) as bag:
        bag.write("/color/camera_info", BEGIN_S, camera_info())
        for frame in map(view, range(3)):
            png = np.ascontiguousarray(frame.rgb[..., ::-1])
            millimetres = np.nan_to_num(np.rint(1000 * frame.depth_m)).astype(np.uint16)
            message = compressed("rgb8; png compressed bgr8", ".png", png)
            bag.write("/color/image_raw/compressed", frame.timestamp_s, message)
            message = compressed("16UC1; compressedDepth png", ".png", millimetres, bytes(12))
            bag.write("/aligned/image_raw/compressedDepth", frame.timestamp_s, message)
    with pytest.raises(InputError, match=r"on the topics of any camera.*--rgb-topic.*/al"):
        BagSource(path)
    source = BagSource(path, BagTopics("/color/image_raw", "/aligned/image_raw"))
    assert source.camera.depth_scale == 1000
    found = list(source.frames())
    for frame, expected in zip(found, map(view, range(3)), strict=True):
        assert np.array_equal(frame.rgb, expected.rgb)
        assert np.array_equal(np.isnan(frame.depth_m), np.isnan(expected.depth_m))
        assert np.nanmax(np.abs(frame.depth_m - expected.depth_m)) < 0.00051


def test_rectified_images_have_the_camera_of_the_projection_matrix(tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    with BagMaker(path) as bag:
        bag.write("/camera/rgb/camera_info", BEGIN_S, camera_info())
        bag.write("/camera/rgb/image_rect_color", BEGIN_S, image("rgb8", view(0).rgb))
        bag.write(DEPTH, BEGIN_S, image("32FC1", view(0).depth_m))
    camera = BagSource(path, BagTopics("/camera/rgb/image_rect_color")).camera
    assert (camera.fx, camera.distortion) == (100.0, (0, 0, 0, 0, 0))


def test_a_given_camera_replaces_the_bags(tmp_path: Path) -> None:
    path, given = write_bag(tmp_path / "a.bag"), tmp_path / "camera.yaml"
    camera = Camera(160, 120, 140.0, 141.0, 80.0, 60.0, depth_scale=1.02, depth_offset_m=0.01)
    write_camera(given, camera)
    source = BagSource(path, camera=given)
    assert source.camera == camera
    depth_m = next(source.frames()).depth_m
    assert np.allclose(depth_m, view(0).depth_m / 1.02 + 0.01, atol=1e-6, equal_nan=True)
    write_camera(given, Camera(160, 120, 140.0, 141.0, 80.0, 60.0, depth_scale=5000))
    with pytest.raises(InputError, match=r"depth_scale is 5000.*write depth_scale: 1$"):
        BagSource(path, camera=given)


def test_missing_topics_are_named(tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    with BagMaker(path) as bag:
        bag.write(RGB, BEGIN_S, image("rgb8", view(0).rgb))
        bag.write(DEPTH, BEGIN_S, image("32FC1", view(0).depth_m))
        bag.write("/other/camera_info", BEGIN_S, camera_info())
    with pytest.raises(InputError, match=r"no camera_info on /camera/rgb/camera_info.*/other"):
        BagSource(path)
    assert BagSource(path, BagTopics(camera_info="/other/camera_info")).camera.fx == 131.25
    with pytest.raises(InputError, match=r"no images on /depth.*--depth-topic"):
        BagSource(path, BagTopics(depth="/depth"))
    with pytest.raises(InputError, match="where depth is expected"):
        BagSource(path, BagTopics(depth=RGB, camera_info="/other/camera_info"))


def test_unregistered_depth_is_refused_or_warned_of(tmp_path: Path, caplog) -> None:
    for name, depth_m in (("a.bag", view(0).depth_m), ("b.bag", view(0).depth_m[::2, ::2])):
        with BagMaker(tmp_path / name) as bag:
            bag.write(INFO, BEGIN_S, camera_info())
            bag.write(RGB, BEGIN_S, image("rgb8", view(0).rgb), "rgb_optical")
            bag.write(DEPTH, BEGIN_S, image("32FC1", depth_m), "depth_optical")
    BagSource(tmp_path / "a.bag")
    assert "depth in 'depth_optical'" in caplog.text
    with pytest.raises(InputError, match="colour has 160x120 pixels, depth 80x60"):
        BagSource(tmp_path / "b.bag")


def file_of(path: Path) -> Path:
    """The file with a bag's messages."""
    return next(f for f in path.iterdir() if f.suffix != ".yaml") if path.is_dir() else path


@pytest.mark.parametrize(("name", "storage"), FORMS)
def test_a_damaged_bag_loses_images_or_is_refused(tmp_path: Path, name: str, storage: str) -> None:
    """Random bytes are changed in the headers, in the index at the end, and anywhere."""
    path = write_bag(tmp_path / name, 3, storage)
    file, rng = file_of(path), np.random.default_rng(5)
    whole = np.frombuffer(file.read_bytes(), np.uint8)
    for _ in range(25):
        data = whole.copy()
        ends = [rng.integers(0, 6000, 2), len(data) - rng.integers(1, 3000, 2)]
        places = np.concatenate([*ends, rng.integers(0, len(data), 2)])
        data[places] = rng.integers(0, 256, len(places))
        file.write_bytes(data.tobytes())
        try:
            assert len(list(BagSource(path).frames())) <= 3
        except InputError as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize(("name", "storage"), FORMS)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_a_truncated_bag_is_refused(tmp_path: Path, name: str, storage: str, share: float) -> None:
    path = write_bag(tmp_path / name, storage=storage)
    file = file_of(path)
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    with pytest.raises(InputError, match=str(path)) as refusal:
        list(BagSource(path).frames())
    assert "\n" not in str(refusal.value)


def test_files_that_are_not_bags_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such bag"):
        BagSource(tmp_path / "none.bag")
    for suffix in (".bag", ".mcap", ".db3"):
        path = tmp_path / f"noise{suffix}"
        path.write_bytes(bytes(range(256)) * 8)
        with pytest.raises(InputError, match=str(path)):
            BagSource(path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "metadata.yaml").write_text("a: 1\n")
    with pytest.raises(InputError, match="folder"):
        BagSource(tmp_path / "folder")


def test_without_rosbags_the_error_says_what_to_install(tmp_path: Path, monkeypatch) -> None:
    path = write_bag(tmp_path / "a.bag")
    for name in [name for name in sys.modules if name.startswith("rosbags")]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError, match=r"a\.bag: needs rosbags.*pip install 'bmask-slam\[ros\]'"):
        BagSource(path)


def test_topics_are_listed(tmp_path: Path) -> None:
    with open_bag(write_bag(tmp_path / "a.bag")) as bag:
        lines = format_topics(bag).splitlines()
    assert len(lines) == 4
    assert [line.split() for line in lines if RGB in line] == [
        [RGB, "sensor_msgs/msg/Image", "4", "messages"]
    ]


@pytest.mark.parametrize(("name", "storage"), FORMS)
def test_memory_does_not_grow_with_the_bag(tmp_path: Path, name: str, storage: str) -> None:
    """The peak while 60 frames are read is far below the 8 MB of their images."""
    frames = BagSource(write_bag(tmp_path / name, 60, storage)).frames()
    next(frames)  # what is loaded once
    tracemalloc.start()
    try:
        assert sum(1 for _ in frames) == 59
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 4e6


PACKED = [
    *(("a.bag", "", "bz2"), ("a.bag", "", "lz4"), ("folder", "mcap", "storage")),
    *(("folder", "sqlite3", "message"), ("folder", "sqlite3", "file")),
]


@pytest.mark.parametrize(("name", "storage", "packing"), PACKED)
def test_a_compressed_bag_unpacks_to_no_more_than_is_allowed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, storage: str, packing: str
) -> None:
    """A black image is packed to a five-hundredth or less; rosbags itself has no limit."""
    (tmp_path / "usual").mkdir()
    small = write_bag(tmp_path / "usual" / name, storage=storage, packing=packing)
    assert_same(list(BagSource(small).frames()), [0, 1, 2, 3])
    path, black = tmp_path / name, np.zeros((1200, 1600, 3), np.uint8)
    with BagMaker(path, storage, packing) as maker:
        maker.write(RGB, BEGIN_S, image("rgb8", black))

    def read() -> int:
        with open_bag(path) as bag:
            return sum(message.data.nbytes for _, message in bag.messages(RGB))

    assert read() == black.nbytes
    assert read() == black.nbytes, "every opening has its own allowance"
    monkeypatch.setattr(bags, "SMALL_BYTES", black.nbytes - 1)
    with pytest.raises(InputError, match="it unpacks to far more than its size"):
        read()
