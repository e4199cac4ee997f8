"""The pinhole, its lens distortion and its pseudo-stereo: axes, signs and units."""

import dataclasses

import cv2
import numpy as np
import pytest

from bmask_slam.graph.camera import (
    SIDES,
    Camera,
    DepthNoise,
    direction_of,
    side_towards,
)
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.lens import distort_normalised, distortion_terms

CAMERA = Camera(640, 480, fx=525.0, fy=510.0, cx=318.5, cy=241.5, stereo_bf_px_m=40.0)
FREIBURG1 = Camera(
    640,
    480,
    517.306408,
    516.469215,
    318.643040,
    255.313989,
    distortion=(0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
)
LENS = np.array(FREIBURG1.distortion)
RNG = np.random.default_rng(5)
POINTS = RNG.uniform([-1.0, -0.8, 0.5], [1.0, 0.8, 6.0], (40, 3))


def test_axes_are_right_down_forward() -> None:
    np.testing.assert_array_equal(CAMERA.project(np.array([0.0, 0.0, 2.0])), [318.5, 241.5])
    right = CAMERA.project(np.array([1.0, 0.0, 2.0]))
    np.testing.assert_allclose(right, [318.5 + 262.5, 241.5])
    down = CAMERA.project(np.array([0.0, 1.0, 2.0]))
    np.testing.assert_allclose(down, [318.5, 241.5 + 255.0])


def test_projection_equals_that_by_K() -> None:
    homogeneous = (CAMERA.K @ POINTS.T).T
    np.testing.assert_allclose(
        CAMERA.project(POINTS), homogeneous[:, :2] / homogeneous[:, 2:], rtol=1e-12
    )


@pytest.mark.parametrize("shape", [(3,), (40, 3), (4, 10, 3)])
def test_backprojection_inverts_projection(shape: tuple[int, ...]) -> None:
    points = POINTS.reshape(-1)[: np.prod(shape)].reshape(shape)
    pixels = CAMERA.project(points)
    assert pixels.shape == (*shape[:-1], 2)
    np.testing.assert_allclose(CAMERA.backproject(pixels, points[..., 2]), points, atol=1e-12)


def test_backprojection_of_a_plane_needs_one_depth() -> None:
    points = CAMERA.backproject(CAMERA.project(POINTS), np.array(2.0))
    np.testing.assert_array_equal(points[:, 2], 2.0)


def test_the_right_image_lies_to_the_left_by_bf_over_z() -> None:
    z = CAMERA.project_stereo(POINTS)
    np.testing.assert_array_equal(z[:, :2], CAMERA.project(POINTS))
    np.testing.assert_allclose(z[:, 0] - z[:, 2], 40.0 / POINTS[:, 2], rtol=1e-12)
    near, far = CAMERA.project_stereo(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 4.0]]))
    assert near[2] == pytest.approx(318.5 - 40.0)
    assert far[2] == pytest.approx(318.5 - 10.0)


def test_the_right_camera_is_a_baseline_to_the_right() -> None:
    shifted = CAMERA.project(POINTS - [CAMERA.baseline_m, 0.0, 0.0])
    np.testing.assert_allclose(CAMERA.project_stereo(POINTS)[:, 2], shifted[:, 0], rtol=1e-12)
    assert CAMERA.baseline_m == pytest.approx(40.0 / 525.0)


def test_distortion_equals_opencvs_to_the_last_bit() -> None:
    points = RNG.uniform([-2.0, -1.5, 1.0], [2.0, 1.5, 6.0], (1000, 3))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), FREIBURG1.K, LENS)
    np.testing.assert_array_equal(FREIBURG1.project_distorted(points), expected[:, 0])
    rows, columns = np.mgrid[:480, :640]
    distorted = FREIBURG1.distort(np.stack([columns, rows], axis=-1)).astype(np.float32)
    maps = cv2.initUndistortRectifyMap(
        FREIBURG1.K, LENS, None, FREIBURG1.K, (640, 480), cv2.CV_32FC1
    )
    np.testing.assert_array_equal(distorted, np.stack(maps, axis=-1))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_undistortion_equals_opencvs_to_the_last_bit(dtype: type) -> None:
    """Far outside the image too, where the lens model folds back."""
    pixels = RNG.uniform([-600, -600], [1300, 1100], (2000, 2)).astype(dtype)
    expected = cv2.undistortPoints(pixels[:, None], FREIBURG1.K, LENS, P=FREIBURG1.K)[:, 0]
    undistorted = FREIBURG1.undistort(pixels)
    assert undistorted.dtype == dtype
    np.testing.assert_array_equal(undistorted, expected)


def test_undistortion_inverts_distortion() -> None:
    grid = np.stack(np.meshgrid(np.linspace(30, 610, 15), np.linspace(30, 450, 12)), axis=-1)
    raw = FREIBURG1.distort(grid)
    assert np.abs(raw - grid).max() > 5.0
    np.testing.assert_allclose(FREIBURG1.undistort(raw), grid, atol=0.05)
    points = FREIBURG1.backproject(grid.reshape(-1, 2), np.array(2.0))
    np.testing.assert_allclose(
        FREIBURG1.project_distorted(points), raw.reshape(-1, 2), rtol=0, atol=1e-9
    )


def test_without_distortion_pixels_are_copied() -> None:
    pixels = RNG.uniform(0, 400, (5, 2))
    same = CAMERA.undistort(pixels)
    np.testing.assert_array_equal(same, pixels)
    same[0] = -1
    assert (pixels >= 0).all()
    assert FREIBURG1.undistort(np.zeros((0, 2))).shape == (0, 2)
    assert FREIBURG1.project_distorted(np.zeros((0, 3))).shape == (0, 2)


def test_distortion_is_linear_in_its_coefficients() -> None:
    normalised = RNG.uniform(-0.6, 0.6, (50, 2))
    linear = normalised + distortion_terms(normalised) @ LENS
    np.testing.assert_allclose(linear, distort_normalised(normalised, LENS), rtol=1e-12)


# --- noise of depth -------------------------------------------------------------------------------


def test_noise_in_metres() -> None:
    noise = DepthNoise(0.001, 0.002, 0.003)
    np.testing.assert_allclose(noise.depth_sigma_m(np.array([1.0, 2.0])), [0.006, 0.017])
    assert noise.depth_sigma_m(np.ones(2, np.float32)).dtype == np.float32


def test_noise_of_inverse_depth_is_that_of_samples() -> None:
    noise, depth_m = DepthNoise(0.001, 0.002, 0.003), np.array([0.5, 2.0, 4.0])
    sampled = depth_m + 0.1 * noise.depth_sigma_m(depth_m) * RNG.standard_normal((20000, 3))
    found = (1 / sampled).std(axis=0) / 0.1
    np.testing.assert_allclose(noise.inverse_depth_sigma(1 / depth_m), found, rtol=0.02)


def test_a_constant_error_of_the_disparity_grows_with_the_square_of_depth() -> None:
    noise = DepthNoise.of_disparity(0.08, 40.0)
    np.testing.assert_allclose(noise.depth_sigma_m(np.array([1.0, 3.0])), [0.002, 0.018])
    np.testing.assert_allclose(40.0 * noise.inverse_depth_sigma(1 / np.array([1.0, 3.0])), 0.08)


def test_the_noise_set_by_hand_wins_over_the_sensors_and_that_over_a_kinects() -> None:
    own = DepthNoise(0.01)
    camera = dataclasses.replace(CAMERA, depth_noise=own)
    assert camera.noise_of_depth() == own
    assert camera.noise_of_depth(0.2) == DepthNoise(c_per_m=0.2 / 40.0)
    assert CAMERA.noise_of_depth() == DepthNoise(c_per_m=0.08 / 40.0)


@pytest.mark.parametrize("turns", [0, 1, 2, 3, 5])
def test_a_turned_camera_sees_the_turned_image(turns: int) -> None:
    turned, T_camera_turned = FREIBURG1.turned(turns)
    ahead = POINTS * [0.2, 0.2, 1.0]
    expected = FREIBURG1.project_distorted(ahead)
    size = np.array([FREIBURG1.width, FREIBURG1.height])
    for _ in range(turns):
        expected = np.stack([expected[:, 1], size[0] - 1 - expected[:, 0]], axis=1)
        size = size[::-1]
    assert (turned.width, turned.height) == tuple(size)
    found = turned.project_distorted(ahead @ T_camera_turned[:3, :3])
    np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.parametrize("side", SIDES)
def test_turned_by_its_side_a_camera_has_up_at_the_top(side: str) -> None:
    _, T_camera_turned = CAMERA.turned(SIDES.index(side))
    assert (direction_of(side) @ T_camera_turned[:3, :3]).tolist() == [0, -1, 0]
    assert side_towards(direction_of(side) + np.array([0.5, 0.4, -2.0])) == side
    assert (
        dataclasses.replace(CAMERA, up="above").fault()
        == "up 'above', which is no side of an image"
    )


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"fx": -500.0}, "focal length.* of -500, which is not positive"),
        ({"fy": 0.0}, "focal length.* of 0, which is not positive"),
        ({"depth_scale": 0.0}, "depth scale.* not positive"),
        ({"cx": np.nan}, "not finite"),
        ({"width": 0}, "an image of 0 x 480 pixels"),
        ({"distortion": (0.1,) * 8}, "8 values of distortion; give .k1, k2, p1, p2, k3. of OpenCV"),
        ({"distortion": ()}, "0 values of distortion"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(changed: dict[str, object], words: str) -> None:
    with pytest.raises(InputError, match=words):
        dataclasses.replace(CAMERA, **changed)


@pytest.mark.parametrize("four", [(0.1, -0.2, 0.01, 0.02), np.array([[0.1, -0.2, 0.01, 0.02]])])
def test_four_values_of_distortion_are_five_with_the_last_0(four: object) -> None:
    camera = dataclasses.replace(CAMERA, distortion=four)
    assert camera == dataclasses.replace(CAMERA, distortion=(0.1, -0.2, 0.01, 0.02, 0.0))
    expected, _ = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), camera.K, np.ravel(four))
    np.testing.assert_allclose(camera.project_distorted(POINTS), expected[:, 0], rtol=1e-12)
