"""The delay of depth that its edges show against those of colour: when it is said, when used.

Edges need no map of depth, so they show a delay that has bent the map, of which the motion is
wrong. What right cameras show has been measured: depth up to 21 ms from its stamps.
"""

from __future__ import annotations

import logging
from dataclasses import replace

from bmask_slam.calibration.adoption import SelfCalibration
from bmask_slam.graph.calibration.model import NORMAL_95
from bmask_slam.graph.calibration.registration import EdgeScores, Registration, register
from bmask_slam.graph.camera import Camera

logger = logging.getLogger(__name__)

MIN_STRENGTH = 6.0
"""Edges of depth and colour fit if their peak is so many sigmas above its surroundings."""
MAX_DELAY_S, SURE_DELAY_S = 0.022, 0.015
"""A delay of depth above the first, and surely above the second, is no right camera's."""
LARGE_DELAY_S = 0.035
"""A delay that is surely larger is used before the motion is asked."""


def sure_registration(scores: EdgeScores) -> Registration | None:
    """How depth lies on colour by its edges, where these say it clearly."""
    found = register(scores)
    return found if found is not None and found.strength >= MIN_STRENGTH else None


def is_wrong_delay(found: Registration) -> bool:
    """Whether the delay is surely that of no right camera."""
    surely_s = abs(found.delay_s) - NORMAL_95 * found.delay_sigma_s
    return abs(found.delay_s) > MAX_DELAY_S and surely_s > SURE_DELAY_S


def format_delay(found: Registration) -> str:
    """The delay in milliseconds with its 95 % bound."""
    bound_s, later = NORMAL_95 * found.delay_sigma_s, "later" if found.delay_s > 0 else "earlier"
    delay = f"{1e3 * abs(found.delay_s):.0f} ± {1e3 * bound_s:.0f} ms"
    return f"depth images are {delay} {later} than stamps and camera say"


def delay_warning(found: Registration | None, camera: Camera) -> str:
    """What edges of depth say against a camera's delay, with a cure; "" where they do not."""
    if found is None or not is_wrong_delay(found):
        return ""
    right_s = camera.depth_time_offset_s + found.delay_s
    return f"stamps: {format_delay(found)}; set depth_time_offset: {right_s:.3f} in camera.yaml"


def with_sure_delay(
    state: SelfCalibration,
    found: Registration | None,
    offset_s: float,
    least_s: float = LARGE_DELAY_S,
) -> SelfCalibration | None:
    """The state with the delay of depth that edges show, if it is surely larger than ``least_s``.

    A large delay bends the map, and with it what the motion says of the camera; smaller ones are
    left to that, since edges may deceive where a camera turns evenly: a delay moves them as another
    place of the depth camera does. ``offset_s`` is the delay of the camera that the edges were
    compared with.
    """
    if found is None:
        return None
    found_s, bound_s = round(offset_s + found.delay_s, 4), NORMAL_95 * found.delay_sigma_s
    shown = f"colour-depth delay {1e3 * found_s:.1f} ± {1e3 * bound_s:.1f} ms by edges of depth"
    logger.info("calibration: %s: estimated", shown)
    if abs(found.delay_s) - bound_s < least_s:
        return None
    camera = replace(state.camera, depth_time_offset_s=found_s)
    before = f"{state.text}; " if state.adopted else ""
    return replace(state, camera=camera, text=f"{before}{shown}: found and applied")


class EdgeDelay:
    """What edges say of the delay from one look at a live run to the next.

    Attributes:
        is_used: whether the delay that they showed is used; the motion decides from then on.

    Args:
        given: the camera that the run began with, with which edges are compared.
    """

    def __init__(self, given: Camera) -> None:
        self.is_used = False
        self._given = given
        self._last: Registration | None = None

    def contradicts(self, found: Registration | None, camera: Camera) -> bool:
        """Whether edges surely show another delay than a camera has, which is no right camera's."""
        if found is None:
            return False
        more_s = camera.depth_time_offset_s - self._given.depth_time_offset_s
        return is_wrong_delay(replace(found, delay_s=found.delay_s - more_s))

    def judge(
        self, state: SelfCalibration, found: Registration | None
    ) -> tuple[SelfCalibration, str]:
        """The state with the delay that edges show at a look, if its camera has another one.

        One that is not surely large is used if the last look showed it too. Also a warning, if
        edges show one that is no right camera's, and is not used.
        """
        last, self._last = self._last, found
        if found is None or not self.contradicts(found, state.camera):
            return state, ""
        confirmed = last is not None and is_wrong_delay(last) and found.agrees(last)
        least_s = SURE_DELAY_S if confirmed else LARGE_DELAY_S
        late = with_sure_delay(state, found, self._given.depth_time_offset_s, least_s)
        if late is None:
            return state, delay_warning(found, self._given)
        self.is_used = True
        return late, ""
