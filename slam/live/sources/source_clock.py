"""Stamps that increase, whatever a source's clock does: one outlier is refused, a new clock kept.

A wrong stamp must not move the trajectory's time by an hour, after which all right stamps would be
in the past; and a clock that was set back must not cost every frame until it has caught up.
"""

from __future__ import annotations

import logging
import math

from bmask_slam.graph.errors import InputError
from bmask_slam.sequences.frame import check_finite_stamp

logger = logging.getLogger(__name__)

MAX_GAP_S = 10.0
"""A later stamp than this after the last is believed when the next frame confirms it."""
MAX_STEP_S = 1.0
"""Longest time between two frames that confirm each other."""


class SourceClock:
    """Checks a source's stamps, and continues them where its clock was set back.

    Attributes:
        offset_s: what is added to the source's stamps; 0 until its clock goes back.
    """

    def __init__(self) -> None:
        self.offset_s = 0.0
        self._last_s = -math.inf
        self._doubted_s = math.nan

    def checked(self, stamp_s: float) -> float:
        """The stamp of a frame in seconds, later than that of every frame before.

        A stamp that goes back, or ahead by more than ``MAX_GAP_S``, is refused. If that of the next
        frame follows it, the source's clock was changed: later stamps are taken as they are, and
        earlier ones continued from the last frame's.

        Raises:
            InputError: a stamp that is not finite, or doubted; the frame is to be left out.
        """
        check_finite_stamp(stamp_s)
        found_s = float(stamp_s) + self.offset_s
        step_s = found_s - self._doubted_s  # NaN where none is doubted
        if not 0 < found_s - self._last_s <= MAX_GAP_S and math.isfinite(self._last_s):
            if not 0 < step_s <= MAX_STEP_S:
                self._doubted_s = found_s
                raise InputError(self._doubt(float(stamp_s), found_s))
            if found_s <= self._last_s:
                found_s = self._continued(found_s, step_s)
        self._doubted_s = math.nan
        return found_s

    def used(self, found_s: float) -> None:
        """The frame with this checked stamp was used: the next one has to be later."""
        self._last_s = found_s

    def _continued(self, found_s: float, step_s: float) -> float:
        """A stamp after the last frame's and the doubted one's, which a like step was between."""
        back_s = self._last_s + 2 * step_s - found_s
        self.offset_s += back_s
        logger.warning(
            "the clock of the source went back: %.3f s are added to its stamps from here on",
            self.offset_s,
        )
        return found_s + back_s

    def _doubt(self, stamp_s: float, found_s: float) -> str:
        ahead_s, last_s = found_s - self._last_s, self._last_s - self.offset_s
        how = "not later than" if ahead_s <= 0 else f"{ahead_s:.0f} s after"
        return (
            f"frame at {stamp_s}: {how} the frame before, at {last_s}; it is left out, and the "
            "next one is used if it follows this one"
        )
