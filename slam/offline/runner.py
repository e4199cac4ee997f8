"""One offline run: a sequence through the system into a run folder."""

from __future__ import annotations

import gc
import logging
import platform
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from bmask_slam.calibration.adoption import SelfCalibration, in_other_order
from bmask_slam.config.configuration import dump
from bmask_slam.evaluation.reference import read_reference
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.extras import import_dense
from bmask_slam.graph.sensors.streams import read_folder
from bmask_slam.graph.trajectory import MAX_TIME_DIFFERENCE_S, Trajectory, associate_stamps
from bmask_slam.labelling.mask_memory import MaskMemory, RememberingSegmenter
from bmask_slam.labelling.upright_images import upright_of
from bmask_slam.moving.covered_parts import covered_camera, with_verdict
from bmask_slam.offline.checkpoint import Checkpoint, read_checkpoint
from bmask_slam.offline.frame_loop import ActiveRun, process_frames, run_indices
from bmask_slam.offline.inherited_camera import (
    check_own_camera,
    inherited_calibration,
    use_own_camera,
    with_found_of,
)
from bmask_slam.offline.map_localisation import MapLocalisation
from bmask_slam.offline.options import RunOptions
from bmask_slam.offline.run_end import RunSummary, finish_run
from bmask_slam.offline.self_calibration import SelfCalibrator
from bmask_slam.run_folder.folder import CHECKPOINT, RunFolder
from bmask_slam.run_folder.map_file import read_map
from bmask_slam.run_folder.metrics import RunCounters
from bmask_slam.run_folder.open_files import free_run_path
from bmask_slam.run_folder.origin import Origin
from bmask_slam.run_folder.reader import Run
from bmask_slam.runtime.machine import versions
from bmask_slam.runtime.memory import give_back_memory
from bmask_slam.runtime.stop_request import StopRequest
from bmask_slam.semantics.segmenters.upright import Upright
from bmask_slam.sequences.camera_presets import is_preset
from bmask_slam.sequences.sequence import Sequence, open_sequence
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.system_interface import System

__all__ = ["RunOptions", "RunSummary", "resume", "run"]
logger = logging.getLogger(__name__)

MIN_REFERENCE_POSES = 3


MakeSystem = Callable[[Camera, SystemConfig], System]


def run(options: RunOptions, make_system: MakeSystem | None = None) -> RunSummary:
    """Run the system over a sequence and write the run folder.

    SIGINT and SIGTERM end the run after the current frame; the frames processed so far are then
    finished and saved like a whole run.

    Raises:
        InputError: a broken sequence, reference or map, or a run folder that cannot be used; a
            folder made for this run is removed unless a frame had been processed.
    """
    sequence = open_sequence(options.sequence, camera=options.camera, full_size=options.full_size)
    reference = find_reference(options.reference, sequence)
    name = "-".join(filter(None, (sequence.name, options.config_name)))
    out = options.out or free_run_path(name)
    _refuse_inputs(out, options)
    with (
        RunFolder(out, options.overwrite) as folder,
        StopRequest() as stop,
        ExitStack() as stack,
    ):
        describe_run(folder, options, sequence)
        sequence, covered = _without_covered_parts(options, sequence)
        make, masks = stack.enter_context(_system_maker(make_system, options, sequence))
        begin = replace(inherited_calibration(options, sequence), covered=covered)
        calibrator = _calibrator(options, begin, masks)
        if calibrator.state.adopted:
            sequence = sequence.with_camera(calibrator.state.camera)
        active = ActiveRun(
            options,
            sequence,
            reference,
            with_sensors(start_system(options, sequence, make), sequence),
            folder,
            stop,
            calibrator,
        )
        return _finished(active, make)


def resume(
    path: Path, given: Mapping[str, Any] | None = None, make_system: MakeSystem | None = None
) -> RunSummary | None:
    """Resume a killed run from its last checkpoint; None if the run is finished.

    ``given`` are options (attributes of RunOptions) that the user repeats. The sequence may have
    been moved; all others must be those of the run.

    Raises:
        InputError: there is no checkpoint, it is broken or of another version, or sequence,
            configuration or options differ from those of the run.
    """
    if (path / "metrics.json").exists() and Run(path).is_finished:
        return None
    checkpoint = read_checkpoint(path)
    options = checkpoint.options.with_given(given or {})
    sequence = _reopened(options, checkpoint)
    checkpoint.check_sequence(sequence)
    reference = find_reference(options.reference, sequence)
    with ExitStack() as stack:
        make, masks = stack.enter_context(_system_maker(make_system, options, sequence))
        counters, system = checkpoint.counters, make(sequence.camera, options.config)
        system.restore(checkpoint.state, path / CHECKPOINT)
        checkpoint = replace(checkpoint, state={})  # it is as large as the map
        folder = stack.enter_context(RunFolder(path, resume_bytes=checkpoint.sizes))
        stop = stack.enter_context(StopRequest())
        logger.info("resumed after %d frames: %s", counters.frames, shlex.join(sys.argv))
        if not counters.frames:
            logger.warning("%s: no checkpoint was reached; starting from the beginning", path)
        for index, reason in checkpoint.skipped:
            sequence.skip(index, reason)
        calibrator = _calibrator(options, checkpoint.calibration, masks)
        active = ActiveRun(options, sequence, reference, system, folder, stop, calibrator, counters)
        del system  # the run may begin anew with another
        return _finished(active, make)


def _refuse_inputs(out: Path, options: RunOptions) -> None:
    """Refuse to overwrite the map or the camera that a run begins with. Raises InputError."""
    camera = None if is_preset(options.camera) else options.camera
    for given in filter(None, (options.map, options.localise, camera)):
        if options.overwrite and out.resolve() in (given.resolve(), given.resolve().parent):
            raise InputError(f"{given}: is an input, which stays as it is; choose another --out")


def _finished(active: ActiveRun, make_system: MakeSystem) -> RunSummary:
    """A run after its last frame, begun anew as often as another camera was found for it."""
    while process_frames(active):
        active.sequence = active.sequence.with_camera(active.calibrator.state.camera)
        system = start_system(active.options, active.sequence, make_system)
        active.system = with_sensors(system, active.sequence)
        del system
        active.counters = RunCounters(wall_s=active.counters.wall_s)
        gc.collect()  # the system of before, whose parts know each other
        give_back_memory()
    return finish_run(active)


def _without_covered_parts(options: RunOptions, sequence: Sequence) -> tuple[Sequence, str]:
    """The sequence without what does not show the room, if nothing is said of it; what it is."""
    if options.calibrate == "off" or sequence.camera.covered:
        return sequence, ""
    camera, text = covered_camera(sequence, run_indices(sequence, options))
    if not text:
        return sequence, ""
    used = options.calibrate == "auto"
    return sequence.with_camera(camera) if used else sequence, with_verdict(text, used)


def _calibrator(
    options: RunOptions, state: SelfCalibration, masks: MaskMemory | None
) -> SelfCalibrator:
    """What looks for readout, delay and bend of the camera; nothing where no map is made."""
    mode = "off" if options.localise else options.calibrate
    return SelfCalibrator(state, mode, masks)


def _reopened(options: RunOptions, checkpoint: Checkpoint) -> Sequence:
    """The sequence of a run, with the camera that the run has found; else with its own."""
    sequence = open_sequence(options.sequence, camera=options.camera, full_size=options.full_size)
    own, found = sequence.camera, checkpoint.calibration
    if found.covered:
        own = replace(own, covered=found.given.covered)
    if found.rows:
        own = in_other_order(own)
    return sequence if own != found.given else sequence.with_camera(found.camera)


def find_reference(path: Path | None, sequence: Sequence) -> Trajectory | None:
    """The reference trajectory: of a file, of a sequence folder, or of the sequence itself.

    Raises:
        InputError: the given file is missing or broken, or shares no time with the sequence.
    """
    if path is None:
        return sequence.groundtruth
    reference = read_reference(path, sequence.timestamps_s)
    shared = len(associate_stamps(sequence.timestamps_s, reference.timestamps_s)[0])
    if shared < MIN_REFERENCE_POSES:
        raise InputError(
            f"{path}: has a pose within {MAX_TIME_DIFFERENCE_S:g} s for {shared} frames of "
            f"{sequence.folder}; give the reference of this sequence, in its clock"
        )
    return reference


def describe_run(folder: RunFolder, options: RunOptions, sequence: Sequence) -> None:
    """Write config.yaml, and log the command, the versions, the camera and the frames."""
    origin = Origin(sequence.folder, options.stride)
    folder.write_text("config.yaml", f"# {origin}\n{dump(options.config)}")
    logger.info("%s: %s", origin, shlex.join(sys.argv))
    packages = ("gtsam", "numpy", "opencv-python-headless")
    found = ", ".join(f"{package} {known}" for package, known in versions(packages).items())
    logger.info("%s, Python %s, %s", platform.platform(), platform.python_version(), found)
    logger.info("camera from %s: %s", sequence.camera_source, sequence.camera)
    pairs = sequence.pairs
    unpaired = f"{pairs.unpaired_rgb} colour and {pairs.unpaired_depth} depth images"
    logger.info("%d frames; %s without a partner", len(sequence), unpaired)
    for index, reason in sequence.skipped:  # found before the log was open
        logger.info("frame %d is broken: %s", index, reason)
    recording = sequence.recording
    if any(copies := (recording.rgb.copies, recording.depth.copies)):
        logger.info("%d colour and %d depth images repeat the one before, and are used", *copies)
    for text in recording.warnings:
        logger.warning(text)


@contextmanager
def _system_maker(
    given: MakeSystem | None, options: RunOptions, sequence: Sequence
) -> Iterator[tuple[MakeSystem, MaskMemory | None]]:
    """A given maker of systems, or that of `SlamSystem` with the segmenter of its configuration.

    The second keeps masks for a run that begins anew, if it may. Raises InputError.
    """
    chosen, folder = options.config.semantics.segmenter, sequence.folder
    upright = Upright()
    if given is None and not options.localise:
        upright = upright_of(chosen, sequence, run_indices(sequence, options))
    if given is None and options.dense:
        import_dense("--map")
        from bmask_slam.dense.options import MapOptions, check_voxels  # noqa: PLC0415 - loads torch

        check_voxels(MapOptions(folder, mesh_voxel_m=options.mesh_voxel_m))
    if given is not None:
        yield given, None
    elif options.parallel:
        from bmask_slam.parallel.system import ParallelSystems  # noqa: PLC0415 - if asked for

        with closing(ParallelSystems(chosen, folder, upright)) as systems:
            yield systems, systems.segmenter.memory if systems.segmenter else None
    elif options.localise:
        yield SlamSystem, None
    else:
        from bmask_slam.parallel.segmenter_beside import segmenter_of_run  # noqa: PLC0415

        masks = MaskMemory()
        with segmenter_of_run(chosen, folder, upright) as segmenter:
            yield partial(SlamSystem, segmenter=RememberingSegmenter(segmenter, masks)), masks


def with_sensors(system: System, sequence: Sequence) -> System:
    """The system with the measurements that lie beside the images. Raises InputError."""
    if isinstance(system, SlamSystem):
        for measured in read_folder(sequence.folder, system.config.sensors.enabled):
            logger.info("%s: %d measurements", measured.sensor, len(measured.rows))
            system.add_measurements(measured)
    return system


def start_system(options: RunOptions, sequence: Sequence, make_system: MakeSystem) -> System:
    """The system of a new run: empty, or with the map of ``options.map`` or ``localise``.

    Raises:
        InputError: the map cannot be read, or was made with another camera.
    """
    source = options.map or options.localise
    if source is None:
        return make_system(sequence.camera, options.config)
    state, made = read_map(source)
    camera = sequence.camera
    if options.map:
        own = made if options.calibrate == "off" else with_found_of(camera, made)
        check_own_camera(source, own, sequence)
        camera = with_found_of(made, camera)
    make = MapLocalisation if options.localise else make_system
    system = make(camera, options.config)
    system.restore(state, source)
    if options.map and isinstance(system, SlamSystem):
        use_own_camera(system, state, sequence.camera)
    system.begin_session()
    logger.info("%s: %s keyframes", source, system.statistics()["keyframes"])
    return system
