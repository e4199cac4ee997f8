"""A system whose map and masks are in processes of their own, in lockstep with tracking."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path

from bmask_slam.back_end.mapper import Mapper
from bmask_slam.features.brisk import Features
from bmask_slam.graph.arrays import Arrays
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.files.array_file import nested, part, read_arrays, write_arrays
from bmask_slam.live.messages import STATE_FILE
from bmask_slam.live.processes.map_return import MapPlace
from bmask_slam.live.system import LiveSystem
from bmask_slam.parallel.lockstep import LockstepMapper, LockstepSegmenter
from bmask_slam.runtime.scratch import scratch_folder
from bmask_slam.semantics.segmenters.segmenter_table import LabelsOnly, SegmenterOptions
from bmask_slam.semantics.segmenters.upright import Upright
from bmask_slam.sequences.frame import Frame
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import FrameResult


class ParallelSystem(LiveSystem):
    """Tracks in this process; map and masks follow in others, at frames that do not vary.

    State, graph and map are those after all that was sent to the others was done.
    """

    remote: LockstepMapper
    segmenter: LockstepSegmenter | None
    mapper_type = LockstepMapper

    def __init__(
        self,
        camera: Camera,
        config: SystemConfig,
        segmenter: LockstepSegmenter | None,
        scratch: Path,
    ) -> None:
        """Start the map's process, whose temporary files go to ``scratch``."""
        self._state_file = scratch / "state"
        self._whole: tuple[int, Arrays] = -1, {}  # after so many messages
        self._read: tuple[int, Mapper] | None = None
        super().__init__(camera, config, MapPlace(scratch), segmenter)

    def process(self, frame: Frame, features: Features | None = None) -> FrameResult:
        """Use what is due of the other processes, then do the same step as one process does."""
        self.remote.begin_frame(frame.timestamp_s)
        if self.segmenter is not None:
            self.segmenter.begin_frame(frame.timestamp_s)
            if self.segmenter.urgent:
                self._use_all()
        result = super().process(frame, features)
        self.remote.end_frame()
        return result

    @property
    def mapper(self) -> Mapper:
        """Map and graph as they are now."""
        if isinstance(self.map, Mapper):
            return self.map
        state, sent = self.state(), self.remote.worker.sent
        if self._read is None or self._read[0] != sent:
            self._read = sent, self._offline(state).mapper
        return self._read[1]

    def state(self) -> Arrays:
        """See `SlamSystem.state`; waits for the other processes."""
        if isinstance(self.map, Mapper):
            return super().state()
        self._settle()
        if self._whole[0] != self.remote.worker.sent:
            self.remote.write_state(self._state_file)
            state = read_arrays(self._state_file, STATE_FILE)[1]
            self._whole, self._read = (self.remote.worker.sent, state), None
        return {
            **self._whole[1],
            **self._progress(),
            "mapper.events.now": self.events.state()["now"],
            **nested(
                localiser=self.camera_tracker.state(),
                dynamics=self.moving_objects.state(),
                frames=self.frame_observations.state(),
            ),
        }

    def restore(self, state: Arrays, path: Path) -> None:
        """See `SlamSystem.restore`."""
        state = self._offline(state, path).state()  # checked, and as this version has it
        self._begin_with(state)
        self.camera_tracker.restore(part(state, "localiser"))
        self.moving_objects.restore(part(state, "dynamics"))
        self.frame_observations.restore(part(state, "frames"))

    def restart(self) -> None:
        """Go on with a new process and a new copy of the map, as a restored system does."""
        self._begin_with(self.state())

    def _begin_with(self, state: Arrays) -> None:
        """Let the map's process, and the copy of the map, begin with a state."""
        write_arrays(self._state_file, STATE_FILE, {"camera": asdict(self.camera)}, state)
        self.remote.begin_with(self._state_file, state)
        now = {"now": state["mapper.events.now"]}
        self.events.restore({**self.events.state(), **now})
        self._restore_progress(state)  # the reference is of the new copy
        self._whole = self.remote.worker.sent, state

    def _offline(self, state: Arrays, path: Path | None = None) -> SlamSystem:
        """A system of one process in a state, which comes from a file if one is named."""
        labels = LabelsOnly(self.label_names, self.config.semantics.segmenter)
        system = SlamSystem(self.camera, self.config, labels)
        system.restore(state, path or self._state_file)
        return system

    def _settle(self) -> None:
        """Use all that is still to come of the other processes."""
        self.remote.send_frames()
        self._use_all()

    def _use_all(self) -> None:
        """Use all that the other processes make of what they were sent."""
        if self.segmenter is not None:
            self.segmenter.use_all()
        sent = -1
        while sent != self.remote.worker.sent:
            sent = self.remote.worker.sent
            self.remote.all_due()
            self.catch_up()

    def finish(self) -> None:
        """The last optimisation; afterwards map and graph are in this process."""
        self._settle()
        super().finish()


class ParallelSystems:
    """Makes the systems of a run; one that begins anew takes over the segmenter's process.

    Attributes:
        segmenter: None for a run without masks.
    """

    def __init__(self, masks: SegmenterOptions, sequence: Path, upright: Upright) -> None:
        """Start the segmenter, for the images of a sequence. Raises InputError if it cannot."""
        about = masks, sequence, upright
        self.segmenter = None if masks.name == "none" else LockstepSegmenter(*about)
        self._scratch = ExitStack()
        self._folder = self._scratch.enter_context(scratch_folder())
        self._last: ParallelSystem | None = None

    def __call__(self, camera: Camera, config: SystemConfig) -> ParallelSystem:
        """A new system; the one before is ended."""
        if self._last is not None:
            self._last.remote.close()
        if self.segmenter is not None:
            self.segmenter.begin()
        self._last = ParallelSystem(camera, config, self.segmenter, self._folder)
        return self._last

    def close(self) -> None:
        """End all processes."""
        if self._last is not None:
            self._last.close()
        if self.segmenter is not None:
            self.segmenter.close()
        self._scratch.close()
