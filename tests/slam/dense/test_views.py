"""Where the pictures of a dense map are taken from, and what their legends name."""

import numpy as np

from bmask_slam.dense.views import overview
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import make_pose
from bmask_slam.mapping.products.cloud import Cloud


def wall() -> Cloud:
    """A wall of 4 x 4 m, 3 m ahead of the origin, whose front is on the near side."""
    x, y = np.meshgrid(np.arange(-2.0, 2.0, 0.02), np.arange(-2.0, 2.0, 0.02))
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 3.0)]).astype(np.float32)
    normals = np.tile(np.float32([0, 0, -1]), (len(points), 1))
    ones = np.ones(len(points))
    colours = np.full((len(points), 3), 9, np.uint8)
    labels, views = ones.astype(np.uint16), ones.astype(np.uint16)
    return Cloud(points, normals, colours, ones, labels, ones, views)


def test_the_overview_shows_most_of_the_surface_from_its_front() -> None:
    camera, back = Camera(640, 480, 525.0, 525.0, 319.5, 239.5), np.diag([-1.0, 1.0, -1.0])
    front = np.eye(4)
    near = make_pose(np.eye(3), np.array([0.0, 0.0, 2.5]))
    away = make_pose(back, np.zeros(3))
    behind = make_pose(back, np.array([0.0, 0.0, 6.0]))
    for poses in ([behind, near, away, front], [front, away, near, behind]):
        chosen = overview(wall(), camera, poses)
        assert np.abs(chosen[:3, 3] - [0.0, -0.6, -1.0]).max() < 1e-9
