"""The camera of a run that uses a map: its sequence's, with what the run of the map has found."""

from __future__ import annotations

import logging
from collections.abc import Container
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from bmask_slam.back_end.reinterpretation import KeyframeMotion
from bmask_slam.calibration.adoption import (
    DOWNWARDS,
    UPWARDS,
    SelfCalibration,
    in_other_order,
)
from bmask_slam.calibration.keyframe_motions import keyframe_motions
from bmask_slam.graph.arrays import Arrays
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.array_file import part
from bmask_slam.offline.options import RunOptions
from bmask_slam.run_folder.map_file import read_map
from bmask_slam.sequences.camera_presets import is_preset
from bmask_slam.sequences.sequence import Sequence
from bmask_slam.system import SlamSystem
from bmask_slam.world.frame_history import FrameHistory
from bmask_slam.world.map_state import world_of

logger = logging.getLogger(__name__)

FOUND = ("rolling_shutter_s", "depth_time_offset_s", "depth_distortion")
"""What runs find of their camera and adopt."""
OF_IMAGES = ("depth_noise", "up", "covered", "fps")
"""What does not decide where points are, so that it may differ between the runs of one map."""
DEFAULTS = {f.name: f.default for f in fields(Camera)}


def inherited_calibration(options: RunOptions, sequence: Sequence) -> SelfCalibration:
    """The camera to begin with: the sequence's own, or what the run of the map has found of it.

    What a file given as ``options.camera`` says of readout, delay and distortion is kept.
    """
    given, source = sequence.camera, options.map or options.localise
    if options.calibrate == "off" or source is None:
        return SelfCalibration(given, given)
    made = read_map(source)[1]
    named = None if is_preset(options.camera) else options.camera
    said = {n for n in FOUND if named and getattr(given, n) != DEFAULTS[n]}
    camera = with_found_of(made, given, said)
    if camera == given or set(_differing(made, camera)) - said:
        return SelfCalibration(given, given)
    text, rows = f"camera as found by {source}", ""
    if given.rolling_shutter_s * camera.rolling_shutter_s < 0:
        given = in_other_order(given)
        rows = UPWARDS if given.rolling_shutter_s < 0 else DOWNWARDS
    return SelfCalibration(given, camera, text, rows=rows)


def with_found_of(made: Camera, camera: Camera, but: Container[str] = ()) -> Camera:
    """A camera with what was found of another one, ``but`` some attributes."""
    found: dict[str, Any] = {n: getattr(made, n) for n in FOUND if n not in but}
    return replace(camera, **found)


def use_own_camera(system: SlamSystem, state: Arrays, camera: Camera) -> None:
    """Let a system with the map of a state go on with the camera that was found since.

    Depths of its keyframes keep their delay, as their images are not at hand.
    """
    if camera != system.camera:
        logger.info("the map follows the camera of this run: %s", camera)
        system.use_camera(camera, recorded_motions(state))


def recorded_motions(state: Arrays) -> dict[int, KeyframeMotion]:
    """The motion of the keyframes that the last run of a map has tracked, by id."""
    world, history = world_of(part(state, "mapper.world")), FrameHistory()
    history.restore(part(state, "mapper.history"))
    paths = history.trajectories(world)
    tracked = {stamp_s for path in paths.values() for stamp_s in path.timestamps_s.tolist()}
    known = [k for k in world.keyframes.values() if k.timestamp_s in tracked]
    return keyframe_motions(known, paths, None)


def check_own_camera(source: Path, made: Camera, sequence: Sequence) -> None:
    """Refuse to continue a map with another camera than it was made with. Raises InputError."""
    camera = sequence.camera
    names = _differing(made, camera)
    if not names:
        return
    cure = "give --full-size; " if made.reduced_by < camera.reduced_by else ""
    if others := [n for n in names if n not in FOUND]:
        names = others  # the others are taken over where these are the same
    else:
        cure = (
            "leave out --calibrate off, and what a file given by --camera says of it, to go on "
            "with what that run found; or run the sequence by itself, and bmask-slam merge; "
        )
    told = ", ".join(f"{n} {getattr(made, n)} and {getattr(camera, n)}" for n in names)
    raise InputError(
        f"{source}: made with another camera than that of {sequence.folder} ({told}); "
        f"{cure}a map can only be continued with its own camera (--localise accepts any)"
    )


def _differing(made: Camera, now: Camera) -> list[str]:
    """The attributes in which two cameras differ that decide where points are."""
    names = (f.name for f in fields(Camera) if f.name not in OF_IMAGES)
    return [n for n in names if getattr(made, n) != getattr(now, n)]
