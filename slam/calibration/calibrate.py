"""Self-calibration of a finished run: read it, solve, write camera.yaml with a report."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from bmask_slam.calibration.config import CalibrationPriors
from bmask_slam.calibration.motion import landmark_motion
from bmask_slam.calibration.report import (
    WEAK,
    Calibrated,
    format_calibration,
    parameters_named,
    posterior_share,
)
from bmask_slam.calibration.views import SequenceDepths, connected_views, make_views
from bmask_slam.evaluation.ate_rpe import clock_of
from bmask_slam.evaluation.reference import read_reference
from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.calibration.calibration import CalibrationResult, calibrate
from bmask_slam.graph.calibration.model import (
    BEND,
    FACTOR,
    OFFSET,
    PARAMETERS,
    SHUTTER,
    TIME,
    parameters_of,
)
from bmask_slam.graph.calibration.problem import Anchors, CalibrationProblem
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.graph_update import Observations
from bmask_slam.graph.files.whole_file import check_target
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.graph.metrics import align
from bmask_slam.graph.smoother.storage import read_graph
from bmask_slam.graph.trajectory import MAX_TIME_DIFFERENCE_S, nearest_indices
from bmask_slam.run_folder.map_file import SavedRun, read_run
from bmask_slam.run_folder.origin import find_sequence
from bmask_slam.run_folder.reader import Run
from bmask_slam.sequences.cameras import read_camera, write_camera
from bmask_slam.sequences.sequence import Sequence, open_sequence

MIN_KEYFRAMES = 5
MIN_REFERENCE_POSES = 5
RATE_ERROR = 0.05
"""Relative error of the rates of depth; on rendered sequences time offsets are 6-9 % too small."""
MAX_KEYFRAMES = 400
"""The solver is dense in the poses; of a longer run those with most observations are used."""
GAUGE_SIGMAS = np.full(6, 1e-4)
FREE_SIGMAS = np.array([1.0] * 3 + [10.0] * 3)
"""Of the first pose [rad, m]: the first without a reference, the second with one."""


@dataclass(frozen=True)
class CalibrateOptions:
    """What to calibrate, and from what.

    Attributes:
        run: the run folder.
        out: camera.yaml to write; None: into the run folder.
        sequence: of the run; None: the one in its config.yaml.
        reference: TUM file or sequence folder with the camera's positions in metres.
        on_body: the positions are those of a point fixed to the camera, whose offset is estimated.
        known_distance: two stamps in seconds, and the distance in metres of the camera's positions.
        anchor_sigma_m: standard deviation of the positions and of the distance.
        fixed: parameters that keep their values, by their names here, in the table or the file.
        priors: of the other parameters.
        overwrite: replace ``out``.
    """

    run: Path
    out: Path | None = None
    sequence: Path | None = None
    reference: Path | None = None
    on_body: bool = False
    known_distance: tuple[float, float, float] | None = None
    anchor_sigma_m: float = 0.01
    fixed: tuple[str, ...] = ()
    priors: CalibrationPriors = field(default_factory=CalibrationPriors)
    overwrite: bool = False


def calibrate_run(options: CalibrateOptions) -> Calibrated:
    """Calibrate the camera of a run and write it as camera.yaml.

    Raises:
        InputError: a run, sequence or reference that is missing, broken or too small, an unknown
            parameter, or an output that is there already.
    """
    out = check_options(options)
    run = read_run(options.run)
    sequence = open_sequence(options.sequence or find_sequence(options.run), camera=run.camera)
    problem, _ = make_problem(options, run, sequence)
    problem, result = _solved(problem)
    before = calibrate(dataclasses.replace(problem, prior_sigmas=np.zeros(len(PARAMETERS))))
    done = Calibrated(
        path=out,
        camera=camera_from(run.camera, result.calibration),
        before=run.camera,
        result=result,
        prior_sigmas=problem.prior_sigmas,
        has_anchor=problem.anchors is not None,
        keyframes=len(problem.poses_world_camera),
        landmarks=len(problem.points_world),
        observations=len(problem.views.pixels),
        noise_before=before.noise_scales,
        sigma_px=float(np.median(problem.views.sigma_px)),
    )
    write_camera(out, done.camera, format_calibration(done))
    return done


def _solved(problem: CalibrationProblem) -> tuple[CalibrationProblem, CalibrationResult]:
    """The result, and the problem that it solves: with the depth offset held fixed, if need be.

    A scale that is not well known and an offset take each other's part: on 280 frames of
    rgbd_bonn_crowd with its reference the offset comes out as -122 mm.
    """
    result, sigmas = with_rate_error(calibrate(problem)), problem.prior_sigmas
    if sigmas[OFFSET] and posterior_share(result, sigmas, FACTOR) > WEAK:
        held = np.where(np.arange(len(sigmas)) == OFFSET, 0.0, sigmas)
        problem = dataclasses.replace(problem, prior_sigmas=held)
        result = with_rate_error(calibrate(problem))
    return problem, result


def with_rate_error(result: CalibrationResult) -> CalibrationResult:
    """The result with the relative error of the rates of depth added to the time offset's variance.

    The rate of change at a pixel is a noisy measurement too. This makes the estimated offset too
    small (errors in variables), which no residual shows.
    """
    covariance = result.covariance.copy()
    if covariance[TIME, TIME] > 0:
        covariance[TIME, TIME] += (RATE_ERROR * result.calibration[TIME]) ** 2
    return dataclasses.replace(result, covariance=covariance)


def check_options(options: CalibrateOptions) -> Path:
    """The file to write; checks what would otherwise fail after the work.

    Raises:
        InputError: there is no run, the file exists, its folder does not, or an option is
            impossible.
    """
    run = Run(options.run)
    out = options.out or run.path / "camera.yaml"
    if out.exists() and not (options.overwrite or _is_of_run(out, options)):
        raise InputError(f"{out}: is there already; choose another --out or add --overwrite")
    check_target(out)
    for name in options.fixed:
        if not parameters_named(name):
            raise InputError(f"--fix {name}: is no parameter; they are {', '.join(PARAMETERS)}")
    if options.on_body and options.reference is None:
        raise InputError("--hand-eye: finds where the reference sits; give it as --reference")
    if not 0 < options.anchor_sigma_m < np.inf:
        raise InputError(f"--anchor-sigma {options.anchor_sigma_m}: must be positive metres")
    return out


def _is_of_run(out: Path, options: CalibrateOptions) -> bool:
    """Whether a file is the camera that the run itself found, which the run's graph holds too."""
    if options.out is not None or not (options.run / "graph").is_file():
        return False
    return read_camera(out) == read_graph(options.run / "graph")[1]


def make_problem(
    options: CalibrateOptions, run: SavedRun, sequence: Sequence
) -> tuple[CalibrationProblem, Ints]:
    """The problem for the solver, and the ids (K,) of its keyframes."""
    stamps_s = dict(zip(run.tables.keyframes.ids.tolist(), run.keyframe_stamps_s, strict=True))
    reader = SequenceDepths(stamps_s, sequence)
    observations = connected_views(run.tables, reader.keyframe_ids, MAX_KEYFRAMES)
    _check_enough(run, reader, observations)
    motion = landmark_motion(observations, run)
    views, keyframe_ids, landmark_ids = make_views(observations, reader, motion)
    poses = run.tables.keyframes.get(keyframe_ids)
    points = run.tables.landmarks.get(landmark_ids)
    stamps = np.array([stamps_s[k] for k in keyframe_ids.tolist()])
    positions, gauge = np.full((len(poses), 3), np.nan), GAUGE_SIGMAS
    if options.reference is not None:
        own_s = clock_of(run.path / "trajectory.txt").own_s(stamps)
        positions, T_reference_world = _reference_positions(options.reference, own_s, poses)
        poses, points = T_reference_world @ poses, transform(T_reference_world, points)
        gauge = FREE_SIGMAS
    sigma_m = options.anchor_sigma_m
    anchors = Anchors(positions, sigma_m, options.on_body, distance_sigma_m=sigma_m)
    if options.known_distance is not None:
        anchors = _with_distance(anchors, options.known_distance, run, stamps, keyframe_ids)
    sigmas = options.priors.sigmas(run.camera)
    has_anchor = options.reference is not None or options.known_distance is not None
    if not has_anchor:  # a scale that nothing fixes and an offset take each other's part
        sigmas[[FACTOR, OFFSET]] = 0.0
    fixed = {parameter for name in options.fixed for parameter in parameters_named(name)}
    sigmas[np.isin(PARAMETERS, list(fixed))] = 0.0
    start = parameters_of(run.camera, run.camera.depth_scale)
    problem = CalibrationProblem(
        views, poses, points, start, sigmas, gauge, anchors if has_anchor else None
    )
    return problem, keyframe_ids


def _check_enough(run: SavedRun, reader: SequenceDepths, observations: Observations) -> None:
    """Refuse images of another recording, and observations of few keyframes. Raises InputError."""
    if not len(reader.keyframe_ids):
        raise InputError(
            f"{reader.sequence.folder}: has no image of a keyframe of {run.path}, so it is another "
            "recording; give the run's own by --sequence"
        )
    count = len(np.unique(observations.keyframe_ids))
    if count < MIN_KEYFRAMES:
        raise InputError(
            f"{run.path}: {count} keyframes share landmarks, too few to calibrate; use a run with "
            f"at least {MIN_KEYFRAMES}, better 20 or more"
        )


def _reference_positions(path: Path, stamps_s: Array, poses: Array) -> tuple[Array, Array]:
    """Positions (K, 3) of a reference at stamps, NaN where it has none, and T_reference_world."""
    reference = read_reference(path)
    at = nearest_indices(reference.timestamps_s, stamps_s)
    near = np.abs(reference.timestamps_s[at] - stamps_s) <= MAX_TIME_DIFFERENCE_S
    if near.sum() < MIN_REFERENCE_POSES:
        raise InputError(
            f"{path}: has a pose within {MAX_TIME_DIFFERENCE_S:g} s for {near.sum()} keyframes; "
            "give the reference of this sequence, in its clock"
        )
    positions = np.where(near[:, None], reference.positions_world[at], np.nan)
    return positions, align(poses[near, :3, 3], positions[near]).T_reference_estimate


def _with_distance(
    anchors: Anchors,
    known: tuple[float, float, float],
    run: SavedRun,
    stamps_s: Array,
    keyframe_ids: Ints,
) -> Anchors:
    """Anchors with a distance between the camera's positions at two moments of the run."""
    *moments_s, distance_m = known
    trajectory = run.trajectories["trajectory.txt"]
    at = nearest_indices(trajectory.timestamps_s, np.array(moments_s))
    late_s = np.abs(trajectory.timestamps_s[at] - moments_s).max()  # may be NaN
    near = late_s <= MAX_TIME_DIFFERENCE_S and at[0] != at[1]
    if not (near and 0 < distance_m < np.inf):
        raise InputError(
            f"--known-distance {' '.join(f'{x:.16g}' for x in known)}: give two different stamps "
            f"of {run.path / 'trajectory.txt'}, to {MAX_TIME_DIFFERENCE_S:g} s, and a positive "
            "distance in metres"
        )
    ends = nearest_indices(stamps_s, np.array(moments_s))
    T_world_keyframe = run.tables.keyframes.get(keyframe_ids[ends])
    T_keyframe_then = inverse(T_world_keyframe) @ trajectory.poses_world_camera[at]
    return dataclasses.replace(
        anchors,
        ends=ends[None],
        arms_m=T_keyframe_then[None, :, :3, 3],
        distances_m=np.array([distance_m]),
    )


def camera_from(before: Camera, calibration: Array) -> Camera:
    """The camera of a vector (18,) of PARAMETERS, rounded to meaningful digits."""
    fx, fy, cx, cy = (round(float(x), 4) for x in calibration[:4])
    k1, k2, p1, p2, k3 = (round(float(x), 6) for x in calibration[4:9])
    u, v, uu, uv, vv = (round(float(x), 6) for x in calibration[BEND])
    return dataclasses.replace(
        before,
        fx=fx, fy=fy, cx=cx, cy=cy,
        distortion=(k1, k2, p1, p2, k3),
        depth_scale=round(before.depth_scale / float(calibration[FACTOR]), 3),
        depth_offset_m=round(float(calibration[OFFSET]), 6),
        depth_time_offset_s=round(float(calibration[TIME]), 6),
        rolling_shutter_s=round(float(calibration[SHUTTER]), 6),
        depth_distortion=(u, v, uu, uv, vv),
    )  # fmt: skip
