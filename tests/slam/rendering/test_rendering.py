"""Rendered sequences: geometry, conventions, labels, noise, repeatability."""

from __future__ import annotations

import filecmp
import json
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from repository import ROOT

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.yaml_file import read_yaml
from bmask_slam.graph.geometry import inverse, rotation_from_quaternion, so3_exp, so3_log, transform
from bmask_slam.rendering import sequence as renderer
from bmask_slam.rendering.annotations import CATEGORY_IDS
from bmask_slam.rendering.config import SCENES, RenderConfig, kinect_camera
from bmask_slam.rendering.engine.atlas import build_atlas
from bmask_slam.rendering.engine.meshes import quad
from bmask_slam.rendering.engine.path import CameraPath, camera_poses, look_at
from bmask_slam.rendering.engine.raycast import Renderer, build_geometry
from bmask_slam.rendering.engine.sensor import blur, depth_sigma_m, measure_depth, optical_flow
from bmask_slam.rendering.rooms import corridor, living_room, office
from bmask_slam.rendering.sequence import render_sequence
from bmask_slam.rendering.things.people import PULLED_S, Person, Role

PERSON = CATEGORY_IDS["person"]
CAMERA = Camera(160, 120, fx=131.25, fy=131.25, cx=79.5, cy=59.5, stereo_bf_px_m=10.0)
KINECT = Camera(640, 480, fx=525.0, fy=525.0, cx=319.5, cy=239.5)


def _one_quad(picture: np.ndarray, z_m: float = 2.0) -> Renderer:
    """A wall 4 m wide, 3 m high, ``z_m`` before a camera at the world's origin."""
    shape = quad((-2, -1.5, z_m), (4, 0, 0), (0, 3, 0))
    light = np.ones((2, 3))
    number = np.zeros(2, int)
    wall = build_geometry(shape.corners, shape.uvs, light, number, number + 7)
    return Renderer(CAMERA, build_atlas([picture]), wall)


def _smooth_picture() -> np.ndarray:
    v, u = np.mgrid[:300, :400]
    waves = 120 + 50 * np.sin(u / 17.0) + 40 * np.cos(v / 13.0 + u / 31.0)
    return np.repeat(waves[..., None], 3, axis=2).astype(np.uint8)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    config = RenderConfig(
        "office", frames=3, width=160, height=120, people=6, true_depth=True, normals=True, seed=4
    )
    return render_sequence(config, tmp_path_factory.mktemp("render") / "office")


def _truth(folder: Path) -> np.ndarray:
    rows = np.loadtxt(folder / "groundtruth.txt")
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3] = rotation_from_quaternion(rows[:, 4:])
    T[:, :3, 3] = rows[:, 1:4]
    return T


def test_depth_is_z_depth_and_pixels_are_right_and_down() -> None:
    picture = _smooth_picture()
    view = _one_quad(picture).render(np.eye(4))
    np.testing.assert_allclose(view.depth_m, 2.0, atol=1e-6)
    np.testing.assert_allclose(
        view.normals, np.broadcast_to([0, 0, -1.0], (120, 160, 3)), atol=1e-6
    )
    assert (view.instances == 7).all()
    # Pixel (u, v) sees x = (u - cx) z / fx of the wall, which is texel (x + 2) * 100 - 0.5.
    u, v = 101, 33
    x, y = (u - 79.5) * 2 / 131.25, (v - 59.5) * 2 / 131.25
    around = cv2.GaussianBlur(picture[..., 0].astype(np.float32), (0, 0), 0.7)
    expected = cv2.getRectSubPix(around, (1, 1), ((x + 2) * 100 - 0.5, (y + 1.5) * 100 - 0.5))
    assert view.rgb[v, u, 0] == pytest.approx(float(expected[0, 0]), abs=2.0)


def test_a_turned_camera_sees_depth_along_its_own_axis() -> None:
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = so3_exp(np.array([0, 0.3, 0]))
    T_world_camera[:3, 3] = 0.1, -0.2, 0.4
    view = _one_quad(_smooth_picture()).render(T_world_camera)
    v, u = np.mgrid[:120, :160].astype(float)
    points = CAMERA.backproject(np.stack([u, v], -1), view.depth_m.astype(float))
    world = transform(T_world_camera, points.reshape(-1, 3))
    hit = np.isfinite(world[:, 2])
    assert hit.mean() > 0.6
    np.testing.assert_allclose(world[hit, 2], 2.0, atol=1e-5)


def test_the_picture_moves_with_the_camera_to_a_fraction_of_a_pixel() -> None:
    renderer = _one_quad(_smooth_picture())
    still = renderer.render(np.eye(4)).rgb[..., 0]
    moved_pose = np.eye(4)
    moved_pose[0, 3] = 0.35 * 2 / 131.25  # the wall's image moves by 0.35 px to the left
    moved = renderer.render(moved_pose).rgb[..., 0]
    inner = np.s_[30:90, 40:120]
    gradient = np.gradient(still, axis=1)[inner]
    shift = -((moved - still)[inner] * gradient).sum() / (gradient**2).sum()
    assert -shift == pytest.approx(0.35, abs=0.02)


def test_nearest_surface_wins_between_static_and_moving() -> None:
    renderer = _one_quad(_smooth_picture())
    shape = quad((-0.2, -0.2, 1.0), (0.4, 0, 0), (0, 0.4, 0))
    number = np.zeros(2, int)
    for z, seen in ((0.0, 9), (1.5, 7)):
        T = np.eye(4)
        T[2, 3] = z
        body = shape.moved(T)
        near = build_geometry(body.corners, body.uvs, np.ones((2, 3)), number, number + 9)
        assert renderer.render(np.eye(4), near).instances[60, 80] == seen


def test_files_follow_the_tum_layout(sequence: Path) -> None:
    stamps = [line.split() for line in (sequence / "rgb.txt").read_text().splitlines()[2:]]
    assert [s for s, _ in stamps] == ["0.000000", "0.033333", "0.066667"]
    for stamp, name in stamps:
        assert name == f"rgb/{stamp}.png"
        rgb = cv2.imread(str(sequence / name), cv2.IMREAD_UNCHANGED)
        depth = cv2.imread(str(sequence / "depth" / f"{stamp}.png"), cv2.IMREAD_UNCHANGED)
        assert rgb.shape == (120, 160, 3) and rgb.dtype == np.uint8
        assert depth.shape == (120, 160) and depth.dtype == np.uint16
    camera = read_yaml(sequence / "camera.yaml")
    assert camera["fx"] == pytest.approx(525 / 4) and camera["cx"] == pytest.approx(79.5)
    assert camera["depth_scale"] == 5000 and camera["distortion"] == [0] * 5


def test_stored_depth_reprojects_between_frames(sequence: Path, tmp_path: Path) -> None:
    config = RenderConfig("office", frames=6, width=160, height=120, noise=False, fps=6.0)
    folder = render_sequence(config, tmp_path / "clean")
    camera, T = kinect_camera(config), _truth(folder)
    names = sorted((folder / "depth").iterdir(), key=lambda path: float(path.stem))
    first, last = (cv2.imread(str(names[k]), cv2.IMREAD_UNCHANGED) / 5000 for k in (0, 5))
    v, u = np.mgrid[:120, :160].astype(float)
    points = camera.backproject(np.stack([u, v], -1), first).reshape(-1, 3)
    points = transform(inverse(T[5]) @ T[0], points)
    uv = camera.project(points).astype(np.float32)
    inverse_depth = cv2.remap((1 / last).astype(np.float32), uv[:, :1], uv[:, 1:], cv2.INTER_LINEAR)
    inside = ((uv > 1) & (uv < [158, 118])).all(1)
    error = np.abs(1 / np.where(inside, inverse_depth[:, 0], 1) - points[:, 2])[inside]
    assert np.linalg.norm(T[5, :3, 3] - T[0, :3, 3]) > 0.05
    assert np.median(error) < 3e-4
    assert np.percentile(error, 75) < 1e-3


def test_annotations_agree_with_the_instance_pictures(sequence: Path) -> None:
    content = json.loads((sequence / "annotations.json").read_text())
    assert {c["name"]: c["id"] for c in content["categories"]} == CATEGORY_IDS
    assert len(content["images"]) == 3
    for image in content["images"]:
        ids = cv2.imread(
            str(sequence / image["file_name"].replace("rgb", "instances")), cv2.IMREAD_UNCHANGED
        )
        marks = [a for a in content["annotations"] if a["image_id"] == image["id"]]
        assert {a["instance_id"] for a in marks} == set(np.unique(ids)) - {0}
        for mark in marks:
            mask = ids == mark["instance_id"]
            counts = mark["segmentation"]["counts"]
            drawn = np.repeat(np.arange(len(counts)) % 2, counts).reshape(160, 120).T
            np.testing.assert_array_equal(drawn, mask)
            x, y, w, h = mark["bbox"]
            assert mask[y : y + h, x : x + w].sum() == mask.sum() == mark["area"]


def test_people_are_visible_and_labelled(sequence: Path) -> None:
    content = json.loads((sequence / "annotations.json").read_text())
    assert any(a["category_id"] == PERSON and a["area"] > 100 for a in content["annotations"])


def test_normals_face_the_camera(sequence: Path) -> None:
    path = sequence / "normals" / "0.000000.png"
    normals = cv2.imread(str(path))[..., ::-1].astype(float) / 127.5 - 1
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=0.03)
    v, u = np.mgrid[:120, :160].astype(float)
    rays = CAMERA.backproject(np.stack([u, v], -1), np.ones((120, 160)))
    assert ((normals * rays).sum(-1) < 0.02).all()


def test_same_configuration_gives_the_same_bytes(sequence: Path, tmp_path: Path) -> None:
    config = RenderConfig(
        "office", frames=3, width=160, height=120, people=6, true_depth=True, normals=True, seed=4
    )
    renderer._built.cache_clear()
    again = render_sequence(config, tmp_path / "again")
    files = sorted(str(p.relative_to(again)) for p in again.rglob("*") if p.is_file())
    assert files == sorted(str(p.relative_to(sequence)) for p in sequence.rglob("*") if p.is_file())
    _, different, broken = filecmp.cmpfiles(again, sequence, files, shallow=False)
    assert not different and not broken


def test_delayed_depth_is_rendered_from_a_later_pose(tmp_path: Path) -> None:
    """At 30 Hz, depth delayed by 33.3 ms equals that of the next frame; colour is unchanged."""
    config = {"frames": 3, "width": 160, "height": 120, "noise": False, "sweeping": True}
    on_time, late = (
        render_sequence(RenderConfig("office", depth_delay_ms=ms, **config), tmp_path / f"{ms:.0f}")
        for ms in (0.0, 1000 / 30)
    )
    names = sorted(p.name for p in (on_time / "rgb").iterdir())
    for now, after in pairwise(names):
        assert (on_time / "rgb" / now).read_bytes() == (late / "rgb" / now).read_bytes()
        shown = cv2.imread(str(late / "depth" / now), cv2.IMREAD_UNCHANGED).astype(int)
        expected = cv2.imread(str(on_time / "depth" / after), cv2.IMREAD_UNCHANGED)
        assert np.abs(shown - expected).max() <= 1


def test_depth_noise_follows_the_model() -> None:
    rng = np.random.default_rng(0)
    normals = np.broadcast_to(np.float32([0, 0, -1]), (480, 640, 3))
    for z in (0.8, 1.5, 2.5, 4.0):
        measured = measure_depth(np.full((480, 640), z, np.float32), normals, KINECT, rng)
        step = z**2 / 40 / 8
        expected = np.hypot(depth_sigma_m(np.array(z)), step / np.sqrt(12))
        assert np.isfinite(measured).mean() > 0.99
        error = measured[np.isfinite(measured)] - z
        assert error.std() == pytest.approx(float(expected), rel=0.25)
        assert abs(error.mean()) < 0.35 * step
        disparity = 8 * 40 / measured[np.isfinite(measured)]
        np.testing.assert_allclose(disparity, np.round(disparity), atol=1e-3)


def test_holes_lie_out_of_range_at_grazing_angles_and_left_of_near_things() -> None:
    rng = np.random.default_rng(1)
    frontal = np.broadcast_to(np.float32([0, 0, -1]), (480, 640, 3))
    depth = np.full((480, 640), 3.0, np.float32)
    depth[100:300, 200:400] = 1.0
    depth[400:420] = 0.45
    depth[440:460] = 5.2
    measured = measure_depth(depth, frontal, KINECT, rng)
    assert np.isnan(measured[401:419]).all() and np.isnan(measured[441:459]).all()
    # The shadow is 40 (1/1 - 1/3) = 26.7 px wide, on the left of the near box only.
    assert np.isnan(measured[150:250, 176:199]).all()
    assert np.isfinite(measured[150:250, 406:430]).mean() > 0.98
    assert np.isfinite(measured[150:250, 100:170]).mean() > 0.98
    grazing = np.broadcast_to(np.float32([1.0, 0, 0]), (480, 640, 3))
    flat = measure_depth(np.full((480, 640), 2.0, np.float32), grazing, KINECT, rng)
    assert np.isnan(flat[:, 300:340]).mean() > 0.99


def test_blur_spreads_along_the_motion_only() -> None:
    rgb = np.zeros((120, 160, 3), np.float32)
    rgb[60, 80] = 255
    T_b_a = np.eye(4)
    T_b_a[0, 3] = 0.06
    flow = optical_flow(np.full((120, 160), 1.0, np.float32), CAMERA, T_b_a)
    np.testing.assert_allclose(flow[..., 0], 0.06 * 131.25, atol=1e-4)
    np.testing.assert_allclose(flow[..., 1], 0, atol=1e-6)
    smeared = blur(rgb, flow)
    assert smeared[60].sum() == pytest.approx(3 * 255, rel=1e-3)
    assert (smeared[60, 77:84, 0] > 10).sum() >= 5 and smeared[59].max() < 1e-3


def test_look_at_is_x_right_y_down_z_forward() -> None:
    T = look_at(np.array([[1.0, 2, 1.5]]), np.array([[1.0, 5, 1.5]]))[0]
    np.testing.assert_allclose(T[:3, :3].T, [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12)


@pytest.mark.parametrize("plan", [office, living_room, corridor])
def test_camera_moves_like_a_person(plan: object) -> None:
    path: CameraPath = plan.PATH  # type: ignore[attr-defined]
    T = camera_poses(path, 30.0, seed=0)
    speed = 30 * np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    turn = 30 * np.linalg.norm(so3_log(np.swapaxes(T[:-1, :3, :3], 1, 2) @ T[1:, :3, :3]), axis=1)
    assert speed.max() < 0.7 and 0.25 < np.median(speed) < 0.55
    assert np.rad2deg(turn).max() < 40
    np.testing.assert_allclose(T[:, :3, :3] @ np.swapaxes(T[:, :3, :3], 1, 2), np.tile(np.eye(3), (len(T), 1, 1)), atol=1e-9)  # fmt: skip  # noqa: E501


def test_a_chair_is_pulled_for_a_while_and_the_box_is_held_in_both_hands() -> None:
    role = Role("walk", ((0, 0), (3, 0), (3, 2), (0, 2)), carries="box", pulls=True)
    person = Person(role, phase=0.0, scale=1.0)
    begin_s, end_s = PULLED_S
    chair = [person.bones(t)["pulled"] for t in (0.0, begin_s, end_s, end_s + 3)]
    np.testing.assert_array_equal(chair[0], chair[1])
    np.testing.assert_array_equal(chair[2], chair[3])
    assert np.linalg.norm(chair[2][:3, 3] - chair[1][:3, 3]) > 0.8
    assert chair[1][2, 3] == chair[2][2, 3] == 0
    bones = person.bones(1.0)
    left, right = (bones[f"{side} grip"][:3, 3] for side in ("left", "right"))
    assert 0.3 < np.linalg.norm(left - right) < 0.5
    assert abs(left[2] - right[2]) < 0.01


def test_the_box_is_an_instance_without_annotation(tmp_path: Path) -> None:
    config = RenderConfig(
        "busy_office", frames=1, people=1, carry=True, width=160, height=120, noise=False
    )
    folder = render_sequence(config, tmp_path / "out")
    marks = json.loads((folder / "annotations.json").read_text())["annotations"]
    drawn = set(np.unique(cv2.imread(str(folder / "instances/0.000000.png"), -1)).tolist())
    (box,) = drawn - {0} - {mark["instance_id"] for mark in marks}
    assert box == min(m["instance_id"] for m in marks if m["category_id"] == PERSON) - 2


def test_corridor_is_thirty_metres_and_ends_where_it_began() -> None:
    T = camera_poses(corridor.PATH, 30.0, seed=0)
    assert np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1).sum() == pytest.approx(30, abs=1.0)
    assert np.linalg.norm(T[-1, :3, 3] - T[0, :3, 3]) < 0.9
    assert np.rad2deg(np.linalg.norm(so3_log(T[0, :3, :3].T @ T[-1, :3, :3]))) < 20


def test_every_round_of_the_corridor_is_the_same() -> None:
    one, three = corridor.path(), corridor.path(3)
    length_m = (len(one.eyes_world) - 1) / (len(three.eyes_world) - 1)
    assert length_m == pytest.approx(1 / 3, abs=0.01)
    T = camera_poses(three, 10.0, seed=0)[:, :3, 3]
    apart = np.linalg.norm(T[:, None] - T[None, :], axis=2)
    later = np.abs(np.subtract.outer(np.arange(len(T)), np.arange(len(T)))) > len(T) // 6
    first_end = int(np.argmin(np.linalg.norm(T[200:700] - T[0], axis=1))) + 200
    nearest_later = np.where(later, apart, np.inf).min(axis=1)
    assert first_end == pytest.approx(len(T) / 3, rel=0.05)
    assert nearest_later.max() < 0.06  # half a step, and the hand's tremor


def test_a_walker_keeps_feet_on_the_floor_and_looks_ahead() -> None:
    person = Person(Role("walk", ((0, 0), (3, 0), (3, 2), (0, 2))), phase=0.0, scale=1.0)
    before, now = person.bones(0.4), person.bones(0.5)
    moved = now["torso"][:3, 3] - before["torso"][:3, 3]
    assert np.linalg.norm(moved[:2]) == pytest.approx(0.08, rel=0.15)
    forward = -now["torso"][:3, 1]
    assert forward[:2] @ moved[:2] / np.linalg.norm(moved[:2]) > 0.95
    for time_s in np.linspace(0, 2, 9):
        ankles = [person.bones(time_s)[f"{side} foot"][2, 3] for side in ("left", "right")]
        assert min(ankles) == pytest.approx(0.07, abs=1e-6)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"name": "castle"}, "office, living_room, corridor"),
        ({"frames": 0}, "frames=0"),
        ({"frames": 10**6}, "has"),
        ({"people": 99}, "people=99"),
        ({"rounds": 0}, "rounds=0"),
        ({"rounds": 2}, "rounds=2.*only corridor"),
        ({"carry": True}, "nobody"),
        ({"fps": 0.0}, "fps=0"),
        ({"width": 2}, "2x120"),
    ],
)
def test_bad_configurations_are_refused(changes: dict, text: str, tmp_path: Path) -> None:
    config = RenderConfig(**{"name": "office", "width": 160, "height": 120, "frames": 1} | changes)
    with pytest.raises(InputError, match=text):
        render_sequence(config, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_in_use_is_refused(tmp_path: Path) -> None:
    (tmp_path / "note.txt").write_text("mine")
    with pytest.raises(InputError, match="not empty"):
        render_sequence(RenderConfig("office", frames=1), tmp_path)
    with pytest.raises(InputError, match="not a folder"):
        render_sequence(RenderConfig("office", frames=1), tmp_path / "note.txt")
    with pytest.raises(InputError, match="cannot be written"):
        render_sequence(RenderConfig("office", frames=1), tmp_path / "note.txt" / "out")
    assert [p.name for p in tmp_path.iterdir()] == ["note.txt"]


def test_scenes_are_listed_without_open3d() -> None:
    assert set(SCENES) == {
        "office",
        "busy_office",
        "crowded_office",
        "living_room",
        "corridor",
        "building",
        "room",
    }
    code = "import sys, bmask_slam.rendering.sequence; assert 'open3d' not in sys.modules"
    root = ROOT
    subprocess.run([sys.executable, "-c", code], cwd=root, check=True)


@pytest.mark.parametrize("ms", [-20.0, 20.0])
def test_each_row_of_a_rolling_shutter_is_seen_from_its_own_pose(tmp_path: Path, ms: float) -> None:
    """A row of 120 is exposed ms (row - 59.5) / 120 after the middle, in colour and depth."""
    config = RenderConfig("office", 31, width=160, height=120, noise=False, sweeping=True)
    rolled = render_sequence(replace(config, rolling_shutter_ms=ms), tmp_path / "rolled")
    for row in (60, 5, 114):
        later_ms = ms * ((row + 0.5) / 120 - 0.5)
        then = render_sequence(replace(config, depth_delay_ms=later_ms), tmp_path / f"{row}")
        shown, own, middle = (
            cv2.imread(str(tmp_path / name / "depth/1.000000.png"), cv2.IMREAD_UNCHANGED)
            for name in ("rolled", f"{row}", "60")
        )
        assert np.abs(shown[row].astype(int) - own[row]).max() <= 1
        assert row == 60 or np.abs(shown[row].astype(int) - middle[row]).max() > 10
    colours = [cv2.imread(str(folder / "rgb/1.000000.png"))[60] for folder in (rolled, then)]
    assert np.abs(colours[0].astype(int) - colours[1]).mean() < 1


def test_the_working_directory_is_no_new_folder(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"^\.: has no name; choose a new folder"):
        render_sequence(RenderConfig("office", 1), Path())
