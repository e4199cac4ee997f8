"""Large images are reduced when they are read, and the camera with them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.live.sources.opening import SourceOptions, open_source, ros2_of
from bmask_slam.live.sources.source import Limited, MeasuredSource, Reduced, SourceCounts
from bmask_slam.offline.options import RunOptions
from bmask_slam.offline.runner import run
from bmask_slam.rendering.config import RenderConfig
from bmask_slam.run_folder.map_file import read_run
from bmask_slam.sequences.cameras import write_camera
from bmask_slam.sequences.frame import Frame
from bmask_slam.sequences.images import reduced_colour, reduced_depth, working_camera
from bmask_slam.sequences.sequence import open_sequence

LARGE = Camera(
    1280, 960, 1040.0, 1036.0, 641.0, 470.0, (0.1, -0.05, 0.001, 0.002, 0.0),
    rolling_shutter_s=0.02, covered=((0, 901, 1280, 960),), depth_distortion=(0.01, 0, 0.02, 0, 0),
)  # fmt: skip


def enlarged(source: Path, folder: Path, camera: Camera) -> Path:
    """A sequence in a new folder, its images made so large by repeating pixels."""
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
        for file in (source / kind).iterdir():
            image, size = cv2.imread(str(file), cv2.IMREAD_UNCHANGED), (camera.width, camera.height)
            large = cv2.resize(image, size, interpolation=cv2.INTER_NEAREST)
            cv2.imwrite(str(folder / kind / file.name), large)
        (folder / f"{kind}.txt").write_bytes((source / f"{kind}.txt").read_bytes())
    write_camera(folder / "camera.yaml", camera)
    return folder


@pytest.mark.parametrize(
    ("size", "used"),
    [
        ((640, 480), (640, 480)),
        ((848, 480), (848, 480)),
        ((1280, 720), (640, 360)),
        ((1280, 800), (640, 400)),
        ((720, 1280), (360, 640)),
        ((1920, 1080), (640, 360)),
        ((1920, 1440), (640, 480)),
        ((3840, 2160), (960, 540)),
        ((960, 540), (960, 540)),
        ((1279, 719), (1279, 719)),
    ],
)
def test_sizes(size: tuple[int, int], used: tuple[int, int]) -> None:
    camera = working_camera(Camera(*size, 900.0, 900.0, 500.0, 300.0))
    assert (camera.width, camera.height) == used
    assert camera.reduced_by == size[0] // used[0]


def test_a_camera_of_reduced_images_sees_the_same() -> None:
    camera = LARGE.reduced(2)
    points = np.array([[0.3, -0.2, 1.5], [-0.6, 0.4, 2.0]])
    for project in (Camera.project, Camera.project_distorted):
        fine, coarse = project(LARGE, points), project(camera, points)
        np.testing.assert_allclose(2 * (coarse + 0.5), fine + 0.5)  # from the image's corner
    np.testing.assert_allclose(camera.exposed_after_s(fine[:, 1] / 2 - 0.25),
                               LARGE.exposed_after_s(fine[:, 1]))  # fmt: skip
    np.testing.assert_allclose(camera.depth_bend(coarse), LARGE.depth_bend(fine))
    depth_m = np.array([1.0, 3.0])
    np.testing.assert_array_equal(
        camera.noise_of_depth().depth_sigma_m(depth_m),
        LARGE.noise_of_depth().depth_sigma_m(depth_m),
    )
    assert camera.covered == ((0, 450, 640, 480),)
    back = camera.recorded()
    assert replace(back, covered=LARGE.covered) == LARGE
    assert back.covered == ((0, 900, 1280, 960),)
    assert LARGE.recorded() is LARGE
    assert "reduced by 0" in replace(LARGE, reduced_by=0).fault()


def test_colour_is_the_mean_and_depth_that_of_the_nearest_surface() -> None:
    rgb = np.zeros((4, 4, 3), np.uint8)
    rgb[:2, :2] = [[[10, 0, 0], [20, 0, 0]], [[30, 0, 0], [40, 0, 0]]]
    assert reduced_colour(rgb, 2)[0, 0].tolist() == [25, 0, 0]
    stored = np.array([[1000, 1020, 0, 0], [2000, 0, 0, 0], [0, 7, 9, 9], [0, 0, 9, 9]], np.uint16)
    assert reduced_depth(stored, 2).tolist() == [[1010, 0], [7, 9]]
    metres = np.where(stored > 0, stored, np.nan).astype(np.float32)
    assert reduced_depth(metres, 2).tolist() == [[1010, 0], [7, 9]]
    assert reduced_colour(rgb, 1) is rgb
    assert reduced_depth(stored, 1) is stored


@pytest.fixture
def large(folder: Path, tmp_path: Path) -> Path:
    """The tiny sequence, in images of 1280 x 960."""
    camera = replace(LARGE, depth_scale=1000.0, covered=())
    return enlarged(folder, tmp_path / "large", camera)


def test_a_sequence_of_large_images(large: Path) -> None:
    sequence, whole = open_sequence(large), open_sequence(large, full_size=True)
    assert (sequence.camera.width, whole.camera.width) == (640, 1280)
    assert "1280x960, reduced to 640x480" in sequence.camera_source
    again = open_sequence(large, camera=sequence.camera)
    for one in (sequence, again):
        assert one.camera == sequence.camera
        frames = list(one.frames())
        assert len(frames) == 12
        assert frames[3].rgb.shape == (480, 640, 3)
        assert frames[3].rgb[100, 100].tolist() == [30, 20, 200]
        bend = one.camera.depth_bend(np.array([100.0, 300.0]))
        assert 1 / frames[3].depth_m[300, 100] == pytest.approx(1 / 0.4 - bend, rel=1e-5)
        assert np.isnan(frames[3].depth_m[0]).all()
    assert whole.load(3).rgb.shape == (960, 1280, 3)


def test_an_image_of_the_reduced_size_is_broken(large: Path) -> None:
    cv2.imwrite(str(large / "rgb/4.png"), np.zeros((480, 640, 3), np.uint8))
    with pytest.raises(InputError, match="640x480 pixels, but the camera has 1280x960"):
        open_sequence(large).load(4)


class LiveCamera(MeasuredSource):
    """Gives two large frames."""

    name, groundtruth, waits = "live", None, False

    def __init__(self) -> None:
        self.camera, self.counts = LARGE, SourceCounts()

    def frames(self) -> Iterator[Frame]:
        for k in range(2):
            depth_m = np.full((960, 1280), 1.0 + k, np.float32)
            depth_m[:2, :2] = np.nan
            yield Frame(k, k / 30, np.full((960, 1280, 3), 50 * k, np.uint8), depth_m)

    def close(self) -> None: ...


def test_a_live_camera_of_large_images() -> None:
    own = LiveCamera()
    source = Reduced(own)
    assert source.camera == LARGE.reduced(2)
    first, second = source.frames()
    assert first.rgb.shape == (480, 640, 3)
    assert np.isnan(first.depth_m[0, 0])
    assert float(second.depth_m[200, 200]) == 2.0
    found = replace(source.camera, depth_distortion=(0.03, 0, 0, 0, 0))
    source.use(found)
    assert own.camera.depth_distortion == found.depth_distortion
    assert (own.camera.width, source.camera) == (1280, found)
    assert ros2_of(Limited(source, 1)) is None


def test_the_command_lines_live_source_is_reduced(large: Path) -> None:
    options = SourceOptions(follow=True, silence_s=0.5)
    assert next(open_source(str(large), options).frames()).rgb.shape == (480, 640, 3)
    whole = open_source(str(large), replace(options, full_size=True))
    assert next(whole.frames()).rgb.shape == (960, 1280, 3)


def test_a_run_on_large_images(rendered: Callable[[RenderConfig], Path], tmp_path: Path) -> None:
    """Its map has the camera of the reduced images, by which what reads the run reduces them."""
    source = rendered(RenderConfig("office", frames=4, width=1280, height=960))
    for full_size, width, k in ((False, 640, 2), (True, 1280, 1)):
        out = tmp_path / f"run{k}"
        run(RunOptions(source, out=out, full_size=full_size, quiet=True))
        metrics = {m["name"]: m["value"] for m in json.loads((out / "metrics.json").read_text())}
        assert metrics["tracked_share"] == 1
        assert metrics["ate_rmse"] < 0.002
        used = read_run(out).camera
        assert (used.width, used.reduced_by) == (width, k)
        assert open_sequence(source, camera=used).load(0).rgb.shape[1] == width
    older = RunOptions(source, out=tmp_path / "on", map=tmp_path / "run1", quiet=True)
    with pytest.raises(InputError, match="give --full-size"):
        run(older)
