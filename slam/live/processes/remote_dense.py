"""Tracking's side of dense mapping: which keyframes the process gets, and in which order.

A keyframe waits until the map has optimised it and its masks have come. For masks it waits at most
MASKS_S, and not at all if CROWDED keyframes wait and none is ready: masks may follow later. Of the
ready keyframes the newest is sent first, one at a time. At most MAX_WAITING wait; one more drops
the oldest, which is counted and listed in dense.json, and which ``bmask-slam map RUN`` adds. A
keyframe that was sent is sent again to a new process if the process dies, and is skipped only if
two processes die while handling it. The submap of a culled keyframe is removed.

Frames between keyframes go to the surface as `FrameQueue` chooses. The last process lets it grow
only at the end, in case that killed the others.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from bmask_slam.dense.growing.frames import FrameQueue, FramesTaken, ShownParts
from bmask_slam.dense.keyframe_input import KeyframeSnapshot
from bmask_slam.graph.arrays import Bytes, Floats
from bmask_slam.live.messages import Masks
from bmask_slam.live.processes.dense_messages import (
    NO_POSES,
    Accepted,
    DenseSetup,
    FinishMap,
    KeyframeToMap,
    LateMasks,
    Mapped,
    MapPoses,
    MapWritten,
    NotMapped,
    Preview,
    RemoveKeyframes,
    RunMoved,
    ShowSurface,
)
from bmask_slam.live.processes.supervision import RestartPolicy, SupervisedWorker
from bmask_slam.mapping.surface.parts import SurfacePart
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.sequences.frame import Frame
from bmask_slam.world.frame_history import FrameHistory
from bmask_slam.world.world_map import WorldMap

logger = logging.getLogger(__name__)

MAX_WAITING, CROWDED = 6, 4
MASKS_S, PLACES_S = 3.0, 1.0
AROUND = 32
"""Number of neighbouring keyframes whose poses are sent: more than the fusion holds."""
MAX_KEYFRAME_CRASHES = LAST_CRASH = 2
LATE = "newer keyframes came first"


@dataclass(eq=False)
class _Waiting:
    """A keyframe that was not sent yet, since when it waits, and its masks if they have come."""

    frame: Frame
    since_s: float
    instances: list[Instance] = field(default_factory=list)


class RemoteDenseMapper:
    """Sends keyframes to a process that fuses them into submaps.

    Attributes:
        submaps: ids of those with a submap.
        previews: of finished submaps, which the viewer removes from here.
        keeps_previews: whether there is a viewer.
        listeners: called with the keyframe's id, points and colours of each preview.
        skipped: keyframes of the map that will get no submap, and why.
        dropped: how many of those were dropped because newer ones came.
        unwritten: how many could not be written because the disk was full.
        frames: what the surface gets besides keyframes.
        shown: parts of the surface.
        worker: the supervised process.
    """

    def __init__(self, setup: DenseSetup, policy: RestartPolicy | None = None) -> None:
        """Start the process; call ``wait_until_ready`` before the first keyframe."""
        self.submaps: set[int] = set()
        self.previews: dict[int, Preview] = {}
        self.listeners: list[Callable[[int, Floats, Bytes], None]] = []
        self.skipped: dict[int, str] = {}
        self.keeps_previews = True
        self.shown = ShownParts()
        self._poses = NO_POSES
        self.dropped = self.unwritten = 0
        self._waiting: dict[int, _Waiting] = {}
        self._sent: dict[int, KeyframeToMap] = {}
        self._to_resend: list[int] = []  # of those sent, after a restart
        self._working: int | None = None
        self._crashes_with: Counter[int] = Counter()
        self._place_s, self._has_moved = 0.0, False
        self._written: MapWritten | None = None
        target = "bmask_slam.live.processes.dense_process:serve_dense"
        self._setup = setup
        self.worker = SupervisedWorker("dense mapper", target, (setup,), policy or RestartPolicy())
        self.frames = FrameQueue(setup.frames, self.worker.send)

    @property
    def waiting(self) -> int:
        """Number of keyframes that are not fused yet."""
        return len(self._waiting) + len(self._to_resend) + (self._working is not None)

    @property
    def full(self) -> bool:
        """Whether one more keyframe would drop another, or one more frame would be dropped."""
        crowded = len(self._waiting) >= MAX_WAITING or self.frames.full
        return crowded and not self.worker.given_up

    def wait_until_ready(self) -> None:
        """Wait until the process is ready. Raises InputError if it cannot start."""
        self.worker.wait_until_ready()

    def show_surface(self, listener: Callable[[SurfacePart], None] | None = None) -> None:
        """Call with each part of the surface that changes; None: keep them for a viewer."""
        self.shown.keeps |= listener is None
        self.shown.listeners += [] if listener is None else [listener]
        self.worker.send(ShowSurface())

    def place(self, world: WorldMap, history: FrameHistory, moved: bool) -> None:
        """Tell the surface where keyframes are, if some ``moved``: once a second."""
        self._has_moved |= moved
        if not self._has_moved or time.monotonic() < self._place_s:
            return
        self._place_s, self._has_moved = time.monotonic() + PLACES_S, False
        poses = MapPoses.of(world, history, self.frames.references)
        if not poses.is_like(self._poses):
            self._poses = poses
            self.worker.send(poses)

    def follow(self, run: Path) -> None:
        """Let the process, and one that is started in its place, write to this run folder."""
        if run != self._setup.run:
            self._setup = replace(self._setup, run=run)
            self.worker.arguments = (self._setup,)
            self.worker.send(RunMoved(run))

    def add_keyframe(self, keyframe_id: int, frame: Frame) -> None:
        """Queue a keyframe; its images are copied."""
        if self.worker.given_up:
            self.skipped[keyframe_id] = "dense mapping was given up"
            return
        own = replace(frame, rgb=frame.rgb.copy(), depth_m=frame.depth_m.copy())
        self._waiting[keyframe_id] = _Waiting(own, time.monotonic())
        if len(self._waiting) > MAX_WAITING:
            self._skip(min(self._waiting), LATE)
            self.dropped += 1

    def add_masks(self, masks: Masks, world: WorldMap) -> None:
        """Add masks of a keyframe, which are sent with it or after it."""
        number, keyframe = masks.keyframe_id, world.keyframes.get(masks.keyframe_id)
        if number in self._waiting:
            self._waiting[number].instances = masks.instances
        elif keyframe is not None and number in self._sent.keys() | self.submaps:
            if number in self._sent:
                with_masks = replace(self._sent[number], instances=masks.instances)
                self._sent[number] = with_masks
            rows, ids = world.observed(keyframe)
            pixels = keyframe.features.image_pixels[rows]
            self.worker.send(LateMasks(number, masks.instances, ids, pixels))

    def update(
        self, world: WorldMap, is_new: Callable[[int], bool], lacks_masks: Callable[[int], bool]
    ) -> None:
        """Apply the process's answers, and send the next keyframe; to be called often.

        Args:
            is_new: whether the map has not finished a keyframe.
            lacks_masks: whether masks of a keyframe may still come.
        """
        self._apply_answers()
        if self.worker.given_up or self._working is not None:
            return
        if self._to_resend:
            self._send(self._sent[self._to_resend.pop(0)])
            return
        old_s = time.monotonic() - MASKS_S
        known = {n: waiting for n, waiting in self._waiting.items() if not is_new(n)}
        ready = [n for n, waiting in known.items() if waiting.since_s < old_s or not lacks_masks(n)]
        if not ready and len(self._waiting) >= CROWDED:
            ready = list(known)
        if ready:
            self._send_new(max(ready), world)

    def remove_culled(self, world: WorldMap, is_new: Callable[[int], bool]) -> None:
        """Drop the keyframes that are no longer in the map, and their submaps."""
        known = self._waiting.keys() | self._sent.keys() | self.submaps | self.skipped.keys()
        removed = [number for number in known - world.keyframes.keys() if not is_new(number)]
        if not removed:
            return
        for number in removed:
            self._waiting.pop(number, None)
            self._sent.pop(number, None)
            self.skipped.pop(number, None)
            self.previews.pop(number, None)
            self.submaps.discard(number)
        self._to_resend = [number for number in self._to_resend if number in self._sent]
        self.worker.send(RemoveKeyframes(sorted(removed)))

    def finish(self, world: WorldMap, history: FrameHistory, timeout_s: float) -> MapWritten:
        """Map what waits and write the clouds; the run folder must hold the map by now."""
        self.remove_culled(world, lambda _: False)
        self._place_s = 0.0
        self.place(world, history, True)
        poses = {k.id: k.T_world_camera for k in world.keyframes.values()}
        deadline_s, crashes_at_request = time.monotonic() + timeout_s, -1
        while self._written is None:
            if self.worker.given_up or time.monotonic() > deadline_s:
                return MapWritten(failure="the dense map's process did not finish")
            self.update(world, lambda _: False, lambda _: False)
            if not self.waiting and crashes_at_request != self.worker.crashes:
                crashes_at_request = self.worker.crashes
                self.worker.send(FinishMap(poses, self.skipped), begins=True)
            time.sleep(0.005)
        return self._written

    def close(self) -> None:
        """Kill the process."""
        self.worker.close()

    def _apply_answers(self) -> None:
        for message in self.worker.receive():
            match message:
                case Accepted():
                    self._working = None
                case Mapped():
                    if self._sent.pop(message.keyframe_id, None) is not None:
                        self.submaps.add(message.keyframe_id)
                        self._keep(message)
                case NotMapped():
                    self.unwritten += message.disk_full
                    self._sent.pop(message.keyframe_id, None)
                    self._skip(message.keyframe_id, message.reason)
                case FramesTaken():
                    self.frames.taken(message)
                case SurfacePart():
                    self.shown.take(message)
                case MapWritten():
                    self._written = message
        if self.worker.restart_if_needed(busy=self._working is not None):
            self._resend_all()
        if self.worker.given_up and (self._waiting or self._sent):
            for number in [*self._waiting, *self._sent]:
                self._skip(number, "dense mapping was given up")
            self._sent, self._to_resend, self._working = {}, [], None

    def _keep(self, message: Mapped) -> None:
        """Keep a submap's preview for the viewer, and tell the listeners."""
        if message.preview is not None:
            if self.keeps_previews:
                self.previews[message.keyframe_id] = message.preview
            for listener in self.listeners:
                listener(message.keyframe_id, message.preview.points, message.preview.colours)

    def _send_new(self, number: int, world: WorldMap) -> None:
        """Send a keyframe with its present pose and landmarks."""
        waiting, keyframe = self._waiting.pop(number), world.keyframes.get(number)
        if keyframe is None:
            return
        around = sorted(world.keyframes.keys() & (self._sent.keys() | self.submaps))[-AROUND:]
        poses = {i: world.keyframes[i].T_world_camera for i in (*around, number)}
        snapshot = KeyframeSnapshot.of(world, keyframe, waiting.frame)
        self._sent[number] = KeyframeToMap(snapshot, waiting.instances, poses)
        self._send(self._sent[number])

    def _send(self, message: KeyframeToMap) -> None:
        self._working = message.id
        self.worker.send(message, begins=True)

    def _resend_all(self) -> None:
        """Queue what was sent for the new process, but for a keyframe that killed two."""
        if self._working is not None:
            self._crashes_with[self._working] += 1
            if self._crashes_with[self._working] >= MAX_KEYFRAME_CRASHES:
                self._sent.pop(self._working, None)
                self._skip(self._working, "the process crashed on it twice")
        self._working = None
        self._to_resend = sorted(self._sent)
        self.worker.send(self._poses)
        if self.shown.wanted:
            self.worker.send(ShowSurface())
        self.frames.send_again()
        if self.worker.crashes >= LAST_CRASH:
            self._setup = replace(self._setup, grows=False)
            self.worker.arguments = (self._setup,)

    def _skip(self, number: int, reason: str) -> None:
        self._waiting.pop(number, None)
        self.skipped[number] = reason
        logger.info("keyframe %d is not in the dense map: %s", number, reason)
