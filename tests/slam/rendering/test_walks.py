"""Rounds that go along with the camera."""

from __future__ import annotations

import numpy as np

from graph.geometry import inverse
from slam.rendering import crowded_office
from slam.rendering.path import duration_s, steady_poses
from slam.rendering.walks import Escort


def test_an_escort_stays_before_the_camera_and_turns_away_from_it() -> None:
    (role,) = (role for role in crowded_office.ROLES if role.escorts)
    for phase in (0.0, 0.4):
        escort = Escort(crowded_office.PATH, role.places, role.speed_m_s, phase)
        times_s = np.arange(0.0, duration_s(crowded_office.PATH), 0.1)
        camera = steady_poses(crowded_office.PATH, times_s)
        person = np.array([escort.at(t)[0] for t in times_s])
        middle = person[:, :3, 3] + np.array([0, 0, 1.4])
        inside = (inverse(camera) @ np.c_[middle, np.ones(len(middle))][..., None])[:, :3, 0]
        assert inside[:, 2].min() > 0.8 and inside[:, 2].max() < 1.2
        assert inside[:, 0].min() < -0.35 and inside[:, 0].max() > 0.35
        forward = np.einsum("nij,nj->ni", inverse(camera)[:, :3, :3], -person[:, :3, 1])
        assert forward[:, 2].min() > -0.7 and forward[:, 2].max() > 0.9
        walked_m = np.array([escort.at(t)[1] for t in times_s])
        steps_m = np.linalg.norm(np.diff(person[:, :2, 3], axis=0), axis=1)
        np.testing.assert_allclose(np.diff(walked_m), steps_m, atol=0.01)
