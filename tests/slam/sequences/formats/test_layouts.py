"""Each layout is recognised, and its frames, stamps, camera, depth and poses are read."""

from __future__ import annotations

import json
import logging
import struct
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_layouts import (
    COLOUR,
    FRAMES,
    POSES,
    SMALL_LAYOUTS,
    WALL_M,
    SmallLayout,
    colour,
    hole,
    raw_lzfse,
    write_r3d,
    write_small,
    write_tum,
)

from bmask_slam.cli import main
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import (
    make_pose,
    quaternion_from_rotation,
    rotation_from_quaternion,
    se3_exp,
)
from bmask_slam.sequences.cameras import write_camera
from bmask_slam.sequences.formats import euroc
from bmask_slam.sequences.formats.convert import convert
from bmask_slam.sequences.formats.lzfse import unpack_lzfse
from bmask_slam.sequences.sequence import Sequence, open_sequence


@pytest.fixture(params=SMALL_LAYOUTS, ids=lambda layout: layout.name)
def layout(request) -> SmallLayout:
    return request.param


@pytest.fixture
def path(layout: SmallLayout, tmp_path: Path) -> Path:
    return write_small(layout, tmp_path)


def check_frames(sequence: Sequence, layout: SmallLayout) -> None:
    """Frames, camera and depth are those that were written."""
    assert len(sequence) == FRAMES
    expected_s = layout.begin_s + np.arange(FRAMES) / 30
    assert np.allclose(sequence.timestamps_s, expected_s, atol=2e-6)
    c = sequence.camera
    assert (c.width, c.height) == (layout.camera.width, layout.camera.height)
    assert np.allclose(c.K, layout.camera.K)
    frame = sequence.load(2)
    assert np.abs(frame.rgb.astype(int) - colour(2, layout.camera)).mean() < 4
    middle = frame.depth_m[c.height // 2]
    assert np.nanmin(middle) == pytest.approx(WALL_M, abs=1e-3)
    assert np.nanmax(middle) == pytest.approx(WALL_M, abs=1e-3)
    begin, edges = c.width // 8, hole(layout.depth)  # without the border that depth does not see
    missing = np.flatnonzero(np.isnan(middle[begin : 5 * begin])) + begin
    for found, written in ((missing[0], edges.start), (missing[-1] + 1, edges.stop)):
        ray = (written - 0.5 - layout.depth.cx) / layout.depth.fx
        moved_px = c.fx * (ray + layout.shift_m / WALL_M) + c.cx
        assert found - 0.5 == pytest.approx(moved_px, abs=1.01)


def check_poses(sequence: Sequence, layout: SmallLayout) -> None:
    """T_world_camera, x right, y down, z forward."""
    if not layout.poses:
        assert sequence.groundtruth is None
        return
    truth = sequence.groundtruth
    assert truth is not None
    assert len(truth) == layout.poses
    for stamp_s, T in zip(truth.timestamps_s, truth.poses_world_camera, strict=True):
        k = round(30 * (stamp_s - layout.begin_s))
        assert np.allclose(T, POSES[k], atol=1e-6)


def test_a_layout_is_read(layout: SmallLayout, path: Path) -> None:
    sequence = open_sequence(path)
    assert sequence.recording.layout == layout.name
    check_frames(sequence, layout)
    check_poses(sequence, layout)
    again = open_sequence(sequence.folder, camera=sequence.camera)  # as bmask-slam map does
    assert np.array_equal(again.load(1).depth_m, sequence.load(1).depth_m, equal_nan=True)


def test_a_layout_is_converted(layout: SmallLayout, path: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    assert main(["convert", str(path), str(out)]) == 0
    assert f"{layout.name}: 3 colour and 3 depth images" in capsys.readouterr().out
    before, after = open_sequence(path), open_sequence(out)
    assert after.recording.layout == "TUM"
    check_poses(after, layout)
    assert np.allclose(after.timestamps_s, before.timestamps_s, atol=1e-9)
    for k in range(FRAMES):
        assert np.array_equal(after.load(k).rgb, before.load(k).rgb)
        depths = after.load(k).depth_m, before.load(k).depth_m
        assert np.allclose(*depths, atol=6e-4, equal_nan=True)
    assert main(["convert", str(path), str(out)]) == 1
    assert "is there already" in capsys.readouterr().err


def test_stamps_out_of_order_and_repeated_ones_are_counted(tmp_path: Path, caplog) -> None:
    folder = write_small(SMALL_LAYOUTS[0], tmp_path)
    first, second, third = (folder / "rgb.txt").read_text().splitlines()
    (folder / "rgb.txt").write_text("\n".join([second, first, third, third]) + "\n")
    with caplog.at_level(logging.WARNING):
        sequence = open_sequence(folder)
    assert len(sequence) == FRAMES
    assert (sequence.recording.rgb.unordered, sequence.recording.rgb.repeated) == (1, 1)
    assert "1 stamps out of order were sorted, 1 repeated ones left out" in caplog.text


@pytest.mark.parametrize("lists", ["rgb.txt and depth.txt", "rgb.txt", "associations.txt"])
@pytest.mark.parametrize("other", SMALL_LAYOUTS, ids=lambda layout: layout.name)
def test_the_lists_of_tum_win(other: SmallLayout, lists: str, tmp_path: Path) -> None:
    if Path(other.file).suffix or other.name == "ICL-NUIM":
        return
    folder = write_small(other, tmp_path)
    write_tum(folder)
    if "depth.txt" not in lists:
        (folder / "depth.txt").unlink()
    if lists == "associations.txt":
        (folder / "rgb.txt").unlink()
        text = "# colour depth\n" + "".join(
            f"{k} rgb/{k}.png {k} depth/{k}.png\n" for k in range(3)
        )
        (folder / lists).write_text(text)
    if lists == "rgb.txt":
        with pytest.raises(InputError, match=r"depth\.txt: no such list"):
            open_sequence(folder)
    else:
        assert open_sequence(folder).recording.layout == "TUM"


def test_other_associations_are_no_list_of_tum(tmp_path: Path) -> None:
    folder = write_small(SMALL_LAYOUTS[7], tmp_path)
    (folder / "associations.txt").write_text("0 0\n1 1\n")
    assert open_sequence(folder).recording.layout == "Open3D"


def test_the_rate_of_open3ds_images_is_that_of_the_camera(tmp_path: Path) -> None:
    folder = write_small(SMALL_LAYOUTS[7], tmp_path)
    before = open_sequence(folder)
    write_camera(folder / "camera.yaml", replace(before.camera, fps=15.0))
    slower = open_sequence(folder)
    np.testing.assert_allclose(slower.timestamps_s, 2 * before.timestamps_s)


def test_truth_of_markers_is_moved_to_the_camera(tmp_path: Path) -> None:
    folder = write_small(SMALL_LAYOUTS[6], tmp_path)
    T_body_markers = se3_exp(np.array([0.3, -0.2, 0.5, 0.2, -0.1, 0.4]))
    expected = open_sequence(folder).groundtruth.poses_world_camera
    body, markers = folder / "mav0/state_groundtruth_estimate0", folder / "mav0/vicon0"
    body.rename(markers)
    said = f"T_BS: {{cols: 4, rows: 4, data: {T_body_markers.ravel().tolist()}}}"
    (markers / "sensor.yaml").write_text(said)
    table = np.loadtxt(markers / "data.csv", delimiter=",")
    T_world_body = make_pose(rotation_from_quaternion(table[:, [5, 6, 7, 4]]), table[:, 1:4])
    rows = []
    for stamp_ns, T in zip(table[:, 0], T_world_body @ T_body_markers, strict=True):
        x, y, z, w = quaternion_from_rotation(T[:3, :3])
        rows.append(",".join(map(str, [int(stamp_ns), *T[:3, 3], w, x, y, z])))
    (markers / "data.csv").write_text("\n".join(rows))
    assert np.allclose(open_sequence(folder).groundtruth.poses_world_camera, expected, atol=1e-6)


def test_files_of_sensors_are_converted_too(tmp_path: Path, caplog) -> None:
    folder, out = write_small(SMALL_LAYOUTS[7], tmp_path), tmp_path / "out"
    carried = {"imu.csv": b"#t\n1,2\n", "odometry.txt": b"a", "accelerometer.txt": b"\xff\r\n"}
    for name, data in carried.items():
        (folder / name).write_bytes(data)
    (folder / "position.txt").symlink_to(folder / "imu.csv")
    (folder / "right.txt").write_text("0 a.png")
    with caplog.at_level(logging.WARNING):
        done = convert(folder, out)
    assert {name: (out / name).read_bytes() for name in done.copied} == carried
    assert "imu.csv" in str(done)
    for name in ("position.txt", "right.txt"):
        assert f"not carried over: {folder / name}" in caplog.text
        assert not (out / name).exists()


def test_a_camera_yaml_wins(tmp_path: Path) -> None:
    folder = write_small(SMALL_LAYOUTS[7], tmp_path)
    (folder / "camera.yaml").write_text(
        "{width: 32, height: 24, fx: 31, fy: 30, cx: 15, cy: 11, depth_scale: 2000}"
    )
    sequence = open_sequence(folder)
    assert (sequence.camera.fx, sequence.load(0).depth_m[0, 0]) == (31.0, 1.0)


BROKEN = {
    "seq-01": ("frame-000001.pose.txt", "1 0 0", "3 numbers where a 4x4 matrix"),
    "scene": ("intrinsic/intrinsic_color.txt", "0 " * 16, "focal length.*not positive"),
    "room0": ("traj.txt", "2 " * 16, "is no rotation"),
    "lr0": ("associations.txt", "0 a 1\n", "not of the form"),
    "V1": ("mav0/cam0/data.csv", "1,../../x.png\n", "leads out of the folder"),
    "realsense": ("camera_intrinsic.json", '{"width": 1e9}', "camera_intrinsic.json.*restore it"),
    "poly": ("keyframes/cameras/1000000.json", "[]", "1000000.json.*export it again"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_files_are_refused_in_one_line(name: str, tmp_path: Path) -> None:
    path = write_small(next(small for small in SMALL_LAYOUTS if small.file == name), tmp_path)
    check_refused(path, *BROKEN[name])


def test_a_focal_length_by_which_nothing_can_be_divided_is_refused(tmp_path: Path) -> None:
    path = write_small(next(small for small in SMALL_LAYOUTS if small.file == "scene"), tmp_path)
    tiny = "1e-320 0 15 0 0 15 5.5 0 0 0 1 0 0 0 0 1"
    check_refused(path, "intrinsic/intrinsic_depth.txt", tiny, "focal length.*not positive")


def check_refused(path: Path, file: str, text: str, reason: str) -> None:
    (path / file).write_text(text)
    with pytest.raises(InputError, match=reason) as caught:
        open_sequence(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("layout", SMALL_LAYOUTS, ids=lambda layout: layout.name)
def test_a_recording_that_is_gone_while_it_is_read(layout: SmallLayout, tmp_path: Path) -> None:
    """As of a disk that is unplugged."""
    sequence = open_sequence(write_small(layout, tmp_path))
    sequence.folder.rename(tmp_path / "unplugged")
    with pytest.raises(InputError, match=str(sequence.folder)):
        sequence.load(1)


@pytest.mark.parametrize("file", ["scene.sens", "a.r3d"])
def test_a_file_that_is_cut_off_is_refused(file: str, tmp_path: Path) -> None:
    path = write_small(next(small for small in SMALL_LAYOUTS if small.file == file), tmp_path)
    data = path.read_bytes()
    for size in (0, 10, 300, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:size])
        with pytest.raises(InputError):
            open_sequence(path)


def test_lzfse_is_measured_before_it_is_unpacked() -> None:
    assert unpack_lzfse(raw_lzfse(b"abcd"), 4, "here") == b"abcd"
    bomb = b"bvxn" + (1 << 31).to_bytes(4, "little") + (4).to_bytes(4, "little") + b"abcdbvx$"
    for data in (bomb, raw_lzfse(b"abcd")[:-4], b"", b"bvx1" + bytes(20)):
        with pytest.raises(InputError):
            unpack_lzfse(data, 4, "here")


def test_depth_of_record3d_is_unpacked_by_the_library(tmp_path: Path) -> None:
    library = pytest.importorskip("lzfse")
    layout = next(small for small in SMALL_LAYOUTS if small.name == "Record3D")
    write_r3d(tmp_path / "a.r3d", library.compress)
    with zipfile.ZipFile(tmp_path / "a.r3d") as packed:
        assert packed.read("rgbd/0.depth")[:4] == b"bvxn"
    sequence = open_sequence(tmp_path / "a.r3d")
    check_frames(sequence, layout)
    check_poses(sequence, layout)


@pytest.mark.parametrize("rows", [256, 4000])
def test_blocks_of_the_library_are_measured(rows: int) -> None:
    """One block, as large as a LiDAR's image of 192x256, and several."""
    library = pytest.importorskip("lzfse")
    v, u = np.mgrid[:rows, :192]
    data = (2 + np.sin(u / 30) + 0.1 * np.cos(v / 20).round(2)).astype("<f4").tobytes()
    packed = library.compress(data)
    assert packed[:4] == b"bvx2"
    assert unpack_lzfse(packed, len(data), "here") == data
    with pytest.raises(InputError, match=f"here: unpacks to {len(data)} bytes, not 8"):
        unpack_lzfse(packed, 8, "here")
    with pytest.raises(InputError, match=r"here: no LZFSE stream \(it is cut off\)"):
        unpack_lzfse(packed[: len(packed) // 2], len(data), "here")


BROKEN_BLOCK = b"bvxn" + struct.pack("<II", 4, 4) + b"abcd" + b"bvx$"


def test_what_the_library_cannot_unpack_is_refused() -> None:
    pytest.importorskip("lzfse")
    with pytest.raises(InputError, match="here: the LZFSE stream is broken"):
        unpack_lzfse(BROKEN_BLOCK, 4, "here")


def test_packed_depth_without_the_library_names_the_extra(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "lzfse", None)
    with pytest.raises(InputError, match=r"here: needs lzfse.*bmask-slam\[record3d\]"):
        unpack_lzfse(BROKEN_BLOCK, 4, "here")


def test_what_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such list as rgb"):
        open_sequence(tmp_path)
    (tmp_path / "intrinsic.json").write_text(json.dumps({"width": COLOUR.width}))
    with pytest.raises(InputError, match="none of the other layouts"):
        open_sequence(tmp_path)


@pytest.mark.parametrize("line", [",0.png", "1 2,0.png"])
def test_a_line_of_euroc_without_a_stamp_is_named(tmp_path: Path, line: str) -> None:
    folder = tmp_path / "cam0"
    folder.mkdir()
    (folder / "data.csv").write_text(f"# stamp,name\n{line}\n")
    with pytest.raises(InputError, match=r"data\.csv:2: .*no stamp in nanoseconds"):
        euroc._images(folder)


def euroc_without_intrinsics_of_depth(tmp_path: Path, place: str, said: str) -> Path:
    """Depth of 2 m registered to colour, whose sensor.yaml has ``T_BS`` of cam0 or depth0."""
    folder = write_small(SMALL_LAYOUTS[6], tmp_path)
    texts = {name: (folder / f"mav0/{name}/sensor.yaml").read_text() for name in ("cam0", "depth0")}
    T_BS = texts[place].partition("resolution")[0] if place else ""
    (folder / "mav0/depth0/sensor.yaml").write_text(f"{T_BS}{said}\n")
    height, width = SMALL_LAYOUTS[6].camera.height, SMALL_LAYOUTS[6].camera.width
    for file in (folder / "mav0/depth0/data").iterdir():
        cv2.imwrite(str(file), np.full((height, width), 10000, np.uint16))
    return folder


@pytest.mark.parametrize("place", ["cam0", ""])
def test_registered_depth_of_euroc_has_the_scale_that_it_tells(tmp_path: Path, place: str) -> None:
    folder = euroc_without_intrinsics_of_depth(tmp_path, place, "depth_scale: 5000")
    sequence = open_sequence(folder)
    assert sequence.camera.depth_scale == 5000
    np.testing.assert_allclose(sequence.load(0).depth_m, 2.0)


@pytest.mark.parametrize(
    ("place", "said", "message"),
    [
        ("depth0", "depth_scale: 5000", r"depth0.sensor\.yaml: T_BS is another than cam0's"),
        ("cam0", "depth_scale: 0", r"depth0.sensor\.yaml: depth_scale is 0; it must be"),
        ("cam0", "depth_scale: many", r"depth_scale is 'many'; it must be a number"),
    ],
)
def test_depth_of_euroc_that_cannot_be_placed_is_refused(tmp_path, place, said, message) -> None:
    with pytest.raises(InputError, match=message):
        open_sequence(euroc_without_intrinsics_of_depth(tmp_path, place, said))


@pytest.mark.parametrize("count", [0, -3])
def test_less_than_one_image_to_convert_is_refused(tmp_path: Path, capsys, count: int) -> None:
    folder, out = write_small(SMALL_LAYOUTS[0], tmp_path), tmp_path / "out"
    assert main(["convert", str(folder), str(out), "--max-frames", str(count)]) == 1
    message = f"--max-frames {count}: must be a whole number of at least 1"
    assert message in capsys.readouterr().err
    assert not out.exists()
