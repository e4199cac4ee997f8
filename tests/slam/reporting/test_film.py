"""The film of a run: what is in its pictures, and that it can be played."""

from __future__ import annotations

import resource
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from fake_run import FakeSystem, make_sequence
from PIL import Image

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import make_pose
from bmask_slam.offline import runner
from bmask_slam.offline.options import RunOptions
from bmask_slam.reporting.film import GAP_PX, STRIP_PX, FilmOptions, write_film
from bmask_slam.reporting.film_cloud import (
    DEPTH_STEP_PX,
    Shot,
    keyframe_stamps,
    make_cloud,
    path_breaks,
    sampled_points,
)
from bmask_slam.reporting.film_view import BACKGROUND, MapPicture, make_view
from bmask_slam.run_folder.origin import find_sequence
from bmask_slam.run_folder.reader import Run
from bmask_slam.sequences.cameras import read_camera, write_camera

CAMERA = Camera(64, 48, 60, 60, 31.5, 23.5)
UP = np.array([0.0, -1.0, 0.0])


def shot(number: int, depth_m: np.ndarray, position: tuple[float, float, float]) -> Shot:
    """A camera that looks along z; its image is red left of the middle and green right of it."""
    image = np.zeros((48, 64, 3), np.uint8)
    image[:, :32, 0] = image[:, 32:, 1] = 200
    T = make_pose(np.eye(3), np.array(position))
    points, colours = sampled_points(image, depth_m, CAMERA)
    small = depth_m[::DEPTH_STEP_PX, ::DEPTH_STEP_PX]
    points = (points + T[:3, 3]).astype(np.float32)
    return Shot(number, number / 10, image, small, T, points, colours)


def wall(z_m: float) -> np.ndarray:
    return np.full((48, 64), z_m, np.float32)


def test_points_appear_with_the_first_shot_that_sees_them_and_what_leaves_is_left_out() -> None:
    person = wall(2.0)
    person[16:32, 24:40] = 1.0
    shots = [shot(0, person, (0, 0, 0)), *(shot(k, wall(2.0), (0, 0, 0)) for k in (1, 2))]
    shots += [shot(3 + k, wall(2.0), (1.5, 0, 0)) for k in range(2)]  # the other end of the wall
    cloud = make_cloud(shots, CAMERA, Path("no dense map"))
    assert np.abs(cloud.points_world[:, 2] - 2.0).max() < 0.03, "the person is gone"
    x_m = cloud.points_world[:, 0]
    assert set(cloud.first[x_m > 1.2].tolist()) == {3}
    behind = (np.abs(x_m) < 0.15) & (np.abs(cloud.points_world[:, 1]) < 0.15)
    assert set(cloud.first[behind].tolist()) == {1}, "the wall behind the person, when it had left"


def test_the_view_shows_left_and_right_and_grows() -> None:
    shots = [shot(k, wall(2.0), (0, 0, 0)) for k in range(2)]
    shots += [shot(2 + k, wall(2.0), (1.5, 0, 0)) for k in range(2)]
    cloud = make_cloud(shots, CAMERA, Path("no dense map"))
    poses = np.stack([s.T_world_camera for s in shots])
    view = make_view(cloud, poses, UP, (80, 60))
    drawn = [MapPicture(view, 0.0, k).image for k in (1, 4)]
    few, all_of_it = ((image != BACKGROUND).any(axis=2).sum() for image in drawn)
    assert 0 < few < all_of_it
    picture = MapPicture(view, 0.0, 4)
    (left, right, above), ahead = picture.place(np.array([[0, 0, 2.0], [1, 0, 2], [0, -0.5, 2]]))
    assert ahead.all()
    assert left[0] < right[0]
    assert above[1] < left[1], "up in the world is up in the picture"
    inside = picture.place(poses[:, :3, 3])[0]
    assert (inside >= 0).all() and (inside < [80, 60]).all(), "the cameras are in the picture"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("film")
    options = RunOptions(make_sequence(folder / "seq"), out=folder / "run", quiet=True)
    path = runner.run(options, FakeSystem).folder
    (path / "graph").unlink()  # the fake one is none; without it the camera is the sequence's
    return path


def test_a_gif_loops_and_has_the_same_bytes_again(run: Path, tmp_path: Path) -> None:
    options = FilmOptions(run, seconds=1, fps_hz=5, width_px=200)
    path = write_film(options)
    assert path == run / "film.gif"
    with Image.open(path) as film:
        assert (film.n_frames, film.info["loop"], film.width) == (5, 0, 200)
    again = write_film(replace(options, out=tmp_path / "again.gif"))
    assert again.read_bytes() == path.read_bytes()


def test_a_run_that_was_localised_in_a_map_has_a_film_without_keyframes(
    run: Path, tmp_path: Path
) -> None:
    localised = shutil.copytree(run, tmp_path / "run")
    (localised / "keyframes.txt").write_text("# timestamp_s tx ty tz qx qy qz qw\n")
    table = [line.split(",") for line in (run / "frames.csv").read_text().splitlines()]
    at = table[0].index("keyframe")
    rows = [table[0], *([*row[:at], "", *row[at + 1 :]] for row in table[1:])]
    (localised / "frames.csv").write_text("".join(",".join(row) + "\n" for row in rows))
    film = write_film(FilmOptions(localised, tmp_path / "f.gif", None, 1, 5, 200))
    assert film.stat().st_size > 1000


def test_frames_of_a_camera_that_is_mounted_sideways_are_upright(run: Path, tmp_path: Path) -> None:
    """The left half of the film is the frame, turned so that its left side is up."""
    camera, pictures = read_camera(find_sequence(run) / "camera.yaml"), []
    for side in ("top", "left"):
        mounted = tmp_path / side
        shutil.copytree(find_sequence(run), mounted)
        write_camera(mounted / "camera.yaml", replace(camera, up=side))
        for file in (mounted / "rgb").iterdir():
            image = np.full((camera.height, camera.width, 3), 40, np.uint8)
            image[: camera.height // 3, : camera.width // 2] = (0, 200, 255)
            cv2.imwrite(str(file), image)
        path = write_film(FilmOptions(run, tmp_path / f"{side}.gif", mounted, 1, 5, 200))
        with Image.open(path) as film:
            pictures.append(np.asarray(film.convert("RGB"), float))
    width = (200 - GAP_PX) // 4 * 2
    plain, again = (picture[:-STRIP_PX, :width] for picture in pictures)
    assert len(again) == round(width * camera.width / camera.height / 2) * 2
    expected = cv2.resize(np.rot90(plain, 3), (width, len(again)))
    off, upside_down = (np.abs(again - e).mean() for e in (expected, expected[::-1, ::-1]))
    assert off < 0.5 * upside_down


def test_the_path_breaks_at_losses_and_culled_keyframes_do_not_count(
    run: Path, tmp_path: Path
) -> None:
    lossy = shutil.copytree(run, tmp_path / "run")
    whole = Run(run)
    stamps_s = whole.trajectory.timestamps_s
    shots = [replace(shot(k, wall(2.0), (0, 0, 0)), timestamp_s=stamps_s[k]) for k in (6, 8, 11)]
    assert path_breaks(whole, shots).tolist() == []
    assert len(keyframe_stamps(whole)) == len(whole.keyframes.ids) > 1
    for name, left_out in (("trajectory.txt", (9, 10)), ("keyframes.txt", (1,))):
        lines = (run / name).read_text().splitlines(keepends=True)
        head = [line for line in lines if line.startswith("#")]
        rows = [line for line in lines if not line.startswith("#")]
        kept = [row for k, row in enumerate(rows) if k not in left_out]
        (lossy / name).write_text("".join([*head, *kept]))
    assert path_breaks(Run(lossy), shots).tolist() == [2]
    assert len(keyframe_stamps(Run(lossy))) == len(whole.keyframes.ids) - 1
    (lossy / "keyframes.txt").unlink()
    assert len(keyframe_stamps(Run(lossy))) == len(whole.keyframes.ids)
    assert write_film(FilmOptions(lossy, tmp_path / "f.gif", None, 1, 5, 200)).is_file()


def test_the_parts_of_a_path_are_not_joined() -> None:
    shots = [shot(k, wall(2.0), (0.5 * k, 0, 0)) for k in range(4)]
    cloud = make_cloud(shots, CAMERA, Path("no dense map"))
    path = np.array([[0.0, 0, 1], [0.3, 0, 1], [1.2, 0, 1], [1.5, 0, 1]])
    poses = np.stack([s.T_world_camera for s in shots])
    view = make_view(cloud, poses, UP, (80, 60))
    drawn = [MapPicture(view, 0.0, 0) for _ in range(2)]
    for picture, breaks in zip(drawn, ([], [2, 9]), strict=True):
        picture.lines(np.split(path, breaks), (0, 0, 255), 2)
    column, row = np.rint(drawn[0].place(path[1:3].mean(axis=0)[None])[0][0]).astype(int)
    one, two = (picture.image[row, column].tolist() for picture in drawn)
    assert one == [0, 0, 255] and two == list(BACKGROUND)


def test_an_mp4_has_its_pictures_and_its_end(run: Path, tmp_path: Path) -> None:
    path = write_film(FilmOptions(run, tmp_path / "film.mp4", None, 1, 5, 200))
    assert cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_COUNT) == 5 + 2 * 5


def test_an_mp4_that_finds_no_space_is_refused_and_the_old_one_stays(
    run: Path, tmp_path: Path
) -> None:
    options = FilmOptions(run, tmp_path / "film.mp4", None, 1, 5, 200)
    before = write_film(options).read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, limits[1]))
    try:
        with pytest.raises(InputError, match=r"film\.mp4: cannot be written whole"):
            write_film(options)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert options.path.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]


def test_a_ceiling_is_shown_where_there_is_nothing_else() -> None:
    """A camera that looks straight up: all it sees is far above it."""
    shots = [shot(k, wall(2.0), (0.1 * k, 0, 0)) for k in range(3)]
    cloud = make_cloud(shots, CAMERA, Path("no dense map"))
    poses = np.stack([s.T_world_camera for s in shots])
    view = make_view(cloud, poses, np.array([0.0, 0.0, 1.0]), (80, 60))
    assert len(view.cloud.points_world) == len(cloud.points_world) > 0
    assert np.isfinite(view.pose(0.0)).all()


def test_what_makes_no_film_is_refused(run: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="unknown kind of film"):
        FilmOptions(run, tmp_path / "film.avi")
    with pytest.raises(InputError, match="1 to 120 seconds"):
        FilmOptions(run, seconds=0.0)
    with pytest.raises(InputError, match="nowhere: no such folder; give the folder of a run"):
        write_film(FilmOptions(tmp_path / "nowhere"))
    with pytest.raises(InputError, match="no such folder for the film"):
        write_film(FilmOptions(run, tmp_path / "missing" / "film.gif"))
    with pytest.raises(InputError, match="no such list"):
        write_film(FilmOptions(run, sequence=tmp_path))


def test_the_images_of_another_run_are_named(run: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    shutil.copytree(find_sequence(run), other)
    for name in ("rgb.txt", "depth.txt"):
        rows = [line.split() for line in (other / name).read_text().splitlines() if line[0] != "#"]
        (other / name).write_text("".join(f"{float(t) + 500} {file}\n" for t, file in rows))
    with pytest.raises(InputError, match=rf"{other}: {run} has poses of 0 of its frames"):
        write_film(FilmOptions(run, tmp_path / "film.gif", sequence=other))
    assert not (tmp_path / "film.gif").exists()
