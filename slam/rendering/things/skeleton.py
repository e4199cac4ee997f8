"""Poses of a person's limbs while standing, sitting, walking and carrying something.

The person's frame has its origin on the floor, z up, and looks along -y; the right hand is at
-x. Angles in the body's plane of symmetry count from straight down, forward positive.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bmask_slam.graph.arrays import Array

THIGH_M, SHIN_M, TORSO_M, UPPER_ARM_M, FOREARM_M = 0.43, 0.42, 0.50, 0.28, 0.25
_ANKLE_M = 0.07
_SEAT_M = 0.59
"""Height of the hips when sitting on a chair whose seat is at 0.5 m."""


@dataclass(frozen=True)
class Posture:
    """Joint angles in radians, (right, left) where a joint comes twice.

    Attributes:
        hips, knees: forward swing of the thighs, bend of the knees.
        shoulders, elbows: forward swing of the upper arms, bend of the elbows.
        spread: how far the elbows stand off.
        lean: forward lean of the torso.
        turn: turn of the head to the left.
        seated: whether the hips rest on a chair.
    """

    hips: tuple[float, float] = (0.0, 0.0)
    knees: tuple[float, float] = (0.05, 0.05)
    shoulders: tuple[float, float] = (0.05, 0.05)
    elbows: tuple[float, float] = (0.2, 0.2)
    spread: float = 0.12
    lean: float = 0.03
    turn: float = 0.0
    seated: bool = False


def walking(stride_rad: float, carries: bool) -> Posture:
    """Mid-step at phase ``stride_rad``; two steps make one turn of the phase."""
    swing = np.sin(stride_rad), -np.sin(stride_rad)
    lift = max(0.0, np.cos(stride_rad)), max(0.0, -np.cos(stride_rad))
    return Posture(
        hips=(0.42 * swing[0], 0.42 * swing[1]),
        knees=(0.12 + 0.75 * lift[0], 0.12 + 0.75 * lift[1]),
        shoulders=(0.1 if carries else -0.35 * swing[0], -0.35 * swing[1]),
        elbows=(0.3, 0.3 + 0.15 * max(0.0, -swing[1])),
        lean=0.06,
    )


def standing(time_s: float, phase: float) -> Posture:
    """Talking: weight shifts, one arm moves, the head looks around."""
    a = time_s + 7 * phase
    return Posture(
        hips=(0.03 * np.sin(0.7 * a), 0.05),
        shoulders=(0.25 + 0.25 * np.sin(1.9 * a), 0.05 + 0.04 * np.sin(0.9 * a)),
        elbows=(1.2 + 0.5 * np.sin(2.3 * a + 1), 0.25),
        spread=0.16,
        lean=0.03 + 0.03 * np.sin(0.8 * a),
        turn=0.5 * np.sin(0.6 * a),
    )


def sitting(time_s: float, phase: float) -> Posture:
    """At a desk, typing."""
    a = time_s + 5 * phase
    return Posture(
        hips=(1.45, 1.45),
        knees=(1.4, 1.3),
        shoulders=(0.55 + 0.03 * np.sin(6 * a), 0.55 + 0.03 * np.sin(6.7 * a)),
        elbows=(1.05, 1.05),
        lean=0.1 + 0.04 * np.sin(0.7 * a),
        turn=0.35 * np.sin(0.5 * a),
        seated=True,
    )


def holding(posture: Posture, how: str) -> Posture:
    """The same with the right arm hanging, raised to the ear, or one or both before the belly."""
    front = 0.25, 1.35
    arm = {"hang": (0.02, 0.05), "front": front, "both": front, "high": (0.75, 1.3)}[how]
    other = front if how == "both" else (posture.shoulders[1], posture.elbows[1])
    return replace(posture, shoulders=(arm[0], other[0]), elbows=(arm[1], other[1]))


def bones(posture: Posture) -> dict[str, Array]:
    """Poses T_person_bone (4, 4) by name: z along the bone from its upper joint, -y to the front.

    The torso's and head's z point up from the hips and the neck.
    """
    legs = {side: _leg(posture, k) for k, side in enumerate(("right", "left"))}
    lowest = min(leg[2][2] for leg in legs.values())
    hips = np.array([0, 0, _SEAT_M if posture.seated else _ANKLE_M - lowest])
    up = np.array([0, -np.sin(posture.lean), np.cos(posture.lean)])
    result = {"torso": _frame(hips, hips + up)}
    neck = hips + (TORSO_M + 0.06) * up
    head = _frame(neck, neck + up)
    c, s = np.cos(posture.turn), np.sin(posture.turn)
    head[:3, :3] = head[:3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    result["head"] = head
    for k, (side, sign) in enumerate((("right", -1), ("left", 1))):
        hip, knee, ankle, toe = (hips + joint for joint in legs[side])
        result[f"{side} thigh"] = _frame(hip, knee)
        result[f"{side} shin"] = _frame(knee, ankle)
        result[f"{side} foot"] = _frame(ankle, toe)
        shoulder = hips + (TORSO_M - 0.05) * up + np.array([sign * 0.185, 0, 0])
        out = np.array([sign * posture.spread, 0, 0])
        elbow = shoulder + UPPER_ARM_M * _unit(_swing(posture.shoulders[k]) + out)
        wrist = elbow + FOREARM_M * _unit(_swing(posture.shoulders[k] + posture.elbows[k]) - out)
        result[f"{side} upper arm"] = _frame(shoulder, elbow)
        result[f"{side} forearm"] = _frame(elbow, wrist)
        result[f"{side} hand"] = _frame(wrist, 2 * wrist - elbow)
        grip = np.eye(4)
        grip[:3, 3] = wrist + 0.09 * _unit(wrist - elbow)
        result[f"{side} grip"] = grip
    return result


def _leg(posture: Posture, k: int) -> tuple[Array, Array, Array, Array]:
    """Hip, knee, ankle and toe relative to the middle of the hips."""
    hip = np.array([(-0.09, 0.09)[k], 0, 0])
    knee = hip + THIGH_M * _swing(posture.hips[k])
    ankle = knee + SHIN_M * _swing(posture.hips[k] - posture.knees[k])
    toe = ankle + 0.16 * _swing(posture.hips[k] - posture.knees[k] + np.pi / 2)
    return hip, knee, ankle, toe


def _swing(angle_rad: float) -> Array:
    return np.array([0, -np.sin(angle_rad), -np.cos(angle_rad)])


def _unit(v: Array) -> Array:
    unit: Array = v / np.linalg.norm(v)
    return unit


def _frame(p: Array, q: Array) -> Array:
    """Origin p, z toward q, -y as far to the front (or, for a level bone, up) as it can be."""
    z = _unit(q - p)
    front = np.array([0, -1.0, 0]) if abs(z[1]) < 0.8 else np.array([0, 0, 1.0])
    y = -_unit(front - (front @ z) * z)
    T = np.eye(4)
    T[:3, :3] = np.stack([np.cross(y, z), y, z], axis=-1)
    T[:3, 3] = p
    return T
