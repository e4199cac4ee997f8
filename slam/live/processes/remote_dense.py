"""Tracking's side of dense mapping: which keyframes the process gets, in which order.

The policy. A keyframe waits until the map has optimised it and its masks have come, for these at
most MASKS_S, and not at all where nothing else is to be done and CROWDED wait: masks may come
later. Of those that are ready the newest goes first, one at a time. At most MAX_WAITING wait: one
more drives out the oldest, which is counted, and named in dense.json; ``bmask-slam map RUN`` adds
it. One that was sent is promised: it is sent again to another process if that one dies,
and dropped only if two die of it. A keyframe that is culled is forgotten, its submap removed.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from bmask_slam.dense.keyframe_input import KeyframeSnapshot
from bmask_slam.live.messages import Masks
from bmask_slam.live.processes.dense_messages import (
    DenseOrder,
    FinishMap,
    Forget,
    KeyframeToMap,
    LateMasks,
    Mapped,
    MapWritten,
    NotMapped,
    Preview,
    Taken,
)
from bmask_slam.live.processes.supervision import Patience, SupervisedWorker
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.sequences.frame import Frame
from bmask_slam.world.world_map import WorldMap

logger = logging.getLogger(__name__)

MAX_WAITING, CROWDED = 6, 4
MASKS_S = 3.0
AROUND = 32
"""Keyframes whose poses go along: more than the fusion holds."""
DEADLY = 2
LATE = "newer keyframes came first"


@dataclass(eq=False)
class _Waiting:
    """A keyframe that was not sent: its images, since when, and its masks once they came."""

    frame: Frame
    since_s: float
    instances: list[Instance] = field(default_factory=list)


class RemoteDenseMapper:
    """Gives keyframes to a process that fuses them into submaps.

    Attributes:
        submaps: ids of keyframes that have one.
        previews: of submaps that were finished since somebody took them.
        left_out: keyframes of the map that have none and will not get one, and why.
        dropped: how many of those were driven out by newer ones.
        unwritten: how many found the disk full.
    """

    def __init__(self, order: DenseOrder, rules: Patience | None = None) -> None:
        """Start it; ``wait_until_ready`` before the first keyframe."""
        self.submaps: set[int] = set()
        self.previews: dict[int, Preview] = {}
        self.left_out: dict[int, str] = {}
        self.dropped = self.unwritten = 0
        self._waiting: dict[int, _Waiting] = {}
        self._promised: dict[int, KeyframeToMap] = {}
        self._unsent: list[int] = []  # of those promised
        self._working: int | None = None
        self._deadly: Counter[int] = Counter()
        self._written: MapWritten | None = None
        target = "bmask_slam.live.processes.dense_process:serve_dense"
        self._worker = SupervisedWorker("dense mapper", target, (order,), rules or Patience())

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._worker.pid

    @property
    def deaths(self) -> int:
        """How often the process died or hung."""
        return self._worker.deaths

    @property
    def waiting(self) -> int:
        """Keyframes that were not taken in."""
        return len(self._waiting) + len(self._unsent) + (self._working is not None)

    @property
    def full(self) -> bool:
        """Whether one more keyframe would drive out another."""
        return len(self._waiting) >= MAX_WAITING and not self._worker.given_up

    def wait_until_ready(self) -> None:
        """Wait until the process can work. Raises InputError if it cannot start."""
        self._worker.first_words()

    def ask(self, keyframe_id: int, frame: Frame) -> None:
        """Take a keyframe's images, to be mapped later; they are copied."""
        if self._worker.given_up:
            self.left_out[keyframe_id] = "dense mapping was given up"
            return
        own = replace(frame, rgb=frame.rgb.copy(), depth_m=frame.depth_m.copy())
        self._waiting[keyframe_id] = _Waiting(own, time.monotonic())
        if len(self._waiting) > MAX_WAITING:
            self._leave_out(min(self._waiting), LATE)
            self.dropped += 1

    def see(self, masks: Masks, world: WorldMap) -> None:
        """Masks of a keyframe have come: they go along with it, or after it."""
        number, keyframe = masks.keyframe_id, world.keyframes.get(masks.keyframe_id)
        if number in self._waiting:
            self._waiting[number].instances = masks.instances
        elif keyframe is not None and number in self._promised.keys() | self.submaps:
            if number in self._promised:
                told = replace(self._promised[number], instances=masks.instances)
                self._promised[number] = told
            rows, ids = world.observed(keyframe)
            pixels = keyframe.features.image_pixels[rows]
            self._worker.send(LateMasks(number, masks.instances, ids, pixels))

    def follow(
        self,
        world: WorldMap,
        is_new: Callable[[int], bool],
        lacks_masks: Callable[[int], bool],
    ) -> None:
        """Take in the answers, and send what is ready; to be called often.

        ``is_new``: the map has not finished with a keyframe. ``lacks_masks``: its masks may come.
        """
        self._take_answers()
        if self._worker.given_up or self._working is not None:
            return
        if self._unsent:
            self._send(self._promised[self._unsent.pop(0)])
            return
        old_s = time.monotonic() - MASKS_S
        known = {n: waiting for n, waiting in self._waiting.items() if not is_new(n)}
        ready = [n for n, waiting in known.items() if waiting.since_s < old_s or not lacks_masks(n)]
        if not ready and len(self._waiting) >= CROWDED:
            ready = list(known)
        if ready:
            self._promise(max(ready), world)

    def forget_culled(self, world: WorldMap, is_new: Callable[[int], bool]) -> None:
        """Keyframes that left the map need no submap."""
        known = self._waiting.keys() | self._promised.keys() | self.submaps | self.left_out.keys()
        gone = [number for number in known - world.keyframes.keys() if not is_new(number)]
        if not gone:
            return
        for number in gone:
            self._waiting.pop(number, None)
            self._promised.pop(number, None)
            self.left_out.pop(number, None)
            self.previews.pop(number, None)
            self.submaps.discard(number)
        self._unsent = [number for number in self._unsent if number in self._promised]
        self._worker.send(Forget(sorted(gone)))

    def finish(self, world: WorldMap, timeout_s: float) -> MapWritten:
        """Let it map what waits and write the clouds; the run folder must hold the map."""

        def never(number: int) -> bool:
            return False

        self.forget_culled(world, never)
        poses = {k.id: k.T_world_camera for k in world.keyframes.values()}
        deadline_s, told_deaths = time.monotonic() + timeout_s, -1
        while self._written is None:
            if self._worker.given_up or time.monotonic() > deadline_s:
                return MapWritten(failure="the dense map's process did not finish")
            self.follow(world, never, never)
            if not self.waiting and told_deaths != self.deaths:
                told_deaths = self.deaths
                self._worker.send(FinishMap(poses, self.left_out), begins=True)
            time.sleep(0.005)
        return self._written

    def close(self) -> None:
        """End the process at once."""
        self._worker.close()

    def _take_answers(self) -> None:
        for message in self._worker.receive():
            match message:
                case Taken():
                    self._working = None
                case Mapped():
                    if self._promised.pop(message.keyframe_id, None) is not None:
                        self.submaps.add(message.keyframe_id)
                        if message.preview is not None:
                            self.previews[message.keyframe_id] = message.preview
                case NotMapped():
                    self.unwritten += message.disk_full
                    self._promised.pop(message.keyframe_id, None)
                    self._leave_out(message.keyframe_id, message.reason)
                case MapWritten():
                    self._written = message
        if self._worker.was_restarted(busy=self._working is not None):
            self._send_again()
        if self._worker.given_up and (self._waiting or self._promised):
            for number in [*self._waiting, *self._promised]:
                self._leave_out(number, "dense mapping was given up")
            self._promised, self._unsent, self._working = {}, [], None

    def _promise(self, number: int, world: WorldMap) -> None:
        """Send a keyframe as it is in the map at this moment."""
        waiting, keyframe = self._waiting.pop(number), world.keyframes.get(number)
        if keyframe is None:
            return
        around = sorted(world.keyframes.keys() & (self._promised.keys() | self.submaps))[-AROUND:]
        poses = {i: world.keyframes[i].T_world_camera for i in (*around, number)}
        snapshot = KeyframeSnapshot.of(world, keyframe, waiting.frame)
        self._promised[number] = KeyframeToMap(snapshot, waiting.instances, poses)
        self._send(self._promised[number])

    def _send(self, message: KeyframeToMap) -> None:
        self._working = message.id
        self._worker.send(message, begins=True)

    def _send_again(self) -> None:
        """Another process gets what the last one was promised, but for what it died of twice."""
        if self._working is not None:
            self._deadly[self._working] += 1
            if self._deadly[self._working] >= DEADLY:
                self._promised.pop(self._working, None)
                self._leave_out(self._working, "the process died of it twice")
        self._working = None
        self._unsent = sorted(self._promised)

    def _leave_out(self, number: int, reason: str) -> None:
        self._waiting.pop(number, None)
        self.left_out[number] = reason
        logger.info("keyframe %d is not in the dense map: %s", number, reason)
