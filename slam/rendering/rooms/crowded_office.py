"""The busy office with people who keep step with the camera, so close that much is hidden."""

from __future__ import annotations

from bmask_slam.rendering.rooms import busy_office
from bmask_slam.rendering.things.people import Role

LIGHTING = busy_office.LIGHTING
PATH = busy_office.PATH
furnish = busy_office.furnish


def _in_step(right_m: float, ahead_m: float) -> Role:
    """Somebody who keeps a place before the camera to within a hand's breadth."""
    sway = ((0.05, 0.0), (0.0, 0.04), (-0.05, 0.0), (0.0, -0.04))
    places = tuple((right_m + x, ahead_m + y) for x, y in sway)
    return Role("walk", places, speed_m_s=0.05, patched=True, escorts=True)


ROLES = (_in_step(0.0, 0.95), _in_step(-0.45, 1.5), *busy_office.ROLES[2:])
"""The first two walk along with the camera, as who shows it around does; the others walk in their
lanes behind."""
