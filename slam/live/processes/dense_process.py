"""The dense map's process: fuses keyframes into submaps, as ``bmask-slam map`` does.

Between messages the surface grows, of keyframes and of the frames that are sent between them.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2

from bmask_slam.dense.folder import DenseFolder, folder_settings
from bmask_slam.dense.growing.frames import SurfaceFrame
from bmask_slam.dense.growing.worker import SurfaceWorker
from bmask_slam.dense.keyframe_fusion import FusionCounts, KeyframeFusion
from bmask_slam.dense.keyframe_input import dense_keyframe
from bmask_slam.dense.map_run import MapSummary, write_summary
from bmask_slam.dense.options import MapOptions, resolve_options
from bmask_slam.dense.products import write_products
from bmask_slam.dense.saved_map import read_saved_map
from bmask_slam.dense.surface import FusedMap
from bmask_slam.graph.errors import InputError
from bmask_slam.live.channel import Channel
from bmask_slam.live.messages import Ready
from bmask_slam.live.processes.dense_messages import (
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
from bmask_slam.mapping.inverse_depth.dense_mapper import FusedKeyframe
from bmask_slam.mapping.products.submaps import make_submap
from bmask_slam.mapping.products.surface_labels import InstanceEvidence
from bmask_slam.run_folder.folder import DISK_ERRORS
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.torch_threads import one_thread

logger = logging.getLogger(__name__)

NICENESS = 15
IDLE_S = 1.0


def serve_dense(channel: Channel, setup: DenseSetup) -> None:
    """Map keyframes until the channel ends."""
    os.nice(NICENESS)
    cv2.setNumThreads(1)
    server = DenseServer(setup, channel.send)
    channel.send(Ready())
    with one_thread():
        _serve(channel, server)


def _serve(channel: Channel, server: DenseServer) -> None:
    has_work = True
    while True:
        messages = channel.receive(0.0 if has_work else IDLE_S)
        for message in messages:
            server.handle(message)
        if not messages and not channel.open:
            return
        has_work = server.growing.work()


class RetryingFolder(DenseFolder):
    """The folder of a dense map that goes on when the disk is full.

    Attributes:
        unwritten: keyframes whose submaps could not be written, and why.
    """

    def __init__(self, run: Path, settings: dict[str, Any]) -> None:
        self.unwritten: dict[int, str] = {}
        super().__init__(run, settings)

    def follow(self, run: Path) -> None:
        """Go on in another run folder; if that cannot be used, ``write`` says so each time."""
        with suppress(InputError):
            self.open_in(run)

    def write(self, result: FusedKeyframe, evidence: InstanceEvidence) -> None:
        """Save a finished keyframe, or record why it cannot be saved."""
        try:
            super().write(result, evidence)
        except InputError as error:
            self.unwritten[result.keyframe.id] = str(error)
            self.remove(result.keyframe.id)


class DenseServer:
    """Handles the messages of tracking; answers go to ``send``.

    Attributes:
        growing: the surface.
    """

    def __init__(self, setup: DenseSetup, send: Callable[[Any], None]) -> None:
        """Start a dense map, or continue one that another process left. Raises InputError."""
        self._setup, self._send, self._run = setup, send, setup.run
        self._labels = LabelSet(setup.labels)
        asked = MapOptions(setup.run, masks=setup.masks, mesh_voxel_m=setup.mesh_voxel_m)
        self._options = resolve_options(asked, self._labels)
        settings = folder_settings(self._options, self._labels)
        self._folder = RetryingFolder(setup.run, settings)
        self._fusion = KeyframeFusion(setup.camera, self._labels, self._folder, self._options)
        self.growing = SurfaceWorker(self._folder, setup.camera, self._options, setup.frames, send)
        self.growing.excluded = [self._labels.number(n) for n in self._options.excluded or ()]
        self.growing.grows = setup.grows

    def handle(self, message: Any) -> None:
        """Handle one message."""
        match message:
            case KeyframeToMap():
                self.add_keyframe(message)
                self._send(Accepted(message.id))
            case LateMasks():
                self.relabel(message)
            case RemoveKeyframes():
                self._fusion.remove(message.keyframe_ids)
                self.growing.remove(message.keyframe_ids)
            case SurfaceFrame():
                self.growing.add_frame(message)
            case MapPoses():
                self.growing.place(message.by_id())
            case ShowSurface():
                self.growing.is_shown = True
            case RunMoved():
                self._run = message.run
                self._folder.follow(message.run)
                self.growing.reopen()
            case FinishMap():
                self._fusion.update_poses(message.poses)
                self._report(self._fusion.finish())
                self._send(self.write_products(message))
            case _:
                raise TypeError(f"not a message for the dense map: {message!r}")

    def add_keyframe(self, message: KeyframeToMap) -> None:
        """Fuse a keyframe, and report the submaps that are finished by it."""
        snapshot = message.snapshot
        if self._folder.is_done(snapshot.id):  # saved by a process that died before its answer
            self._send(Mapped(snapshot.id))
        try:
            dense = dense_keyframe(snapshot, self._setup.camera)
        except InputError as error:
            self._send(NotMapped(snapshot.id, str(error)))
            return
        instances = self._fusion.label_pixels(
            message.instances, snapshot.landmark_ids, snapshot.pixels
        )
        self._report(self._fusion.add(dense, snapshot.segment, instances, message.poses))

    def relabel(self, message: LateMasks) -> None:
        """Use masks that come after their keyframe."""
        instances = self._fusion.label_pixels(
            message.instances, message.landmark_ids, message.pixels
        )
        try:
            self._fusion.relabel(message.keyframe_id, instances)
        except InputError as error:
            logger.warning("keyframe %d keeps its old labels: %s", message.keyframe_id, error)
            return
        if instances.excluded.any():
            self.growing.mask(message.keyframe_id)

    def write_products(self, message: FinishMap) -> MapWritten:
        """Write the clouds from the run folder's final map."""
        started_s = time.perf_counter()
        try:
            run = read_saved_map(self._run)
            missing = [k.id for k in run.keyframes if not self._folder.is_done(k.id)]
            fused = FusedMap(run, self._labels, self._folder, self._options)
            if not fused.keyframes():
                return MapWritten(missing=missing, failure="no keyframe has a submap")
            grown = self.growing.finish()
            products = write_products(fused, grown=grown)
            counts = self._counts(missing, message.skipped)
            products_s = time.perf_counter() - started_s
            write_summary(self._folder, MapSummary(self._folder.path, counts, products, products_s))
            self.growing.clear()
        except (InputError, OSError) as error:
            if isinstance(error, OSError) and error.errno not in DISK_ERRORS:
                raise
            return MapWritten(failure=str(error))
        return MapWritten(products.points, missing, frames=grown.frames)

    def _counts(self, missing: list[int], skipped: dict[int, str]) -> FusionCounts:
        """Counts of the keyframes, with those that were not sent to this process."""
        reasons = self._folder.unwritten | skipped
        counts = self._fusion.counts
        counts.skipped = {number: reasons.get(number, "") for number in missing}
        return counts

    def _report(self, finished: list[FusedKeyframe]) -> None:
        """Send which keyframes are saved, with a preview for the viewer."""
        for result in finished:
            number = result.keyframe.id
            reason = self._folder.unwritten.get(number)
            if reason is None:
                self.growing.add_keyframe(result)
                self._send(Mapped(number, self._preview(result)))
            else:
                self._send(NotMapped(number, reason, disk_full=True))

    def _preview(self, result: FusedKeyframe) -> Preview | None:
        if not self._setup.shown:
            return None
        submap = make_submap(result, self._setup.camera, self._options.voxel_m)
        step = -(-len(submap) // self._setup.shown) or 1
        return Preview(submap.points[::step].copy(), submap.colours[::step].copy())
