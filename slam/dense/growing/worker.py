"""The dense map's process at work on its surface, as long as the disk has room for one."""

from __future__ import annotations

import gc
import logging
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from bmask_slam.dense.folder import DenseFolder
from bmask_slam.dense.growing.frames import FrameOptions, FramesTaken, SurfaceFrame
from bmask_slam.dense.growing.store import FrameStore
from bmask_slam.dense.growing.surface import PARTS_AT_ONCE, GrowingSurface
from bmask_slam.dense.options import MapOptions, fusion_config
from bmask_slam.dense.products import GrownSurface
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.mapping.inverse_depth.dense_mapper import FusedKeyframe
from bmask_slam.mapping.surface.extraction import NOTHING

logger = logging.getLogger(__name__)

SHOW_S = 0.5
"""Parts of the surface are shown so far apart."""
RETRY_S = 30.0
"""So long after a full disk the surface is begun again."""


class SurfaceWorker:
    """A growing surface and its frames' files; tells tracking how far it is.

    Attributes:
        excluded: numbers of the classes that are left out.
        grows: whether it works before ``finish``.
        is_shown: whether parts that change are sent.
    """

    def __init__(
        self,
        folder: DenseFolder,
        camera: Camera,
        options: MapOptions,
        frames: FrameOptions,
        send: Callable[[Any], None],
    ) -> None:
        """``options`` are resolved; answers go to ``send``. Raises InputError: a link."""
        self.excluded: list[int] = []
        self.grows, self.is_shown = True, False
        self._folder, self._camera, self._options, self._send = folder, camera, options, send
        self._frames = FrameStore(folder.path, camera, frames.max_bytes)
        self._measurement = fusion_config(options).measurement  # the run folder may move
        self._poses: dict[int, Array] = {}
        self._surface: GrowingSurface | None = None
        self._begin_s = self._show_s = 0.0
        self._told: FramesTaken | None = None

    def add_frame(self, frame: SurfaceFrame) -> None:
        """Store a frame; it is integrated later."""
        self._frames.add(frame)
        self._tell(frame.number)

    def place(self, poses: dict[int, Array]) -> None:
        """Know the keyframes' poses, see ``GrowingSurface.place``."""
        self._poses = poses
        if self._surface is not None:
            self._surface.place(poses)

    def reopen(self) -> None:
        """The folder is another one."""
        self._frames.open_in(self._folder.path)
        if self._surface is not None:
            self._surface.reopen()

    def add_keyframe(self, result: FusedKeyframe) -> None:
        """A keyframe is fused and saved."""
        if self._surface is not None:
            self._surface.add(result)

    def mask(self, keyframe_id: int) -> None:
        """More of a fused keyframe was cut out."""
        if self._surface is not None:
            self._surface.mask(keyframe_id)

    def remove(self, keyframe_ids: list[int]) -> None:
        """Keyframes are not in the map any more."""
        if self._surface is not None:
            self._surface.remove(keyframe_ids)

    def work(self) -> bool:
        """Let the surface grow a little; whether there is more to do."""
        if not self.grows or time.monotonic() < self._begin_s:
            return False
        worked, failure = False, ""
        try:
            worked = self._begun().step()
        except InputError as error:
            failure = str(error)
        if failure:
            self._end()
            self._begin_s = time.monotonic() + RETRY_S
            logger.warning("%s; the surface is begun again later", failure)
            return False
        self._tell()
        if self.is_shown and time.monotonic() > self._show_s:
            worked |= self._show(PARTS_AT_ONCE)
        return worked

    def finish(self) -> GrownSurface:
        """The surface of all that has come; of keyframes alone where the disk is full.

        Raises:
            InputError: it is too full for these, too.
        """
        whole, failure = NOTHING, ""
        try:
            whole = self._begun().whole()
        except InputError as error:
            failure = str(error)
        if failure:
            logger.warning("%s; the surface is made of keyframes alone", failure)
            self._frames.clear()
            self._end()
            whole = self._begun().whole()
        surface = self._begun()
        if self.is_shown:
            self._show(len(whole.vertices))
        self._tell()
        frames, keyframes = surface.integrated, max(len(surface.fused), 1)
        return GrownSurface(whole, frames, (frames + keyframes) / keyframes)

    def clear(self) -> None:
        """Remove the frames' files."""
        self._frames.clear()

    def _begun(self) -> GrowingSurface:
        """The surface, begun if there is none. Raises InputError: the disk is full."""
        if self._surface is None:
            made_of = self._folder, self._frames, self._camera, self._options, self._measurement
            self._surface = GrowingSurface(*made_of, self.excluded)
            self._surface.place(self._poses)
        return self._surface

    def _end(self) -> None:
        """Give the volume's room on the disk back; an exception that is handled would hold it."""
        self._surface = None
        gc.collect()  # it is in a circle of objects

    def _show(self, most: int) -> bool:
        """Send parts that have changed; whether there were some."""
        parts = self._begun().changed_parts(most)
        for part in parts:
            self._send(part)
        self._show_s = time.monotonic() + SHOW_S
        return bool(parts)

    def _tell(self, number: int = -1) -> None:
        """Tell how far the surface is, if that is new or a frame has come."""
        surface = self._surface
        backlog = 0 if surface is None else sum(n >= 0 for n in surface.due())
        integrated = 0 if surface is None else surface.integrated
        told = FramesTaken(number, backlog, integrated, self._frames.unwritten)
        if told != self._told:
            self._send(told)
            self._told = replace(told, number=-1)
