"""Whether a run contradicts its camera: focal lengths, registration of depth, stamps.

Nothing here uses a reference. What right cameras show has been measured: published focal lengths
are up to 1.8 +- 0.6 % from what the motion shows, and edges of registered depth within 3 px of
those of colour. The limits lie above that (docs/data.md). The scale of depth has no statistic:
images and depth fit a world of any size equally well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.calibration.edge_delay import MIN_STRENGTH, delay_warning, format_delay
from bmask_slam.calibration.edge_scores import best_scale, edge_scores
from bmask_slam.calibration.motion import as_exposed, landmark_motion
from bmask_slam.calibration.rematching import RADII_PX, RunProblem
from bmask_slam.calibration.views import SequenceDepths, connected_views
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
from bmask_slam.graph.calibration.registration import Registration, register
from bmask_slam.graph.camera import Camera
from bmask_slam.run_folder.map_file import SavedRun
from bmask_slam.run_folder.metrics import row
from bmask_slam.sequences.info import depth_statistics
from bmask_slam.sequences.sequence import Sequence
from bmask_slam.world.world_map import WorldMap

MAX_KEYFRAMES = 60
MAX_FOCAL_CHANGE, MAX_FOCAL_BOUND = 0.015, 0.02
"""A focal length surely further off, as a share of it, is a warning; it is not observable if its
95 % bound is larger than the second."""
SHOWN_BY_TRACKED = 2 / 3
"""What was tracked with a wrong focal length shows so much of the error, as it was kept since it
fits; what is found again shows all of it."""
MAX_SHIFT_SHARE = 4 / 640
"""Depth surely further off in the image, as a share of its width, is not registered."""
MIN_STRENGTH_RATIO, MIN_SCALE_CHANGE = 1.5, 0.05
"""Edges fit at another scale if that peak is so much stronger and the scale so much different."""
MAX_DELAY_BOUND_S = 0.015
"""A delay of depth with a larger 95 % bound is not observable."""
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


def check_camera(run: SavedRun, sequence: Sequence, world: WorldMap | None = None) -> CameraCheck:
    """Compare a run's camera with its stored observations, and depth images with colour images.

    ``sequence`` must have the camera of the run. With the run's ``world`` a focal length that the
    stored observations doubt is asked of landmarks that are found again, too.

    Raises:
        InputError: an image that the run could read is missing or broken.
    """
    path = run.trajectories["trajectory.txt"]
    problem = stored_problem(run) if len(path) else None
    focal = check_focal(problem) if problem is not None else None
    again = None
    if focal is not None and world is not None and abs(focal.change) > MAX_FOCAL_CHANGE:
        again = _focal_again(run, sequence, world)
    registration = register(edge_scores(sequence, path))
    findings = [_focal(focal, again, run.camera), _Finding(SCALE_NOTE)]
    if registration is not None and registration.strength >= MIN_STRENGTH:
        findings += [_shift(registration, run.camera), _delay(registration, run.camera)]
    elif registration is not None:
        findings.append(_scaled(registration, *best_scale(sequence, path)))
    else:
        findings.append(_Finding("registration of depth and stamps: not observable, few frames"))
    warnings = tuple(f.text for f in findings if f.is_warning)
    rows = [r for f in findings for r in f.rows] + [row("camera_warnings", len(warnings), "1")]
    return CameraCheck(warnings, tuple(f.text for f in findings if not f.is_warning), tuple(rows))


def depth_warning(sequence: Sequence, used_to_m: float = FARTHEST_M) -> str:
    """What is wrong with the unit of depth: a camera sees things that are near, but not too near.

    "" where nothing is, or no image has depth. Depth beyond ``used_to_m`` is not used in the run.
    """
    _, (_, median_m, _) = depth_statistics(sequence, DEPTH_FRAMES)
    if not (median_m < NEAREST_M or median_m > min(used_to_m, FARTHEST_M)):
        return ""
    scale = sequence.camera.depth_scale
    unused = f"; most is beyond the {used_to_m:g} m that are used" * (median_m > used_to_m)
    return (
        f"depth: {median_m:.4g} m in the median, with depth_scale {scale:g}; check depth_scale in "
        f"camera.yaml, what a depth image has for one metre: 1000, 5000 or, of metres, 1{unused}"
    )


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


def _focal_again(run: SavedRun, sequence: Sequence, world: WorldMap) -> FocalCheck | None:
    """What landmarks say that are found again without the run's own choice of matches."""
    ids, stamps_s = run.tables.keyframes.ids.tolist(), run.keyframe_stamps_s.tolist()
    reader = SequenceDepths(dict(zip(ids, stamps_s, strict=True)), sequence)
    landmarks = RunProblem(world, run, reader, run.camera)
    if not landmarks.large_enough:
        return None
    return check_focal(landmarks.problem(run.camera.rolling_shutter_s, RADII_PX[-1]))


def _focal(check: FocalCheck | None, again: FocalCheck | None, camera: Camera) -> _Finding:
    if check is None:
        return _Finding("focal length: not observable, too few views")
    sure = check.surely_beyond(MAX_FOCAL_CHANGE)
    if again is not None:
        limit, same = MAX_FOCAL_CHANGE / SHOWN_BY_TRACKED, check.change * again.change > 0
        sure = same and (again.surely_beyond(limit) or (sure and again.is_beyond(limit)))
        check = again
    change, bound = 100 * check.change, 100 * NORMAL_95 * check.sigma
    rows = (row("camera_focal_change", change, "%"), row("camera_focal_change_95", bound, "%"))
    more = "more" if change > 0 else "less"
    shown = f"{abs(change):.1f} ± {bound:.1f} % {more} than the camera's {camera.fx:.1f} px"
    if sure:
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
    if warning := delay_warning(found, camera):
        return _Finding(warning, True, rows)
    if bound_s > MAX_DELAY_BOUND_S:
        shown = format_delay(found)
        return _Finding(f"stamps: delay of depth not observable in this motion ({shown})")
    return _Finding(f"stamps: {format_delay(found)}", rows=rows)
