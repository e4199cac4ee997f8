"""Lines of other programs' pose graphs, turned into g2o's.

=====================================  ============================================================
VERTEX2, VERTEX3                       TORO: x y angle; x y z roll pitch yaw. VERTEX3 also with a
                                       quaternion x y z w instead of the angles
EDGE2, ODOMETRY                        TORO's order of the information, xx xy yy aa xa ya, or row by
                                       row (iSAM, SLAM++): a zero on the diagonal tells the other
EDGE3                                  six or seven numbers as VERTEX3, information row by row
VERTEX_SE3, EDGE_SE3 (also :EULER)     as VERTEX3 and EDGE3
=====================================  ============================================================

Rotations are ``Rz(yaw) Ry(pitch) Rx(roll)``. An edge without information gets the identity. The
numbers are information, as TORO and GTSAM read these tags; iSAM writes its square root there.
"""

from __future__ import annotations

import math

from bmask_slam.graph.errors import InputError, finite_number

_PLANAR = {"VERTEX2": "VERTEX_SE2", "EDGE2": "EDGE_SE2", "ODOMETRY": "EDGE_SE2"}
_SPATIAL = {
    f"{kind}{end}": f"{kind}_SE3:QUAT"
    for kind in ("VERTEX", "EDGE")
    for end in ("3", "_SE3", "_SE3:EULER")
}
_TO_ROWS = (0, 1, 4, 2, 5, 3)  # of TORO's xx xy yy aa xa ya
_UNITS = {d: [str(int(r == c)) for r in range(d) for c in range(r, d)] for d in (3, 6)}


def g2o_words(words: list[str], where: str) -> list[str]:
    """The words of a line as g2o would have them; those of a tag that is not known as they are.

    Raises:
        InputError: a number of values that the tag does not have, or an angle that is no number.
    """
    tag = _PLANAR.get(words[0]) or _SPATIAL.get(words[0])
    if tag is None:
        return words
    ids = 2 if tag.startswith("EDGE") else 1
    size = 3 if tag in _PLANAR.values() else 6
    names, numbers = words[1 : 1 + ids], words[1 + ids :]
    information: list[str] = []
    if ids == 2 and len(numbers) > len(_UNITS[size]):
        information = numbers[-len(_UNITS[size]) :]
        numbers = numbers[: -len(information)]
    if len(numbers) != size and (len(numbers), size) != (7, 6):
        raise InputError(f"{where}: {len(words) - 1} values after {words[0]}; correct the line")
    if len(numbers) == 6:
        numbers = numbers[:3] + _quaternion([finite_number(word, where) for word in numbers[3:]])
    if ids == 2:
        information = information or _UNITS[size]
        if size == 3:
            information = _in_rows(information, where)
    return [tag, *names, *numbers, *information]


def _in_rows(information: list[str], where: str) -> list[str]:
    """Six numbers of TORO's order row by row; those that cannot be TORO's are so already."""
    if finite_number(information[2], where) == 0:
        return information
    return [information[k] for k in _TO_ROWS]


def _quaternion(angles_rad: list[float]) -> list[str]:
    """x y z w of roll, pitch and yaw."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a / 2), math.sin(a / 2)) for a in angles_rad)
    quaternion = (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )
    return [repr(number) for number in quaternion]
