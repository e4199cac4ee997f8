"""What tracking and masks say of landmarks becomes a probability of moving."""

from dataclasses import replace

import numpy as np
from synthetic_view import CAMERA, render_plane

from bmask_slam.graph.geometry import se3_exp
from bmask_slam.system import SlamSystem
from bmask_slam.tracking.results import starting


def test_landmarks_that_left_their_places_move_after_some_frames() -> None:
    """Not after one, as that frame may be wrong."""
    system = SlamSystem(CAMERA)
    for k in range(2):
        system.process(render_plane(se3_exp(np.array([0, 0, 0, 0.01 * k, 0, 0])), k))
    landmarks = system.moving_objects.landmarks
    ids = np.flatnonzero(system.map.world.landmarks.in_map)
    features = system.prepare(render_plane(np.eye(4), 2))
    tracked = replace(starting(np.eye(4), features), moving_ids=ids[:20])
    frames = 0
    while not landmarks.movability.moving(ids[:20]).all():
        landmarks.observe_frame(tracked, None)
        frames += 1
        assert frames <= 12
    assert frames >= 2
    assert not landmarks.movability.moving(ids[20:]).any()
    landmarks.remove_moving(ids)
    in_map = system.map.world.landmarks.in_map
    assert not in_map[ids[:20]].any()
    assert in_map[ids[20:]].all()
