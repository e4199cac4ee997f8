"""People who walk with the camera."""

from __future__ import annotations

import numpy as np

from bmask_slam.graph.geometry import inverse
from bmask_slam.rendering.engine.path import duration_s, steady_poses
from bmask_slam.rendering.rooms import crowded_office
from bmask_slam.rendering.things.walks import Escort


def test_escorts_keep_their_position_before_the_camera_and_face_forward() -> None:
    escorts = [role for role in crowded_office.ROLES if role.escorts]
    assert len(escorts) == 2
    for role in escorts:
        escort = Escort(crowded_office.PATH, role.places, role.speed_m_s, phase=0.4)
        times_s = np.arange(0.0, duration_s(crowded_office.PATH), 0.1)
        camera = steady_poses(crowded_office.PATH, times_s)
        person = np.array([escort.at(t)[0] for t in times_s])
        middle = np.c_[person[:, :2, 3], camera[:, 2, 3], np.ones(len(person))]
        points_camera = (inverse(camera) @ middle[..., None])[:, :3, 0]
        assert np.ptp(points_camera[:, 0]) < 0.12 and np.ptp(points_camera[:, 2]) < 0.12
        assert 0.8 < points_camera[:, 2].min() < 1.6
        step = np.diff(person[:, :2, 3], axis=0)
        length_m = np.linalg.norm(step, axis=1)
        forward = -(person[1:, :2, 1] + person[:-1, :2, 1]) / 2
        along = np.einsum("ni,ni->n", forward, step) / np.maximum(length_m, 1e-9)
        assert np.median(along) > 0.98
        walked_m = np.array([escort.at(t)[1] for t in times_s])
        np.testing.assert_allclose(np.diff(walked_m), length_m, atol=0.01)
