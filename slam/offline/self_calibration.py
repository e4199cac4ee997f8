"""Self-calibration in a run: what its first frames show of the camera, found and adopted.

The run itself is the first stretch. After some frames the readout time of the rolling shutter, and
the delay and the distortion of the depth images, are estimated from its map
(`calibration.rematching`). The focal lengths are estimated along with them but keep their values:
those of a published calibration are better than what a short stretch shows, and an error of the
depth scale, which images and depths alone do not show, would be taken for one of theirs. A readout
time that the camera has is kept. Whether they are adopted is decided in `calibration.adoption`. If
none is, the run goes on; else it begins anew, once, with the camera that was found. If edges of
depth show a delay that is far from a right camera's, it begins anew with that before
(`calibration.camera_check`).

After the last frame such a run is looked at once more. Its map shows more than the first stretch,
and was not bent by the wrong camera. The keyframes are interpreted anew with what is found then,
before the last optimisation; no frame is tracked again.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from bmask_slam.back_end.reinterpretation import KeyframeMotion
from bmask_slam.calibration.adoption import (
    Estimate,
    SelfCalibration,
    format_found,
    judged,
    with_other_order,
)
from bmask_slam.calibration.config import FREE, SelfCalibrationConfig
from bmask_slam.calibration.edge_delay import sure_registration, with_sure_delay
from bmask_slam.calibration.edge_scores import edge_scores
from bmask_slam.calibration.keyframe_motions import (
    depth_change_between,
    frame_motions,
    keyframe_motions,
)
from bmask_slam.calibration.rematching import estimate_again
from bmask_slam.calibration.views import SequenceDepths
from bmask_slam.graph.arrays import Array, Ints, no_ids
from bmask_slam.graph.calibration.model import TIME
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.labelling.mask_memory import MaskMemory
from bmask_slam.sequences.sequence import Sequence
from bmask_slam.system import SlamSystem
from bmask_slam.system_interface import System
from bmask_slam.world.keyframe import Keyframe

logger = logging.getLogger(__name__)

Motions = Mapping[int, KeyframeMotion]
OTHER_DELAY_S = 0.01
"""Edges and motion may differ by so much."""


class SelfCalibrator:
    """Looks at a run now and then until its camera is settled.

    Attributes:
        state: what was found so far; all that a checkpoint has to keep.

    Args:
        mode: "auto": what is sure is adopted; "report": it is only said; "off".
        masks: kept while the run may begin anew.
    """

    def __init__(
        self,
        state: SelfCalibration,
        mode: str,
        masks: MaskMemory | None = None,
        config: SelfCalibrationConfig | None = None,
    ) -> None:
        self.state = state
        self._mode, self._masks = mode, masks
        self._config = config or SelfCalibrationConfig()
        self._forget_masks()

    @property
    def finished(self) -> bool:
        """Whether it does not look at the run any more."""
        looked = self.state.looks >= self._config.stretches
        return self._mode == "off" or self.state.settled or looked

    def is_due(self, frames: int, last: bool) -> bool:
        """Whether it looks after a number of frames: n, 2n, 4n, or the last of them."""
        if self.finished:
            return False
        looks, n = self.state.looks, self._config.frames
        before = n * 2 ** (looks - 1) if looks else 0
        return frames == n * 2**looks or (last and frames - before >= self._config.min_frames)

    def look(self, system: System, sequence: Sequence) -> bool:
        """Take what the run shows by now into account; whether it is to begin anew."""
        before = self.state
        self.state = self._by_edges(system, sequence) or self._by_motion(system, sequence)
        text = self.state.text
        if text != before.text:
            logger.info("calibration: %s", text)
        if self.state.camera == before.camera and text != before.text:
            system.events.calibration(text)
        self._forget_masks()
        return self.state.camera != before.camera

    def look_back(
        self, system: System, sequence: Sequence, earlier: Callable[[], Motions] = dict
    ) -> bool:
        """After the last frame: use what all frames show; whether the camera is another one now.

        ``earlier`` reads the motion of the keyframes of a map that the run has continued.
        """
        before = self.state
        looked = before.adopted or (self.finished and not before.settled)
        if self._mode != "auto" or not looked or not isinstance(system, SlamSystem):
            return False
        if len(system.trajectory()) < self._config.min_frames:  # of a map that was continued
            return False
        estimate = self._estimate(system, sequence)
        if estimate is not None and estimate.in_other_order:
            system.events.calibration(with_other_order(before, "report").text)
        elif estimate is not None:
            self.state = judged(before, estimate, self._mode, self._config)
        camera = self.state.camera
        if camera == before.camera:
            return False
        try:
            motions = earlier()
        except InputError as error:  # the map was there when the run began
            logger.warning("the camera stays as it was: %s", error)
            self.state = before
            return False
        of_keyframes, of_frames = _motions(system, sequence, camera)
        system.events.calibration(self.state.text)
        system.use_camera(camera, {**motions, **of_keyframes}, of_frames)
        return True

    def _by_edges(self, system: System, sequence: Sequence) -> SelfCalibration | None:
        """The state with a delay of depth that its edges show, if that is large."""
        if self._mode != "auto" or self.state.adopted or not isinstance(system, SlamSystem):
            return None
        try:
            scores = edge_scores(sequence, system.as_run().trajectories["trajectory.txt"])
        except InputError as error:
            logger.info("calibration: %s", error)
            return None
        found = sure_registration(scores)
        return with_sure_delay(self.state, found, sequence.camera.depth_time_offset_s)

    def _by_motion(self, system: System, sequence: Sequence) -> SelfCalibration:
        """The state with what observations and depths of the map show.

        A delay that edges showed is taken back if the motion contradicts it.
        """
        before, estimate = self.state, self._estimate(system, sequence)
        if estimate is None:
            return replace(before, looks=before.looks + 1)
        if estimate.in_other_order:
            return with_other_order(before, self._mode)
        found = judged(before, estimate, self._mode, self._config)
        if not before.adopted:
            return found
        if found.camera == before.camera and self._is_other_delay(estimate, found.camera):
            text = f"{before.text.partition(':')[0]}: the motion contradicts it"
            return replace(found, camera=before.given, text=text, settled=True)
        return replace(found, settled=True)

    def _is_other_delay(self, estimate: Estimate, camera: Camera) -> bool:
        """Whether the motion surely shows another delay of depth than a camera has."""
        off_s = abs(estimate.found[TIME] - camera.depth_time_offset_s)
        least_s = max(self._config.min_change_sigmas * estimate.sigmas[TIME], OTHER_DELAY_S)
        return estimate.shows(TIME, self._config) and bool(off_s > least_s)

    def _forget_masks(self) -> None:
        if self._masks is not None and (self.finished or self._mode == "report"):
            self._masks.forget()

    def _estimate(self, system: System, sequence: Sequence) -> Estimate | None:
        """What the run shows of its camera; None if that is too little."""
        if not isinstance(system, SlamSystem):
            return None
        world, worth_s = system.mapper.world, self._config.min_change_s
        try:
            reader, given = _reader(system, sequence), self.state.given
            estimate = estimate_again(world, system.as_run(), reader, given, worth_s)
        except InputError as error:
            logger.info("calibration: %s", error)
            return None
        if estimate is not None:
            logger.info("calibration: %s", format_found(estimate, FREE, "estimated"))
        return estimate


def _reader(system: SlamSystem, sequence: Sequence) -> SequenceDepths:
    stamps_s = {k.id: k.timestamp_s for k in system.session_keyframes()}
    return SequenceDepths(stamps_s, sequence)


def _motions(
    system: SlamSystem, sequence: Sequence, camera: Camera
) -> tuple[dict[int, KeyframeMotion], dict[float, KeyframeMotion]]:
    """By what keyframes and other frames are interpreted anew with a camera that was found."""
    offset_s, paths = camera.depth_time_offset_s, system.segments()
    retimed = sequence.with_delay(offset_s)
    late = offset_s != sequence.camera.depth_time_offset_s

    def change(stamp_s: float, pixels: Array) -> tuple[Ints, Array]:
        try:
            seen = stamp_s, pixels
            return depth_change_between(sequence, retimed, seen, system.config.features)
        except InputError as error:
            logger.warning("calibration: the delay of a frame's depth stays: %s", error)
            return no_ids(), np.zeros(0)

    def of_keyframe(keyframe: Keyframe) -> tuple[Ints, Array]:
        return change(keyframe.timestamp_s, keyframe.features.image_pixels)

    return (
        keyframe_motions(system.session_keyframes(), paths, of_keyframe if late else None),
        frame_motions(system.frame_observations, paths, change if late else None),
    )
