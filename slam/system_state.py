"""What a system saves, and how it goes on from it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bmask_slam.graph.arrays import Arrays
from bmask_slam.graph.files.array_file import fitting, nested, part
from bmask_slam.moving.moving_object_filter import MovingObjectFilter
from bmask_slam.sensor_input import SensorSystem
from bmask_slam.system_results import checked_state
from bmask_slam.tracking.keyframe_decision import KeyframeDecision


class SavedSystem(SensorSystem):
    """The state of a system, and sessions that begin with the map of another."""

    moving_objects: MovingObjectFilter
    keyframes: KeyframeDecision

    def state(self) -> Arrays:
        """All that the system has learned, as named arrays; masks to come are waited for."""
        self.semantics.use_masks(everything=True)
        return {
            **self._progress(),
            **nested(
                mapper=self.mapper.state(),
                localiser=self.camera_tracker.state(),
                semantics=self.semantics.state(),
                dynamics=self.moving_objects.state(),
                frames=self.frame_observations.state(),
            ),
        }

    def restore(self, state: Arrays, path: Path) -> None:
        """Become the system of a state that was read from a file. Raises InputError."""
        state = checked_state(state, self.state(), path)
        with fitting(path):
            self.mapper.restore(part(state, "mapper"), path)
            if "mapper.sensors.made" not in state:  # no measurement yet, nor any before
                self.mapper.sensors.begin_session(int(state["first_keyframe"]))
            self.camera_tracker.restore(part(state, "localiser"))
            self.semantics.restore(part(state, "semantics"), path)
            self.moving_objects.restore(part(state, "dynamics"))
            self.frame_observations.restore(part(state, "frames"))
        self._restore_progress(state)

    def _progress(self) -> Arrays:
        """Where in the map tracking is, and since when."""
        reference = self.camera_tracker.reference
        return {
            "segment": np.array(self.camera_tracker.segment),
            "reference": np.array(-1 if reference is None else reference.id),
            "frames_since_keyframe": np.array(self.keyframes.frames_since),
            "first_keyframe": np.array(self._first_keyframe),
            **nested(label_views=self.semantics.decision.state()),
        }

    def _restore_progress(self, state: Arrays) -> None:
        self.camera_tracker.segment = int(state["segment"])
        self.camera_tracker.reference = self.map.world.keyframes.get(int(state["reference"]))
        self.keyframes.frames_since = int(state["frames_since_keyframe"])
        self._first_keyframe = int(state["first_keyframe"])
        self.semantics.decision.restore(part(state, "label_views"))

    def restart(self) -> None:
        """Rebuild what a state cannot hold: from here on the system goes on like a restored one."""
        self.mapper.restart()

    def begin_session(self) -> None:
        """Go on with the map in another recording; nothing else is kept."""
        self.keyframes.made()
        self._first_keyframe = self.map.world.next_keyframe_id
        self.mapper.begin_session()
        self.semantics.begin_session()
        self.moving_objects.begin_session()
        self.camera_tracker.begin_session()
        self.frame_observations.clear()
