"""What a live run is asked for, and the start of its processes: all of them, or none."""

from __future__ import annotations

import math
import os
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING

from bmask_slam.calibration.config import BENDS, CALIBRATE, SelfCalibrationConfig
from bmask_slam.graph.calibration.model import SHUTTER, TIME
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.live.network.workstation import Workstation
from bmask_slam.live.processes.calibration_process import CalibrationSetup
from bmask_slam.live.processes.map_return import MapPlace
from bmask_slam.live.processes.remote_calibration import RemoteCalibration
from bmask_slam.live.processes.segmentation import RemoteSegmenter
from bmask_slam.live.system import LiveSystem
from bmask_slam.moving.covered_parts import CoveredWatch
from bmask_slam.run_folder.origin import Origin
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.segmenters.segmenter import NoSegmenter
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions
from bmask_slam.semantics.segmenters.upright import Upright
from bmask_slam.system_config import SystemConfig
from bmask_slam.viewer.options import ViewOptions

if TYPE_CHECKING:
    from bmask_slam.dense.growing.frames import FrameOptions
    from bmask_slam.live.processes.remote_dense import RemoteDenseMapper

PREVIEW_POINTS = 3000
"""Largest number of points of a submap that a viewer gets."""


@dataclass(frozen=True)
class LiveOptions:
    """What a live run writes and shows, and what it is compared with.

    Attributes:
        out: run folder, as an offline run's, also as text; None: nothing is written.
        overwrite: replace the run that ``out`` holds.
        reference: trajectory to compare with at the end.
        view: where a viewer shows the run, if at all.
        images: folder that the frames are read from, if any: a segmenter looks masks up for it, and
            ``bmask-slam map`` reads it.
        title: of the plot of the trajectory.
        dense: make a dense map as well; needs ``out``.
        mesh_voxel_m: edge of its voxels, for a preview; None: 0.01.
        surface_frames: which tracked frames are in the dense map besides keyframes; None:
            five a second.
        submap_points: number of points of each submap that `LiveSlam.on_submap` gives.
        calibrate: whether readout time, depth delay and bend of depth are found while it runs:
            ``auto`` uses what is found, ``report`` only says so, ``off``.
        straightens: whether the source straightens depth by `LiveSlam.camera`, also one that is
            found; if not, a bend of depth that is found is not used.
        pairs: whether it pairs images by that camera; if not, a delay of depth that edges show to
            be larger than any camera's is not used.
        interpolates: whether it gives depth at the colour image's time by that camera; if not, no
            other delay that is found is used.
        workstation: another machine, which has the map and makes the masks.
        full_size: large images are not reduced, as ``images.working_camera`` does otherwise.
    """

    out: Path | None = None
    overwrite: bool = False
    reference: Trajectory | None = None
    view: ViewOptions = field(default_factory=ViewOptions)
    images: Path | None = None
    title: str = "live"
    dense: bool = False
    mesh_voxel_m: float | None = None
    surface_frames: FrameOptions | None = None
    submap_points: int = 0
    calibrate: str = "off"
    straightens: bool = False
    pairs: bool = False
    interpolates: bool = False
    workstation: Workstation | None = None
    full_size: bool = False

    def __post_init__(self) -> None:
        for name in ("out", "images"):
            given = getattr(self, name)
            if not isinstance(given, (str, os.PathLike, NoneType)):
                raise InputError(f"LiveOptions: {name} is a {type(given).__name__}; give a path")
            object.__setattr__(self, name, given if given is None else Path(given))
        if self.calibrate not in CALIBRATE:
            raise InputError(f"--calibrate {self.calibrate}: is not one of {', '.join(CALIBRATE)}")
        frames = self.surface_frames and f"{self.surface_frames.per_s:g}"
        for flag, value in (("--mesh-voxel", self.mesh_voxel_m), ("--map-frames", frames)):
            if value is not None and not self.dense:
                raise _without_map(flag, value)

    @property
    def origin(self) -> Origin:
        """The sequence folder that the frames come from, if any, for config.yaml."""
        return Origin(self.images)


def start_calibration(
    camera: Camera, config: SystemConfig, options: LiveOptions
) -> RemoteCalibration:
    """The process that estimates the camera.

    Frames are not tracked again. So a camera that says nothing of its readout time, which bends the
    map most, is looked at early; one that does, where more frames show the rest.
    """
    free: list[int] = [SHUTTER]
    if options.interpolates:
        free.append(TIME)
    if options.straightens:
        free.extend(BENDS)
    rules = SelfCalibrationConfig()
    if camera.rolling_shutter_s:
        rules = replace(rules, frames=2 * rules.frames, stretches=rules.stretches - 1)
    return RemoteCalibration(
        CalibrationSetup(
            camera=camera,
            graph=config.graph,
            config=rules,
            mode=options.calibrate,
            free=tuple(free),
            pairs=options.pairs,
        )
    )


def _without_map(flag: str, value: object) -> InputError:
    return InputError(f"{flag} {value}: is for the dense map; give --map too, or omit it")


def frames_a_second(most: float | None, dense: bool) -> FrameOptions | None:
    """At most so many frames for the surface of a dense map, if one is made.

    Raises InputError: the number is negative, or given without a map.
    """
    if not dense:
        if most is not None:
            raise _without_map("--map-frames", f"{most:g}")
        return None
    from bmask_slam.dense.growing.frames import FrameOptions  # noqa: PLC0415 - loads torch

    if most is None:
        return FrameOptions()
    if not 0 <= most < math.inf:
        raise InputError(f"--map-frames {most:g}: must be 0 or more frames a second")
    return FrameOptions(most)


def start_dense(
    out: Path, camera: Camera, options: LiveOptions, masks: SegmenterOptions, labels: LabelSet
) -> RemoteDenseMapper:
    """The process that makes the dense map in a run folder."""
    from bmask_slam.live.processes import remote_dense  # noqa: PLC0415 - loads torch

    points = max(PREVIEW_POINTS if options.view.enabled else 0, options.submap_points)
    setup = remote_dense.DenseSetup(out, camera, masks, labels.names, points, options.mesh_voxel_m)
    if options.surface_frames is not None:
        setup = replace(setup, frames=options.surface_frames)
    dense = remote_dense.RemoteDenseMapper(setup)
    if options.view.enabled:
        dense.show_surface()
    return dense


def start_system(
    camera: Camera, config: SystemConfig, options: LiveOptions, scratch: Path
) -> LiveSystem:
    """The live system, all of whose processes are ready; its temporary files go to ``scratch``.

    Raises:
        InputError: a process cannot start, or a dense map has no run folder.
    """
    if options.dense and options.out is None:
        raise InputError("a dense map needs a run folder; give one, as out")
    masks: SegmenterOptions = config.semantics.segmenter
    place = MapPlace(scratch, options.workstation)
    with ExitStack() as undo:
        segmenter, dense, labels = None, None, NoSegmenter.labels
        if masks.name != "none":
            about = masks, options.images or Path()
            known = Upright(camera.up)
            segmenter = RemoteSegmenter(*about, None, options.workstation, known)
            undo.callback(segmenter.close)
            labels = segmenter.labels
        if options.dense and options.out is not None:
            dense = start_dense(options.out, camera, options, masks, labels)
            undo.callback(dense.close)
        calibration = None
        if options.calibrate != "off":
            calibration = start_calibration(camera, config, options)
            undo.callback(calibration.close)
        system = LiveSystem(camera, config, place, segmenter, dense, calibration)
        if options.calibrate != "off" and not camera.covered:
            system.watch = CoveredWatch()
        undo.pop_all()
        return system
