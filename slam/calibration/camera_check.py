"""Whether a run contradicts its camera: focal lengths, registration of depth, stamps.

Nothing here uses a reference. What right cameras show has been measured: published focal lengths
are up to 1.8 +- 0.6 % from what the motion shows, edges of registered depth within 2 px of those
of colour, and depth up to 21 ms from its stamps. The limits lie above that (docs/data.md). The
scale of depth has no statistic: images and depth fit a world of any size equally well.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np

from bmask_slam.calibration.adoption import SelfCalibration
from bmask_slam.calibration.edge_scores import best_scale, edge_scores
from bmask_slam.calibration.motion import as_exposed, landmark_motion
from bmask_slam.calibration.views import connected_views
from bmask_slam.evaluation import Row
from bmask_slam.graph.calibration.focal_check import FocalCheck, check_focal
from bmask_slam.graph.calibration.model import (
    BEND,
    NORMAL_95,
    OFFSET,
    PARAMETERS,
    CalibrationViews,
    parameters_of,
)
from bmask_slam.graph.calibration.problem import CalibrationProblem
from bmask_slam.graph.calibration.registration import EdgeScores, Registration, register
from bmask_slam.graph.camera import Camera
from bmask_slam.run_folder.map_file import SavedRun
from bmask_slam.run_folder.metrics import row
from bmask_slam.sequences.info import depth_statistics
from bmask_slam.sequences.sequence import Sequence

logger = logging.getLogger(__name__)

MAX_KEYFRAMES = 60
MAX_FOCAL_CHANGE, MAX_FOCAL_BOUND = 0.015, 0.02
"""A focal length surely further off, as a share of it, is a warning; it is not observable if its
95 % bound is larger than the second."""
MAX_SHIFT_SHARE = 4 / 640
"""Depth surely further off in the image, as a share of its width, is not registered."""
MIN_STRENGTH, MIN_STRENGTH_RATIO, MIN_SCALE_CHANGE = 6.0, 1.5, 0.05
"""Edges of depth and colour fit if their peak is so many sigmas above its surroundings; at another
scale if that peak is so much stronger and the scale so much different."""
MAX_DELAY_S, SURE_DELAY_S, MAX_DELAY_BOUND_S = 0.022, 0.015, 0.015
"""A delay of depth above the first, and surely above the second, is a warning; it is not observable
if its 95 % bound is larger than the third."""
LARGE_DELAY_S = 0.035
"""A delay by edges that is surely larger is adopted before the motion is asked."""
NEAREST_M, FARTHEST_M, DEPTH_FRAMES = 0.1, 50.0, 5
"""A median depth outside these is a wrong unit; by so many images of the sequence."""
GAUGE_SIGMAS = np.full(6, 1e-4)
SCALE_NOTE = (
    "depth scale: not observable, images and depth fit a world of any size; bmask-slam calibrate "
    "RUN --known-distance checks it"
)


@dataclass(frozen=True)
class CameraCheck:
    """What a run says against its camera.

    Attributes:
        warnings: for the summary and the log, each with its evidence and a cure.
        notes: for the log alone: what agrees, and what the motion does not show.
        rows: of metrics.json.
    """

    warnings: tuple[str, ...]
    notes: tuple[str, ...]
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class _Finding:
    """A line, whether it is a warning, and rows of metrics.json."""

    text: str
    is_warning: bool = False
    rows: tuple[Row, ...] = ()


def check_camera(run: SavedRun, sequence: Sequence) -> CameraCheck:
    """Compare a run's camera with its stored observations, and depth images with colour images.

    ``sequence`` must have the camera of the run.

    Raises:
        InputError: an image that the run could read is missing or broken.
    """
    path = run.trajectories["trajectory.txt"]
    problem = stored_problem(run) if len(path) else None
    focal = check_focal(problem) if problem is not None else None
    registration = register(edge_scores(sequence, path))
    findings = [_focal(focal, run.camera), _Finding(SCALE_NOTE)]
    if registration is not None and registration.strength >= MIN_STRENGTH:
        findings += [_shift(registration, run.camera), _delay(registration, run.camera)]
    elif registration is not None:
        findings.append(_scaled(registration, *best_scale(sequence, path)))
    else:
        findings.append(_Finding("registration of depth and stamps: not observable, few frames"))
    warnings = tuple(f.text for f in findings if f.is_warning)
    rows = [r for f in findings for r in f.rows] + [row("camera_warnings", len(warnings), "1")]
    return CameraCheck(warnings, tuple(f.text for f in findings if not f.is_warning), tuple(rows))


def depth_warning(sequence: Sequence) -> str:
    """What is wrong with the unit of depth: a camera sees things that are near, but not too near.

    "" where nothing is, or no image has depth.
    """
    _, (_, median_m, _) = depth_statistics(sequence, DEPTH_FRAMES)
    if not (median_m < NEAREST_M or median_m > FARTHEST_M):
        return ""
    scale = sequence.camera.depth_scale
    return (
        f"depth: {median_m:.4g} m in the median, with depth_scale {scale:g}; check depth_scale in "
        "camera.yaml, what a depth image has for one metre: 1000, 5000 or, of metres, 1"
    )


def sure_registration(scores: EdgeScores) -> Registration | None:
    """How depth lies on colour by its edges, where these say it clearly."""
    found = register(scores)
    return found if found is not None and found.strength >= MIN_STRENGTH else None


def with_sure_delay(
    state: SelfCalibration,
    found: Registration | None,
    offset_s: float,
    least_s: float = LARGE_DELAY_S,
) -> SelfCalibration | None:
    """The state with the delay of depth that edges show, if it is far from a right camera's.

    So large a delay bends the map, and with it what the motion says of the camera; smaller ones are
    left to that, since edges may deceive where a camera turns evenly: a delay moves them as another
    place of the depth camera does. ``offset_s`` is the delay of the camera that the edges were
    compared with; the other is surely larger than ``least_s``.
    """
    if found is None:
        return None
    found_s, bound_s = round(offset_s + found.delay_s, 4), NORMAL_95 * found.delay_sigma_s
    shown = f"colour-depth delay {1e3 * found_s:.1f} ± {1e3 * bound_s:.1f} ms by edges of depth"
    logger.info("calibration: %s: estimated", shown)
    if abs(found.delay_s) - bound_s < least_s:
        return None
    camera = replace(state.camera, depth_time_offset_s=found_s)
    before = f"{state.text}; " if state.adopted else ""
    return replace(state, camera=camera, text=f"{before}{shown}: found and applied")


def delay_warning(found: Registration | None, camera: Camera) -> str:
    """What edges of depth say against a camera's delay, with a cure; "" where they do not."""
    finding = None if found is None else _delay(found, camera)
    return finding.text if finding is not None and finding.is_warning else ""


def stored_problem(run: SavedRun) -> CalibrationProblem | None:
    """The problem of the stored observations, without reading images; None without any.

    Depths are those of the run, in metres, so that its scale, offset and delay are in them.
    """
    tables, camera = run.tables, run.camera
    ids = tables.keyframes.ids[np.isfinite(run.keyframe_stamps_s)]
    observations = connected_views(tables, ids, MAX_KEYFRAMES)
    if not len(observations):
        return None
    motion = landmark_motion(observations, run)
    keyframe_ids, keyframes = np.unique(observations.keyframe_ids, return_inverse=True)
    landmark_ids, landmarks = np.unique(observations.landmark_ids, return_inverse=True)
    pixels = camera.distort(as_exposed(observations.measurements[:, :2], motion, camera))
    measured, sigmas, bf = observations.measurements, observations.sigmas_px, camera.stereo_bf_px_m
    none = np.zeros(len(pixels))
    views = CalibrationViews(
        keyframes=keyframes,
        landmarks=landmarks,
        pixels=pixels,
        places=camera.image_places(pixels),
        inverse_depth=(measured[:, 0] - measured[:, 2]) / bf,  # u_left - u_right
        inverse_depth_rate=none,
        lag_s=none,
        sigma_px=sigmas[:, 0],
        sigma_inverse=sigmas[:, 2] / bf,
        shutter_velocity=camera.share_of_rows(pixels[:, 1])[:, None] * motion.velocities,
    )
    start = parameters_of(camera, camera.depth_scale)
    start[OFFSET], start[BEND] = 0.0, 0.0  # they are in the depths already
    poses, points = tables.keyframes.get(keyframe_ids), tables.landmarks.get(landmark_ids)
    return CalibrationProblem(views, poses, points, start, np.zeros(len(PARAMETERS)), GAUGE_SIGMAS)


def _focal(check: FocalCheck | None, camera: Camera) -> _Finding:
    if check is None:
        return _Finding("focal length: not observable, too few views")
    change, bound = 100 * check.change, 100 * NORMAL_95 * check.sigma
    rows = (row("camera_focal_change", change, "%"), row("camera_focal_change_95", bound, "%"))
    more = "more" if change > 0 else "less"
    shown = f"{abs(change):.1f} ± {bound:.1f} % {more} than the camera's {camera.fx:.1f} px"
    if check.surely_beyond(MAX_FOCAL_CHANGE):
        text = f"focal length: the motion shows {shown}; check the calibration, or find it by "
        return _Finding(f"{text}bmask-slam calibrate RUN", True, rows)
    if NORMAL_95 * check.sigma > MAX_FOCAL_BOUND:
        return _Finding(f"focal length: not observable in this motion ({shown})", rows=rows)
    return _Finding(f"focal length: {shown}, as right cameras show", rows=rows)


def _shift(found: Registration, camera: Camera) -> _Finding:
    shift, bounds = found.shift_px, NORMAL_95 * found.shift_sigma_px
    rows = tuple(
        row(f"camera_depth_shift_{axis}", value, "px")
        for axis, value in zip("uv", shift.tolist(), strict=True)
    )
    shown = (
        f"depth fits colour when moved by ({shift[0]:.1f}, {shift[1]:.1f}) ± "
        f"({bounds[0]:.1f}, {bounds[1]:.1f}) px"
    )
    if (np.abs(shift) - bounds).max() > MAX_SHIFT_SHARE * camera.width:
        return _Finding(f"registration: {shown}; {_UNREGISTERED}", True, rows)
    return _Finding(f"registration: {shown}", rows=rows)


_UNREGISTERED = "register depth to colour, or give the camera to which it is registered"


def _scaled(found: Registration, scale: float, strength: float) -> _Finding:
    """Where edges do not fit at any shift: perhaps at another scale."""
    sure = strength > max(MIN_STRENGTH, MIN_STRENGTH_RATIO * found.strength)
    if sure and abs(scale - 1) > MIN_SCALE_CHANGE:
        evidence = f"peak {strength:.1f} against {found.strength:.1f} sigmas unscaled"
        text = f"registration: depth fits colour only when scaled by {scale:.2f} ({evidence})"
        return _Finding(f"{text}; {_UNREGISTERED}", True)
    return _Finding("registration of depth and stamps: not observable, too few edges of depth")


def _delay(found: Registration, camera: Camera) -> _Finding:
    delay_s, bound_s = found.delay_s, NORMAL_95 * found.delay_sigma_s
    rows = (
        row("camera_depth_delay_ms", 1e3 * delay_s, "ms"),
        row("camera_depth_delay_95_ms", 1e3 * bound_s, "ms"),
    )
    later = "later" if delay_s > 0 else "earlier"
    shown = f"{1e3 * abs(delay_s):.0f} ± {1e3 * bound_s:.0f} ms {later} than stamps and camera say"
    if abs(delay_s) > MAX_DELAY_S and abs(delay_s) - bound_s > SURE_DELAY_S:
        cure = f"set depth_time_offset: {camera.depth_time_offset_s + delay_s:.3f} in camera.yaml"
        return _Finding(f"stamps: depth images are {shown}; {cure}", True, rows)
    if bound_s > MAX_DELAY_BOUND_S:
        return _Finding(f"stamps: delay of depth not observable in this motion ({shown})")
    return _Finding(f"stamps: depth images are {shown}", rows=rows)
