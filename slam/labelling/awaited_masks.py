"""Keyframes whose masks are to come.

A network that works beside tracking takes longer than a frame. What it finds is used ``LAG`` frames
after the keyframe and not earlier, however soon it comes: tracking goes on in the meantime, and a
run that is repeated gives the same bytes, on one processor as on more.

Those of two kinds of keyframes are urgent, and used before the next frame is tracked. That has no
other landmarks than those of the keyframe that begins a map segment; and where most of an image
moves, the few static landmarks are soon outnumbered by those that a keyframe makes on people.
Either way the camera would follow a person.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from bmask_slam.graph.arrays import Arrays, Floats, Image
from bmask_slam.semantics.segmenters.segmenter import EarlySegmenter, Segmenter
from bmask_slam.sequences.frame import Frame

LAG = 3
"""Frames after which what another process answers is used: about as long as it needs."""
DEPTH_STEP = 2
"""Every second pixel of a keyframe's depth image is kept until its masks arrive."""
MAX_AWAITING = 100
"""Keyframes whose depth images are kept."""


@dataclass(frozen=True, eq=False)
class AwaitingKeyframe:
    """What the masks of a keyframe will need: its stamp and its thinned depth (h, w)."""

    timestamp_s: float
    depth_m: Floats


class AwaitingKeyframes(dict[int, AwaitingKeyframe]):
    """The newest keyframes whose masks have not come, by their ids."""

    def add(self, keyframe_id: int, awaiting: AwaitingKeyframe) -> None:
        """Add one; the oldest is given up if there are too many."""
        self[keyframe_id] = awaiting
        if len(self) > MAX_AWAITING:
            del self[next(iter(self))]

    def take(self, keyframe_id: int, size: tuple[int, ...]) -> AwaitingKeyframe:
        """A keyframe, which waits no more; one without a stamp and depths, if it did not."""
        nothing = AwaitingKeyframe(np.nan, np.full(size, np.nan, np.float32))
        return self.pop(keyframe_id, nothing)

    def state(self) -> Arrays:
        """All of them, as named arrays; the depth images, of one size, in one."""
        return {
            "waiting": np.array(list(self), np.int64),
            "waiting_s": np.array([w.timestamp_s for w in self.values()], float),
            "waiting_shape": np.array([w.depth_m.shape for w in self.values()], np.int64).ravel(),
            "waiting_depth_m": np.array([w.depth_m for w in self.values()], np.float32).ravel(),
        }

    def restore(self, state: Arrays) -> None:
        """Go on from a state, which may hold other arrays too."""
        shape = state["waiting_shape"].reshape(-1, 2)[:1].ravel().tolist() or [0, 0]
        depths_m = state["waiting_depth_m"].reshape(len(state["waiting"]), *shape)
        awaiting = map(AwaitingKeyframe, state["waiting_s"].tolist(), depths_m)
        self.clear()
        self.update(zip(state["waiting"].tolist(), awaiting, strict=True))


def kept_depth(depth_m: Floats) -> Floats:
    """Every DEPTH_STEP-th pixel each way of a z-depth image (H, W) in m."""
    return depth_m[::DEPTH_STEP, ::DEPTH_STEP].copy()


@dataclass(frozen=True, eq=False)
class MaskRequest:
    """Asks for the masks of a keyframe: its image (H, W, 3), and what that is called.

    They are used when ``frames_left`` is 0.
    """

    keyframe_id: int
    image: Image
    name: str
    frames_left: int


class MaskRequests:
    """The masks that were asked for and not used yet, oldest first."""

    def __init__(self) -> None:
        self._requests: list[MaskRequest] = []

    def begin_frame(self) -> None:
        """A frame begins; some may be due with it."""
        self._requests = [replace(r, frames_left=r.frames_left - 1) for r in self._requests]

    def add(
        self, keyframe_id: int, frame: Frame, segmenter: Segmenter, urgent: bool = False
    ) -> None:
        """Ask for the masks of a frame that became a keyframe.

        They are due with the next frame if ``urgent``, and at once if the segmenter cannot work
        beside its caller.
        """
        lag = 0 if not isinstance(segmenter, EarlySegmenter) else 1 if urgent else LAG
        self._requests.append(MaskRequest(keyframe_id, frame.rgb, frame.name, lag))

    def take(self, everything: bool = False) -> Iterator[MaskRequest]:
        """Those that are due, or all, each once."""
        due = [r for r in self._requests if everything or r.frames_left <= 0]
        self._requests = [r for r in self._requests if r not in due]
        yield from due
