"""The other processes' answers, each used at a frame that does not depend on how fast they are.

What tracking sends with a frame is answered before the first frame that is LAG_S later by its
stamp, and not used earlier, however soon it comes; a keyframe's landmarks, which the graph has not
moved yet, come with the frame that is LAG later. Where masks are urgent, all is answered before the
next frame. So tracking, map and masks work at the same time, and a run that is repeated gives
the same bytes. The live loop takes about as long; with less, tracking waits for the others.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Generic, TypeVar

from bmask_slam.features.descriptor_index import DescriptorIndex
from bmask_slam.graph.arrays import Arrays, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.array_file import part
from bmask_slam.labelling.awaited_masks import LAG
from bmask_slam.labelling.mask_memory import MaskMemory
from bmask_slam.live.messages import FramesTracked, ImageToSegment, MapChanged, Masks, SaveState
from bmask_slam.live.processes.map_return import MapPlace
from bmask_slam.live.processes.map_worker import MapWorker
from bmask_slam.live.processes.remote_mapper import RemoteMapper
from bmask_slam.live.processes.segmentation import RemoteSegmenter
from bmask_slam.live.processes.supervision import RestartPolicy
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions
from bmask_slam.semantics.segmenters.upright import Upright
from bmask_slam.sequences.frame import Frame
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import Tracked
from bmask_slam.world.frame_history import FrameHistory
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.world_map import WorldMap

logger = logging.getLogger(__name__)

WAIT_S = 600.0
"""Longest wait for an answer."""
LAG_S = 0.25
MOST_LAG = 15
"""An answer is used so long after, but ``LAG`` frames at least, and so many at the most."""
T = TypeVar("T")


class Delayed(Generic[T]):
    """A queue of what is sent with frames, each item of which is due some frames later."""

    def __init__(self, lag_s: float) -> None:
        """``LAG`` frames later, or more until ``lag_s`` have passed."""
        self._lag_s = lag_s
        self._frame, self._stamp_s, self._due = 0, 0.0, 0
        self._items: deque[tuple[int, float, T]] = deque()

    def __iter__(self) -> Iterator[T]:
        return (item for _, _, item in self._items)

    def __len__(self) -> int:
        return len(self._items)

    def begin_frame(self, timestamp_s: float) -> None:
        """A frame begins; some may be due with it."""
        self._frame, self._stamp_s = self._frame + 1, timestamp_s
        self._due = sum(self._is_due(frame, stamp_s) for frame, stamp_s, _ in self._items)

    def _is_due(self, frame: int, timestamp_s: float) -> bool:
        frames, seconds = self._frame - frame, self._stamp_s - timestamp_s
        return frames >= LAG and (seconds >= self._lag_s or frames >= MOST_LAG)

    def add(self, item: T) -> None:
        """Add what is sent with this frame."""
        self._items.append((self._frame, self._stamp_s, item))

    def all_due(self) -> None:
        """All of them are due."""
        self._due = len(self._items)

    def clear(self) -> None:
        """None of them is needed any more."""
        self._items.clear()
        self._due = 0

    def take(self) -> Iterator[T]:
        """Those that are due, each once."""
        while self._due:
            self._due -= 1
            yield self._items.popleft()[2]


class LockstepMapper(RemoteMapper):
    """A remote mapper whose answers are applied at frames that are the same in every run.

    Where its process has died they are waited for as well, but are not the same.
    """

    counts_anew = False

    def __init__(
        self, camera: Camera, config: SystemConfig, names: tuple[str, ...], place: MapPlace
    ) -> None:
        self._about, self._place = (camera, config, names), place
        self._finishes = False
        self._begin()
        super().__init__(*self._about, place)

    def _begin(self) -> None:
        """A process begins, to which nothing was sent."""
        self.handled = self._due = 0  # numbers of messages
        self._answers: deque[Any] = deque()
        self._ends = Delayed[int](LAG_S)  # last messages of frames
        self._made = Delayed[tuple[int, int]](0.0)  # keyframes and their messages
        self._awaited, self._received = (-1, 0), -1  # keyframes with their landmarks
        self._kept: list[Any] = []

    def begin_frame(self, timestamp_s: float) -> None:
        """A frame begins: answers to what was sent some frames ago are due."""
        self._ends.begin_frame(timestamp_s)
        self._due = max(self._ends.take(), default=self._due)
        self._made.begin_frame(timestamp_s)
        self._awaited = max(self._made.take(), default=self._awaited)

    def insert(self, frame: Frame, tracked: Tracked, segment: int, local_ids: Ints) -> Keyframe:
        """As ``RemoteMapper.insert``; its landmarks are due before what the graph makes of them."""
        keyframe = super().insert(frame, tracked, segment, local_ids)
        self._made.add((keyframe.id, self.worker.sent))
        return keyframe

    def end_frame(self) -> None:
        """What was sent since the last call belongs to this frame."""
        self._ends.add(self.worker.sent)

    def all_due(self) -> None:
        """Answers to all that was sent are due."""
        self._due = self.worker.sent
        self._ends.clear()
        self._made.clear()

    def catch_up(self, timeout_s: float = 0.0) -> list[Any]:
        """Apply the answers that are due, once they have come; returns the other messages.

        Raises:
            InputError: one does not come.
        """
        if self._finishes:
            return super().catch_up(timeout_s)
        others, self._kept = self._kept, []
        until_s = time.monotonic() + WAIT_S
        while self._is_to_come():
            if self._answers:
                others += self._apply_answers([answer := self._answers.popleft()])
                if isinstance(answer, MapChanged):
                    self._received = max(self._received, answer.keyframe_id)
                continue
            self._answers.extend(self.worker.receive(0.1))
            if self.worker.has_crashed:
                logger.warning("this run does not give the same bytes again")
                self._answers.extend(self.worker.receive_last())
                self.worker.restart()
            elif not self._answers and time.monotonic() > until_s:
                raise InputError(f"the map's process has not answered for {WAIT_S:.0f} s")
        return others

    def _is_to_come(self) -> bool:
        """Whether something is due that was answered, or will still be."""
        keyframe_id, message = self._awaited
        due = max(self._due, message) if self._received < keyframe_id else self._due
        if self.handled >= due:
            return False
        if self._answers:
            return True
        return not self.worker.given_up and self.worker.lacks(self.handled, due)

    def send_frames(self) -> None:
        """Tell the map of the frames since the last keyframe, if there are any."""
        frames = FramesTracked(self._visibility_counts(), self._unsent_history())
        if len(frames.history) or len(frames.visibility.ids):
            self.send(frames)

    def write_state(self, path: Path) -> None:
        """Let the process write its state, and wait for that.

        Raises:
            InputError: it could not.
        """
        saves = self.worker.saves
        self.send(SaveState(path))
        self.all_due()
        self._kept = self.catch_up()
        if self.worker.saves == saves:
            raise InputError(f"{path}: the map's process could not write its state")

    def begin_with(self, path: Path, state: Arrays) -> None:
        """Go on from a state, which a file holds too, with a new process and a new copy."""
        self.worker.kill()
        place = replace(self._place, begins_with=path)
        self.worker = MapWorker(self._about, self._replacement, place)
        self._begin()
        self.world, self.history = WorldMap(), FrameHistory()
        self.places = DescriptorIndex(self._about[1].loops.index)
        self.history.restore(part(state, "mapper.history"))
        self.sensors.restore(part(state, "mapper.sensors"))
        self.update_ms = state["mapper.update_ms"].tolist()
        self._pending, self._sent_frames = set(), len(self.history.since(0))
        changes, until_s = self.changes, time.monotonic() + RestartPolicy().start_s
        while self.changes == changes:  # its first answer is the whole map
            self._apply_answers(self.worker.receive(0.1))
            if self.worker.has_crashed or time.monotonic() > until_s:
                raise InputError(f"{path}: the map's process cannot go on from it")

    def finish(self, timeout_s: float, frames: Arrays) -> Path:
        """As ``RemoteMapper.finish``."""
        self._finishes = True
        return super().finish(timeout_s, frames)


class LockstepSegmenter(RemoteSegmenter):
    """A remote segmenter whose masks are used at frames that are the same in every run.

    Attributes:
        memory: masks of images; those that it knows are not made again.
    """

    def __init__(self, options: SegmenterOptions, sequence: Path, upright: Upright) -> None:
        super().__init__(options, sequence, upright=upright)
        self.memory = MaskMemory()
        self.begin()

    def begin(self) -> None:
        """The run begins, or begins anew."""
        self.urgent = {}
        self._images = Delayed[ImageToSegment](LAG_S)  # of which masks will be used
        self._found: dict[int, Masks] = {}

    def begin_frame(self, timestamp_s: float) -> None:
        """A frame begins: masks that were requested some frames ago are due."""
        self._images.begin_frame(timestamp_s)

    def use_all(self) -> None:
        """All masks that were requested are due."""
        self._images.all_due()

    @property
    def waiting(self) -> int:
        """Number of keyframes whose masks were not used yet."""
        return len(self._images)

    def awaits(self, keyframe_id: int) -> bool:
        """Whether the masks of a keyframe may still be used."""
        return any(image.keyframe_id == keyframe_id for image in self._images)

    def request(self, image: ImageToSegment) -> None:
        """Request the masks of a keyframe; returns at once."""
        self._images.add(image)
        known = self.memory.recall(image.name)
        if known is None:
            super().request(image)
        else:
            self._found[image.keyframe_id] = Masks(image.keyframe_id, known)

    def receive_masks(self) -> list[Masks]:
        """The masks that are due, once they have come."""
        due = []
        for image in self._images.take():
            number = image.keyframe_id
            while number not in self._found and super().awaits(number):
                self._found |= {masks.keyframe_id: masks for masks in super().receive_masks()}
                time.sleep(0.001)
            if (masks := self._found.pop(number, None)) is not None:
                self.memory.keep(image.name, masks.instances)
                due.append(masks)
        return due
