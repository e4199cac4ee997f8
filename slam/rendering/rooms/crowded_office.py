"""The busy office with people who walk close in front of the camera and hide much of the view."""

from __future__ import annotations

from bmask_slam.rendering.rooms import busy_office
from bmask_slam.rendering.things.people import Role

LIGHTING = busy_office.LIGHTING
PATH = busy_office.PATH
furnish = busy_office.furnish


def _in_step(right_m: float, ahead_m: float) -> Role:
    """A person at a constant place in front of the camera, to within 5 cm."""
    sway = ((0.05, 0.0), (0.0, 0.04), (-0.05, 0.0), (0.0, -0.04))
    places = tuple((right_m + x, ahead_m + y) for x, y in sway)
    return Role("walk", places, speed_m_s=0.05, patched=True, escorts=True)


ROLES = (_in_step(0.0, 0.95), _in_step(-0.45, 1.5), *busy_office.ROLES[2:])
"""The first two walk along with the camera, like guides; the others walk in their lanes behind."""
