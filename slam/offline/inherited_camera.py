"""The camera of a run that uses a map: its sequence's, with what the run of the map has found."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from bmask_slam.calibration.adoption import SelfCalibration
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.offline.options import RunOptions
from bmask_slam.run_folder.map_file import read_map
from bmask_slam.sequences.sequence import Sequence

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
    said = {n for n in FOUND if options.camera and getattr(given, n) != DEFAULTS[n]}
    found: dict[str, Any] = {n: getattr(made, n) for n in FOUND if n not in said}
    camera = replace(given, **found)
    if camera == given or set(_differing(made, camera)) - said:
        return SelfCalibration(given, given)
    return SelfCalibration(given, camera, f"camera as found by {source}")


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
