"""The pose of a marker by its corners: frames, Jacobian, noise, sizes, what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from bmask_slam.config.configuration import resolve
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse, make_pose, se3_exp, se3_log
from bmask_slam.graph.sensors.markers import (
    CORNERS,
    MarkersConfig,
    SeenCorners,
    _linearised,
    fit_marker,
)
from bmask_slam.system_config import SystemConfig

SIGMA = 0.15 / 525
T_CAMERA_MARKER = make_pose(
    np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]), np.array([0.2, -0.1, 1.5])
) @ se3_exp(np.array([0.3, -0.5, 0.2, 0, 0, 0]))
"""Before the camera, looking at it; its y is up where the image's is down."""


def seen(T_camera_marker: Array, size_m: float, rng: np.random.Generator | None) -> SeenCorners:
    """The corners of a marker, drawn with their noise; exact without random numbers."""
    p = size_m * CORNERS @ T_camera_marker[:3, :3].T + T_camera_marker[:3, 3]
    noise = np.zeros((4, 3)) if rng is None else rng.standard_normal((4, 3))
    places = p[:, :2] / p[:, 2:] + SIGMA * noise[:, :2]
    sigmas = np.full(4, 0.002)
    return SeenCorners(places, SIGMA, 1 / p[:, 2] + sigmas * noise[:, 2], sigmas)


def test_the_frame_of_a_marker_is_x_right_y_up_z_to_the_viewer() -> None:
    p = CORNERS @ np.diag([1.0, -1.0, -1.0]).T + [0, 0, 2.0]  # upright, facing the camera
    assert (p[0, :2] < 0).all()  # top left in the image is the first corner
    assert p[1, 0] > 0 > p[1, 1]


def test_the_jacobian_is_that_of_finite_differences() -> None:
    corners, T, size, h = seen(T_CAMERA_MARKER, 0.2, None), inverse(T_CAMERA_MARKER), -1.5, 1e-6
    _, J = _linearised(corners, T, size)
    for k in range(7):
        step = np.eye(7)[k] * h
        ahead, behind = (
            _linearised(corners, T @ se3_exp(s * step[:6]), size + s * step[6])[0] for s in (1, -1)
        )
        np.testing.assert_allclose(J[:, k], (ahead - behind) / (2 * h), rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("known", [True, False])
def test_the_covariance_is_that_of_drawn_corners(known: bool) -> None:
    """NEES of 120 poses within its 95 % band; without a size, depth gives it."""
    rng, sigma = np.random.default_rng(5), 0.002 if known else np.inf
    truth, nees, sizes = inverse(T_CAMERA_MARKER), [], []
    for _ in range(120):
        prior = np.log(0.2) + 0.002 * rng.standard_normal()
        found = fit_marker(seen(T_CAMERA_MARKER, 0.2, rng), truth, prior, sigma)
        assert found is not None
        error = se3_log(inverse(found.T_marker_camera) @ truth)
        nees.append(error @ np.linalg.solve(found.covariance, error))
        sizes.append((found.log_size - np.log(0.2)) / found.log_size_sigma)
    assert 5.40 < np.mean(nees) < 6.64
    assert 0.85 < np.std(sizes) < 1.15


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("dictionary=TAGS", "sensors.markers.dictionary = TAGS is not one of: '4X4_50'"),
        ("size_m=-0.1", "size -0.1 m; give metres"),
        ("sizes_m=[[3, 0.1], [3, 0.2]]", "give each once"),
        ("poses=[[3, 0, 0, 0, 0, 0, 0, 0]]", "a rotation of zeros"),
        ("poses=[[3, 0, 0, 0]]", "sensors.markers.poses"),
    ],
)
def test_settings_that_no_marker_has_are_refused(setting: str, said: str) -> None:
    with pytest.raises(InputError) as raised:
        resolve(SystemConfig, None, [f"sensors.markers.{setting}"])
    assert said in str(raised.value)


def test_sizes_and_ids_of_a_configuration() -> None:
    config = MarkersConfig(size_m=0.1, sizes_m=((7, 0.2),))
    assert (config.size_of(7), config.size_of(8)) == (0.2, 0.1)
    assert config.uses(8)
    assert not MarkersConfig(sizes_m=((7, 0.2),), only_known=True).uses(8)
