"""camera.yaml and the cameras that are built in."""

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bmask_slam.graph.camera import Camera, DepthNoise
from bmask_slam.graph.errors import InputError
from bmask_slam.sequences.camera_presets import FOLDERS, PRESETS
from bmask_slam.sequences.cameras import (
    CAMERA_EXAMPLE,
    find_camera,
    given_camera,
    read_camera,
    recorded_camera,
)
from bmask_slam.sequences.cameras import write_camera as write_file

LINES = {
    "width": "640",
    "height": "480",
    "fx": "527.27",
    "fy": "528.5",
    "cx": "321.42",
    "cy": "237.05",
    "distortion": "[0.1, -0.2, 0.003, -0.004, 0.5]",
    "depth_scale": "5000",
    "fps": "25",
    "stereo_bf": "41.5",
}


def write_camera(folder, **changes):
    values = {**LINES, **changes}
    text = "\n".join(f"{key}: {value}" for key, value in values.items() if value is not None)
    (folder / "camera.yaml").write_text(text)
    return folder / "camera.yaml"


def test_every_key(tmp_path):
    assert read_camera(write_camera(tmp_path)) == Camera(
        640, 480, 527.27, 528.5, 321.42, 237.05, (0.1, -0.2, 0.003, -0.004, 0.5), 5000, 25, 41.5
    )  # fmt: skip


def test_optional_keys(tmp_path):
    path = write_camera(tmp_path, distortion=None, fps=None, stereo_bf=None)
    assert read_camera(path) == Camera(640, 480, 527.27, 528.5, 321.42, 237.05)
    path = write_camera(tmp_path, distortion="[0.1, 0.2, 0.3, 0.4]")
    assert read_camera(path).distortion == (0.1, 0.2, 0.3, 0.4, 0)


def test_covered_parts_are_read_and_written(tmp_path):
    path = write_camera(tmp_path, covered="[[0, 400, 640, 480], [10, 0, 20, 5]]")
    camera = read_camera(path)
    assert camera.covered == ((0, 400, 640, 480), (10, 0, 20, 5))
    write_file(tmp_path / "again.yaml", camera)
    assert read_camera(tmp_path / "again.yaml") == camera
    visible, wider = camera.visible(), camera.visible(5)
    assert visible.shape == (480, 640) and (~visible).sum() == 80 * 640 + 5 * 10
    assert not wider[395:].any() and wider[394].all() and not wider[:10, 5:25].any()
    assert hash(camera) and camera.fault() == ""
    assert "[0, 0, 700, 9], which is no part" in replace(camera, covered=((0, 0, 700, 9),)).fault()


def test_the_example_in_the_messages_is_valid(tmp_path):
    (tmp_path / "camera.yaml").write_text(CAMERA_EXAMPLE)
    assert read_camera(tmp_path / "camera.yaml") == Camera(640, 480, 525.0, 525.0, 319.5, 239.5)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fx": None}, "fx is missing"),
        ({"depth_scale": None}, "depth_scale is missing"),
        ({"fx": "-527"}, "fx is -527; it must be positive"),
        ({"fy": "0"}, "fy is 0; it must be positive"),
        ({"fx": "1.0e-12"}, r"camera\.yaml: a focal length.* 1e-12, which is not positive"),
        ({"fx": "1.0e+200"}, r"camera\.yaml: a camera with a number that is not finite"),
        ({"depth_scale": "0"}, "depth_scale is 0"),
        ({"stereo_bf": "-1"}, "stereo_bf is -1"),
        ({"width": "640.5"}, "width is 640.5; it must be a whole number"),
        ({"cx": "640"}, "cx is 640, outside the image of width 640"),
        ({"cy": "-1"}, "cy is -1, outside the image of height 480"),
        ({"fx": "wide"}, "fx is 'wide'; it must be a number"),
        ({"fx": "true"}, "fx is True"),
        ({"fx": ".nan"}, "fx is nan"),
        ({"fx": ".inf"}, "fx is inf"),
        ({"fx": "[1, 2]"}, r"fx is \[1, 2\]"),
        ({"distortion": "[1, 2]"}, r"distortion is \[1, 2\]"),
        ({"distortion": "0"}, "distortion is 0"),
        ({"distortion": "[0, 0, 0, 0, x]"}, "distortion is 'x'"),
        ({"depth_offset": "12"}, "depth_offset is 12, more than 1 either way; .* in metres"),
        ({"depth_time_offset": "-10"}, "depth_time_offset is -10, more than 1 .* in seconds"),
        ({"rolling_shutter": "25"}, "rolling_shutter is 25, more than 1 .* in seconds"),
        (
            {"depth_noise": "[1.5, -1.5, 1.9]"},
            r"depth_noise is .* 1.22 m at 0.3 m; more than a fif",
        ),
        ({"depth_noise": "[0, 0, 2]"}, "more than a fifth of the depth; write .* in metres"),
        ({"depth_noise": "[0, 0, 0]"}, r"0 m at 0.3 m; it must be positive; write \[a, b, c\]"),
        ({"depth_noise": "[0.001, -0.001, 0.0001]"}, "positive"),
        (
            {"depth_noise": "[0, 0, 0.002, 0.5]"},
            "factor in the graph, 0.5, must be from 1",
        ),
        ({"depth_distortion": "[0.01, 0]"}, r"depth_distortion is \[0.01, 0\]; write \[u, v, uu"),
        ({"depth_distortion": "[0, 0, 15, 0, 0]"}, "more than 0.2 either way; it is in 1/m"),
        ({"depth_distortion": "[0, 0, x, 0, 0]"}, "depth_distortion is 'x'; it must be a number"),
        ({"depth_noise": "0.002"}, r"depth_noise is 0.002; write \[a, b, c\]"),
        ({"depth_noise": "[0.1, x, 0]"}, "depth_noise is 'x'"),
        ({"up": "down"}, "up is 'down'; it is the side of the image .* top, right, bottom, left"),
        (
            {"covered": "bottom"},
            r"covered has 'bottom'; write \[\[left, top, right",
        ),
        ({"covered": "[0, 400, 640, 480]"}, r"covered has 0; write \[\[left"),
        ({"covered": "[[0, 400.5, 640, 480]]"}, r"covered has \[0, 400.5, 640, 480\]; write"),
        ({"covered": "[[0, 0, 641, 9]]"}, r"covered has \[0, 0, 641, 9\], no part of the image"),
        ({"covered": "[[9, 0, 9, 9]]"}, r"covered has \[9, 0, 9, 9\], no part of the image"),
        ({"focal": "500"}, "unknown key 'focal'; the keys are width"),
        ({"fx": "[1, 2"}, "line 4: .*; write e.g."),
    ],
)
def test_impossible_cameras(tmp_path, changes, words):
    path = write_camera(tmp_path, **changes)
    with pytest.raises(InputError, match=words) as caught:
        read_camera(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["just text", "- 1\n- 2\n"])
def test_not_a_mapping(tmp_path, text):
    (tmp_path / "camera.yaml").write_text(text)
    with pytest.raises(InputError, match="no mapping"):
        read_camera(tmp_path / "camera.yaml")


@pytest.mark.parametrize(
    ("name", "fx", "k1", "depth_scale"),
    [
        ("rgbd_dataset_freiburg1_xyz", 517.306408, 0.262383, 5000),
        ("rgbd_dataset_freiburg2_large_with_loop", 520.908620, 0.231222, 5208),
        ("rgbd_dataset_freiburg3_walking_xyz", 535.4, 0.0, 5000),
        ("fr2_desk", 520.908620, 0.231222, 5208),
    ],
)
def test_built_in_by_folder_name(tmp_path, caplog, name, fx, k1, depth_scale):
    caplog.set_level(logging.INFO)
    (tmp_path / name).mkdir()
    camera, source = find_camera(tmp_path / name)
    assert (camera.fx, camera.distortion[0]) == (fx, k1)
    assert camera.depth_scale == depth_scale
    assert name in source
    assert f"depth scale {depth_scale} to the metre" in caplog.text


def test_camera_file_wins(tmp_path):
    folder = tmp_path / "rgbd_dataset_freiburg2_desk"
    folder.mkdir()
    write_camera(folder)
    camera, source = find_camera(folder)
    assert camera.depth_scale == 5000
    assert source.partition(",")[0].endswith("camera.yaml")


@pytest.mark.parametrize("name", ["kitchen", "freiburg4_new", "fr12", "frame1", "afr1"])
def test_no_camera(tmp_path, name):
    (tmp_path / name).mkdir()
    with pytest.raises(InputError, match=r"write a camera\.yaml such as") as caught:
        find_camera(tmp_path / name)
    assert name in str(caught.value)


# --- presets ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "readout_s"),
    [
        ("rgbd_dataset_freiburg1_rpy", 0.026),
        ("tum_fr2_desk", 0.026),
        ("rgbd_dataset_freiburg3_walking_xyz", 0.0310),
        ("rgbd_bonn_crowd", 0.0310),
        ("bonn_moving", 0.0310),
        ("bonnet", 0.0),
        ("redkitchen", 0.026),
        ("7-Scenes-heads", 0.026),
        ("kitchen", 0.0),
    ],
)
def test_a_published_recording_has_the_readout_time_of_its_camera(tmp_path, name, readout_s):
    folder = tmp_path / name
    folder.mkdir()
    write_camera(folder)
    camera, source = find_camera(folder)
    assert camera.rolling_shutter_s == readout_s
    assert camera.fx == 527.27  # the file's
    assert ("rolling_shutter" in source) == (readout_s > 0)


@pytest.mark.parametrize("value", [0.0, 0.011])
def test_a_key_in_the_file_wins_over_preset_and_name(tmp_path, value):
    folder = tmp_path / "rgbd_bonn_crowd"
    folder.mkdir()
    write_camera(folder, rolling_shutter=value)
    assert find_camera(folder)[0].rolling_shutter_s == value
    assert find_camera(folder, Path("kinect-v1"))[0].rolling_shutter_s == value


def test_a_preset_adds_to_the_file_beside_a_recording_that_tells_its_camera(tmp_path):
    folder = tmp_path / "7-Scenes-heads"
    folder.mkdir()
    write_camera(folder)
    own = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
    for given in (None, Path("kinect-v1")):
        camera, _ = recorded_camera(own, "7-Scenes", folder, given)
        assert (camera.fx, camera.rolling_shutter_s) == (527.27, 0.026)
    assert recorded_camera(own, "7-Scenes", folder, Path("kinect-v1"))[0].depth_noise is not None


def test_the_preset_given_wins_over_the_name_and_leaves_intrinsics(tmp_path):
    folder = tmp_path / "rgbd_bonn_crowd"
    folder.mkdir()
    write_camera(folder, distortion="[0.1, 0.2, 0.3, 0.4]")
    camera, source = find_camera(folder, Path("realsense-d455"))
    assert (camera.rolling_shutter_s, camera.fx, camera.width) == (0.0, 527.27, 640)
    assert "realsense-d455" in source


def test_a_preset_alone_is_a_camera_where_intrinsics_are_published(tmp_path, caplog):
    camera, _ = find_camera(tmp_path, Path("kinect-v1"))
    assert (camera.width, camera.fx, camera.depth_scale) == (640, 525.0, 1000.0)
    assert camera.rolling_shutter_s == pytest.approx(480 * 54.21e-6, abs=1e-4)
    assert "a camera.yaml is more accurate" in caplog.text
    with pytest.raises(InputError, match="--camera azure-kinect: every Microsoft Azure Kinect DK"):
        find_camera(tmp_path, Path("azure-kinect"))
    with pytest.raises(InputError, match=r"kinectv1: no such file; .* one of kinect-v1, xtion"):
        find_camera(tmp_path, Path("kinectv1"))


def test_the_depth_noise_is_the_files_then_the_presets(tmp_path):
    folder = tmp_path / "rgbd_dataset_freiburg1_rpy"
    folder.mkdir()
    write_camera(folder)
    assert read_camera(folder / "camera.yaml").depth_noise is None
    camera, source = find_camera(folder)
    assert camera.depth_noise == PRESETS["kinect-v1"].depth_noise
    assert source.endswith("depth noise of kinect-v1")
    write_camera(folder, depth_noise="[0.001, 0, 0.002]")
    camera, source = find_camera(folder, Path("realsense-d455"))
    assert camera.depth_noise == DepthNoise(0.001, 0.0, 0.002)
    assert "depth noise" not in source


def test_a_camera_is_read_as_it_was_written(tmp_path):
    camera = Camera(
        640, 480, 527.5, 528.5, 321.5, 237.5, depth_noise=DepthNoise(0.001, -1e-4, 2e-3)
    )
    in_graph = replace(camera, depth_noise=DepthNoise(c_per_m=0.002, in_graph=2.0))
    bent = replace(camera, depth_distortion=(0.001, -0.002, 0.0105, 0.02, -0.004))
    for written in (camera, in_graph, bent, replace(camera, depth_noise=None, up="left")):
        write_file(tmp_path / "camera.yaml", written)
        assert read_camera(tmp_path / "camera.yaml") == written


def test_a_device_overrides_the_preset():
    own = Camera(640, 480, 611.0, 612.0, 320.0, 240.0)
    camera = given_camera(Path("xtion"), own)
    assert (camera.fx, camera.rolling_shutter_s) == (611.0, 0.0310)


def test_all_presets_are_valid_cameras():
    assert {name for _, name in FOLDERS} <= set(PRESETS)
    for name, preset in PRESETS.items():
        if preset.nominal is not None:
            assert 0.4 < preset.nominal.fx / preset.nominal.width < 1.0, name
        if preset.rolling_shutter_s is not None:
            assert 0 <= preset.rolling_shutter_s < 1 / 30, name
        if preset.depth_noise is not None:  # between a tenth of a millimetre and 5 cm at 2 m
            assert 1e-4 < preset.depth_noise.depth_sigma_m(np.array(2.0)) < 0.05, name
