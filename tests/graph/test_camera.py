"""The pinhole and its pseudo-stereo: axes, signs and units."""

import numpy as np
import pytest

from bmask_slam.graph.camera import Camera

CAMERA = Camera(640, 480, fx=525.0, fy=510.0, cx=318.5, cy=241.5, stereo_bf_px_m=40.0)
RNG = np.random.default_rng(5)
POINTS = RNG.uniform([-1.0, -0.8, 0.5], [1.0, 0.8, 6.0], (40, 3))


def test_axes_are_right_down_forward() -> None:
    np.testing.assert_array_equal(CAMERA.project(np.array([0.0, 0.0, 2.0])), [318.5, 241.5])
    right = CAMERA.project(np.array([1.0, 0.0, 2.0]))
    np.testing.assert_allclose(right, [318.5 + 262.5, 241.5])
    down = CAMERA.project(np.array([0.0, 1.0, 2.0]))
    np.testing.assert_allclose(down, [318.5, 241.5 + 255.0])


def test_projection_is_that_of_K() -> None:
    homogeneous = (CAMERA.K @ POINTS.T).T
    np.testing.assert_allclose(
        CAMERA.project(POINTS), homogeneous[:, :2] / homogeneous[:, 2:], rtol=1e-12
    )


@pytest.mark.parametrize("shape", [(3,), (40, 3), (4, 10, 3)])
def test_backprojection_undoes_projection(shape: tuple[int, ...]) -> None:
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


def test_the_right_image_is_seen_from_a_baseline_to_the_right() -> None:
    shifted = CAMERA.project(POINTS - [CAMERA.baseline_m, 0.0, 0.0])
    np.testing.assert_allclose(CAMERA.project_stereo(POINTS)[:, 2], shifted[:, 0], rtol=1e-12)
    assert CAMERA.baseline_m == pytest.approx(40.0 / 525.0)
