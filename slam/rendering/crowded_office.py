"""The busy office with one who walks to and fro so close that a fifth of the picture is hidden."""

from __future__ import annotations

from slam.rendering import busy_office
from slam.rendering.people import Role

LIGHTING = busy_office.LIGHTING
PATH = busy_office.PATH
furnish = busy_office.furnish

ROLES = (
    Role("walk", ((0.0, 0.97), (-0.25, 0.86), (-0.42, 0.96), (-0.25, 1.08), (0.0, 0.97),
                  (0.25, 0.86), (0.42, 0.96), (0.25, 1.08)),
         speed_m_s=0.46, patched=True, escorts=True),
    *busy_office.ROLES[1:],
)  # fmt: skip
"""The first goes along with the camera in an eight and turns away from it at both ends, so that
what is carried in front stays off it; the others walk in their lanes behind."""
