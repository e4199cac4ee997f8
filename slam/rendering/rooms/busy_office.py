"""The office with people who walk to and fro in front of a camera near the door."""

from __future__ import annotations

import numpy as np

from bmask_slam.rendering.engine.path import CameraPath
from bmask_slam.rendering.rooms import office
from bmask_slam.rendering.things.people import Role

LIGHTING = office.LIGHTING
furnish = office.furnish

PATH = CameraPath(
    eyes_world=np.array([
        [2.5, 0.75, 1.45], [2.9, 0.65, 1.4], [3.4, 0.8, 1.35], [3.6, 1.0, 1.4], [3.2, 0.9, 1.45],
        [2.7, 0.7, 1.4], [2.4, 0.9, 1.35], [2.7, 1.0, 1.4], [3.0, 0.8, 1.45],
    ]),
    targets_world=np.array([
        [2.4, 4.8, 1.2], [2.9, 4.8, 1.15], [3.5, 4.8, 1.1], [4.0, 4.7, 1.15], [3.4, 4.8, 1.2],
        [2.6, 4.8, 1.15], [2.0, 4.7, 1.1], [2.5, 4.8, 1.15], [3.0, 4.8, 1.2],
    ]),
    speed_m_s=0.35,
)  # fmt: skip

ROLES = (
    Role("walk", ((2.1, 1.8), (3.0, 1.75), (3.9, 1.8), (3.9, 2.1), (3.0, 2.15), (2.1, 2.1)),
         patched=True),
    Role("walk", ((4.1, 2.6), (3.0, 2.55), (1.9, 2.6), (1.9, 2.9), (3.0, 2.95), (4.1, 2.9)),
         speed_m_s=1.0, patched=True),
    Role("walk", ((1.4, 3.4), (2.1, 3.36), (2.75, 3.4), (2.75, 3.52), (2.1, 3.55), (1.4, 3.52)),
         speed_m_s=0.6, patched=True),
    Role("walk", ((4.4, 3.4), (3.8, 3.36), (3.2, 3.4), (3.2, 3.52), (3.8, 3.55), (4.4, 3.52)),
         carries="book", speed_m_s=0.7, patched=True),
)  # fmt: skip
"""Each walks in a separate lane, in a shirt with as many corners as the room."""
