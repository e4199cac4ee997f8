"""Pairing of colour and depth images by their stamps, on one clock that never goes back."""

from __future__ import annotations

import logging
from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from bmask_slam.graph.trajectory import associate_stamps, nearest_indices
from bmask_slam.live.sources.source import SourceCounts
from bmask_slam.live.sources.source_clock import MAX_GAP_S
from bmask_slam.sequences.lists import half_interval_s

logger = logging.getLogger(__name__)

T = TypeVar("T")

RGB, DEPTH = 0, 1
MAX_DIFFERENCE_S = 0.02
LATE_S = 1.0
"""A stamp that is earlier than the last by less is late; by more, the clock was set back."""
GAP_STEPS = 3
USUAL_FRAMES = 30
"""Number of steps whose median is the usual step."""
MAX_WAITING = 30
"""Largest number of images of one stream that wait for the other (1 s): bounds the memory."""


class Pair(NamedTuple, Generic[T]):
    """A colour and a depth image of one frame; the stamp is the colour image's.

    ``lag_s``: stamp of the depth image less that of the colour image.
    """

    stamp_s: float
    rgb: T
    depth: T
    lag_s: float


@dataclass
class _Stream:
    """The last stamp of a stream, how often its clock was set back, and the mapped stamp.

    ``before``: stamp and number of times before the last one, if that is far from it.
    """

    last_s: float = -np.inf
    epoch: int = 0
    placed_s: float = -np.inf
    before: tuple[float, int] | None = None


class StreamClock:
    """Maps the stamps of two streams to one clock that only goes forward.

    When the streams' clock is set back, the mapped clock goes on ``LATE_S`` after its latest stamp.
    Both streams get the same shift, each from its own first stamp after the clock was set back.
    A single stamp that is wrong, as 0, changes nothing: the next one goes on from the one before.
    """

    def __init__(self, counts: SourceCounts) -> None:
        self._counts = counts
        self._shifts_s = [0.0]
        self._streams = _Stream(), _Stream()
        self._begins_s = [-np.inf]

    @property
    def latest_s(self) -> float:
        """The latest mapped stamp."""
        return max(stream.placed_s for stream in self._streams)

    @property
    def shift_s(self) -> float:
        """What is added to stamps at present."""
        return self._shifts_s[-1]

    def original(self, placed_s: float) -> float:
        """The stamp that was mapped to ``placed_s``."""
        epoch = bisect_right(self._begins_s, placed_s) - 1
        return placed_s - self._shifts_s[epoch]

    def map_stamp(self, stream: int, stamp_s: float) -> float | None:
        """The mapped stamp in seconds; None for a duplicate or late one, which is counted.

        It is earlier than the last one if that was wrong.
        """
        of, other = self._streams[stream], self._streams[1 - stream]
        if stamp_s == of.last_s:
            self._counts.duplicates += 1
            return None
        last, before = (of.last_s, of.epoch), of.before
        if before is not None and (
            _goes_on(before[0], of.last_s, stamp_s) or _is_wrong_first(of, other, stamp_s)
        ):
            self._take_back(of, *before)
        elif of.last_s - LATE_S <= stamp_s < of.last_s:
            self._counts.late += 1
            return None
        else:
            of.before = last if abs(stamp_s - of.last_s) > LATE_S else None
            if stamp_s < of.last_s:
                self._set_back(of, stamp_s)
        of.last_s = stamp_s
        of.placed_s = stamp_s + self._shifts_s[of.epoch]
        return of.placed_s

    def doubts(self, stream: int) -> bool:
        """Whether the last stamp is far from the one before; the next one says if it was wrong."""
        before = self._streams[stream].before
        return before is not None and bool(np.isfinite(before[0]))

    def _set_back(self, of: _Stream, stamp_s: float) -> None:
        of.epoch += 1
        if of.epoch < len(self._shifts_s):
            return
        self._counts.clock_jumps += 1
        self._begins_s.append(self.latest_s + LATE_S / 2)
        self._shifts_s.append(self.latest_s + LATE_S - stamp_s)
        logger.warning(
            "the clock was set back by %.3f s; stamps are shifted by %.3f s from here on",
            of.last_s - stamp_s,
            self._shifts_s[-1],
        )

    def _take_back(self, of: _Stream, last_s: float, epoch: int) -> None:
        """The last stamp of a stream was wrong; it goes on from the one before."""
        how = (
            f"stamps go on from {last_s:.3f}" if np.isfinite(last_s) else "the first of its stream"
        )
        logger.warning("the stamp %.3f was wrong: %s", of.last_s, how)
        of.epoch, of.before = epoch, None
        if max(stream.epoch for stream in self._streams) < len(self._shifts_s) - 1:
            self._counts.clock_jumps -= 1
            del self._shifts_s[-1], self._begins_s[-1]


def _goes_on(before_s: float, last_s: float, stamp_s: float) -> bool:
    """Whether a stamp follows the one before the last, and not the last one, which is far away."""
    return 0 < stamp_s - before_s < min(abs(stamp_s - last_s), MAX_GAP_S)


def _is_wrong_first(of: _Stream, other: _Stream, stamp_s: float) -> bool:
    """Whether the only stamp of a stream so far is far ahead, and the other stream was not there.

    If it was, the clock of both was set back.
    """
    is_first = of.before is not None and not np.isfinite(of.before[0])
    was_alone = abs(other.placed_s - of.placed_s) > LATE_S
    return is_first and was_alone and stamp_s < of.last_s - LATE_S


class GapMeter:
    """Counts steps between frames that are much longer than the usual step."""

    def __init__(self, counts: SourceCounts) -> None:
        self._counts = counts
        self._last_s: float | None = None
        self._steps_s: deque[float] = deque(maxlen=USUAL_FRAMES)

    def count(self, stamp_s: float) -> None:
        """Count the step to the next frame."""
        if self._last_s is not None:
            step_s = stamp_s - self._last_s
            if self._steps_s and step_s > GAP_STEPS * float(np.median(self._steps_s)):
                self._counts.gaps += 1
            self._steps_s.append(step_s)
        self._last_s = stamp_s


class Pairer(Generic[T]):
    """Pairs colour and depth images by nearest stamp as they come; each image is used once.

    A pair is returned as soon as no later image can fit either of its two better: at once where the
    stamps are equal, else with the next image of the stream with the earlier stamp. The pairs are
    those of ``associate_stamps`` over all stamps, unless the streams step by less than
    ``max_difference_s``.

    ``depth_offset_s()`` is what depth is later than its stamps; it may change on the way. With one
    the limit is at least half of the interval between depth images, so that each finds a partner.

    Attributes:
        clock: of both streams.
    """

    def __init__(
        self,
        counts: SourceCounts,
        depth_offset_s: Callable[[], float] = lambda: 0.0,
        max_difference_s: float = MAX_DIFFERENCE_S,
        max_waiting: int = MAX_WAITING,
    ) -> None:
        self._counts, self._max_s, self._max_waiting = counts, max_difference_s, max_waiting
        self._depth_offset_s, self._offsets_s = depth_offset_s, (0.0, depth_offset_s())
        self._least_s, self._steps_s = max_difference_s, deque[float](maxlen=USUAL_FRAMES)
        self.clock, self._gaps = StreamClock(counts), GapMeter(counts)
        self._waiting: tuple[deque[tuple[float, T]], ...] = (deque(), deque())
        self._heard_s = [-np.inf, -np.inf]

    def add(self, stream: int, stamp_s: float, item: T) -> list[Pair[T]]:
        """Add an image of a stream, RGB or DEPTH; returns the pairs that are final by it."""
        placed_s = self.clock.map_stamp(stream, stamp_s)
        if placed_s is None:
            return []
        self._move_depth(self._depth_offset_s())
        placed_s += self._offsets_s[stream]
        if placed_s <= self._heard_s[stream]:  # the last stamp was wrong
            self._leave_out(stream, placed_s)
        elif stream == DEPTH and np.isfinite(self._heard_s[DEPTH]):
            self._steps_s.append(placed_s - self._heard_s[DEPTH])
            half_s = half_interval_s(np.array(self._steps_s)) if self._offsets_s[DEPTH] else 0.0
            self._max_s = max(self._least_s, half_s)
        self._heard_s[stream] = placed_s
        self._waiting[stream].append((placed_s, item))
        pairs = self._final_pairs()
        for each in (RGB, DEPTH):
            self._discard(each)
        return pairs

    def _leave_out(self, stream: int, from_s: float) -> None:
        """Drop the images of a stream that wait and have this stamp or a later one."""
        queue = self._waiting[stream]
        while queue and queue[-1][0] >= from_s:
            queue.pop()
            self._count_unpaired(stream)

    def _count_unpaired(self, stream: int) -> None:
        if stream == RGB:
            self._counts.unpaired_rgb += 1
        else:
            self._counts.unpaired_depth += 1

    def _move_depth(self, offset_s: float) -> None:
        """Place the depth images that wait by another offset, if it is another."""
        change_s = offset_s - self._offsets_s[DEPTH]
        if change_s:
            waiting = deque((stamp_s + change_s, item) for stamp_s, item in self._waiting[DEPTH])
            self._waiting, self._offsets_s = (self._waiting[RGB], waiting), (0.0, offset_s)
            self._heard_s[DEPTH] += change_s

    def finish(self) -> list[Pair[T]]:
        """The remaining pairs, when no further image will come."""
        return self._pair_first(len(self._waiting[RGB]), len(self._waiting[DEPTH]))

    def _final_pairs(self) -> list[Pair[T]]:
        """The pairs up to the latest one that no later image can change."""
        rgb_s, depth_s = (np.array([s for s, _ in queue]) for queue in self._waiting)
        if not len(rgb_s) or not len(depth_s):
            return []
        to_depth, to_rgb = nearest_indices(depth_s, rgb_s), nearest_indices(rgb_s, depth_s)
        partners_s = depth_s[to_depth]
        mutual = to_rgb[to_depth] == np.arange(len(rgb_s))
        mutual &= np.abs(partners_s - rgb_s) <= self._max_s
        mutual &= np.maximum(rgb_s, partners_s) <= min(self._heard_s)
        for stream, stamps_s in ((RGB, rgb_s), (DEPTH, partners_s)):
            if self.clock.doubts(stream):  # the last one may be left out
                mutual &= stamps_s < self._heard_s[stream]
        found = np.flatnonzero(mutual)
        if not len(found):
            return []
        return self._pair_first(int(found[-1]) + 1, int(to_depth[found[-1]]) + 1)

    def _pair_first(self, rgb_count: int, depth_count: int) -> list[Pair[T]]:
        """Pair the first images of the two queues; the others of them count as unpaired."""
        rgb = [self._waiting[RGB].popleft() for _ in range(rgb_count)]
        depth = [self._waiting[DEPTH].popleft() for _ in range(depth_count)]
        rgb_s, depth_s = (np.array([s for s, _ in images]) for images in (rgb, depth))
        i, j = associate_stamps(rgb_s, depth_s, self._max_s)
        self._counts.unpaired_rgb += rgb_count - len(i)
        self._counts.unpaired_depth += depth_count - len(j)
        lags_s = depth_s[j] - self._offsets_s[DEPTH] - rgb_s[i]
        pairs = [
            Pair(rgb[k][0], rgb[k][1], depth[m][1], float(lag_s))
            for k, m, lag_s in zip(i, j, lags_s, strict=True)
        ]
        for pair in pairs:
            self._gaps.count(pair.stamp_s)
        return pairs

    def _discard(self, stream: int) -> None:
        """Drop images that no later image can fit, and the oldest where too many wait."""
        queue, others = self._waiting[stream], self._waiting[1 - stream]
        while queue:
            stamp_s = queue[0][0]
            near = any(abs(other_s - stamp_s) <= self._max_s for other_s, _ in others)
            over = self._heard_s[1 - stream] > stamp_s + self._max_s and not near
            if not over and len(queue) <= self._max_waiting:
                return
            queue.popleft()
            self._count_unpaired(stream)
