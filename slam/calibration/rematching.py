"""Landmarks found again in the keyframes of a run, without the run's own choice of matches.

Tracking keeps a match only if it fits the camera that the run was given: with a readout time or
another parameter that is wrong it drops the matches that would show it, and a calibration from
what is left is drawn to the wrong value (freiburg1_rpy: 15 ms in place of 26 ms). So the landmarks
are searched anew in the keypoints of all keyframes, by descriptor, in windows wide enough for what
a wrong camera does, and again in narrower ones around where the camera found so far projects them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bmask_slam.calibration.adoption import Estimate, estimate_of
from bmask_slam.calibration.calibrate import (
    GAUGE_SIGMAS,
    MIN_KEYFRAMES,
)
from bmask_slam.calibration.config import FREE, TIMES, estimated_priors
from bmask_slam.calibration.motion import MIN_DEPTH_M, twists_at
from bmask_slam.calibration.views import (
    DepthReader,
    Depths,
    connected_views,
    group_sizes,
    measured_depths,
    sensor_sigmas,
)
from bmask_slam.features.matching import MatchConfig, WindowIndex, match_pairs
from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.calibration.calibration import (
    CalibrationConfig,
    CalibrationResult,
    calibrate,
)
from bmask_slam.graph.calibration.model import (
    SHUTTER,
    CalibrationViews,
    parameters_of,
)
from bmask_slam.graph.calibration.problem import CalibrationProblem
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.run_folder.map_file import SavedRun
from bmask_slam.tracking.pose.rolling_shutter import velocities
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.world_map import WorldMap

MAX_KEYFRAMES, MAX_OBSERVATIONS = 40, 8000
"""Those with most observations are used of more, and the landmarks that are seen most often."""
QUICK = CalibrationConfig(rounds=2, steps=4, tolerance=1e-3)
RADII_PX = (24.0, 8.0)
"""Of the windows around predicted pixels: by the run's camera, then by the one found so far."""

OTHER_ORDER_SIGMAS = 5.0
"""A readout time is surely of the other sign if it is so many standard deviations below 0."""
SHUTTER_PRIOR_S = 0.03  # reaches from a readout time to the same of the other sign

ITERATIONS = 2  # for the row that decides when a landmark was exposed


@dataclass(frozen=True, eq=False)
class FoundAgain:
    """M keypoints of keyframes in which landmarks were found.

    Attributes:
        keyframes, landmarks: (M,) rows of the keyframes and landmarks searched.
        keypoints: (M,) of the keyframe.
        pixels: (M, 2) raw pixels, distorted as the image is.
        sigma_px: (M,) standard deviation of u and of v.
        inverse_depth: (M,) in 1/m as tracking has it, NaN without depth.
    """

    keyframes: Ints
    landmarks: Ints
    keypoints: Ints
    pixels: Array
    sigma_px: Array
    inverse_depth: Array

    def __len__(self) -> int:
        return len(self.keyframes)

    @property
    def keys(self) -> Ints:
        """One number (M,) for each keypoint of each keyframe."""
        return self.keyframes << 32 | self.keypoints

    def seen_twice(self) -> FoundAgain:
        """Those of landmarks that were found in two keyframes or more."""
        keep = group_sizes(self.landmarks) > 1
        return FoundAgain(
            self.keyframes[keep],
            self.landmarks[keep],
            self.keypoints[keep],
            self.pixels[keep],
            self.sigma_px[keep],
            self.inverse_depth[keep],
        )


class LandmarkSearch:
    """Searches landmarks (L,) of a map in keyframes (K,).

    Args:
        world: keyframes with their keypoints, landmarks with their descriptors.
        run: the trajectory, which gives the camera's velocities.
    """

    def __init__(
        self, world: WorldMap, run: SavedRun, keyframe_ids: Ints, landmark_ids: Ints
    ) -> None:
        self._camera = run.camera
        self._world, self._landmark_ids = world, landmark_ids
        self._keyframes = [world.keyframes[k] for k in keyframe_ids.tolist()]
        stamps_s = np.array([k.timestamp_s for k in self._keyframes])
        self.twists = twists_at(run.trajectories["trajectory.txt"], stamps_s)
        self._seen = [self._camera.undistort(k.features.image_pixels) for k in self._keyframes]

    def find(
        self, poses: Array, points_world: Array, shutter_s: float, radius_px: float
    ) -> FoundAgain:
        """The landmarks with poses (K, 4, 4), points (L, 3) in m and a readout time."""
        parts = []
        for row, (keyframe, T_world_camera) in enumerate(zip(self._keyframes, poses, strict=True)):
            points = transform(inverse(T_world_camera), points_world)
            pixels = _exposed(points, self.twists[row], self._camera, shutter_s)
            parts.append(self._found(row, keyframe, pixels, radius_px))
        return concatenated(parts)

    def _found(self, row: int, keyframe: Keyframe, pixels: Array, radius_px: float) -> FoundAgain:
        """The landmarks at undistorted pixels (L, 2), NaN where not in view, in a keyframe."""
        features, landmarks = keyframe.features, self._world.landmarks
        visible = np.flatnonzero(np.isfinite(pixels[:, 0]))
        ids = self._landmark_ids[visible]
        pairs = WindowIndex(self._seen[row]).pairs(
            pixels[visible], np.full(len(visible), radius_px)
        )
        matches = match_pairs(
            pairs, (landmarks.descriptors[ids], features.descriptors), MatchConfig()
        )
        matches = matches[~keyframe.masked[matches.train]]
        at, ids = matches.train, ids[matches.query]
        sigma_px = features.sigmas_px[:, 0]
        other = keyframe.landmark_ids[at] != ids  # at most registered to another landmark's patch
        sigma_px = np.where(other, sigma_px.max(initial=0.0), sigma_px[at])
        rows = np.full(len(at), row)
        pixels, inverse_depth = features.image_pixels[at], 1 / features.depth_m[at]
        return FoundAgain(rows, visible[matches.query], at, pixels, sigma_px, inverse_depth)


def concatenated(parts: list[FoundAgain]) -> FoundAgain:
    """All of them, one after the other."""
    return FoundAgain(
        np.concatenate([part.keyframes for part in parts]),
        np.concatenate([part.landmarks for part in parts]),
        np.concatenate([part.keypoints for part in parts]),
        np.concatenate([part.pixels for part in parts]),
        np.concatenate([part.sigma_px for part in parts]),
        np.concatenate([part.inverse_depth for part in parts]),
    )


def _exposed(points: Array, twist: Array, camera: Camera, shutter_s: float) -> Array:
    """Undistorted pixels (L, 2) of points (L, 3) in a moving camera's frame; NaN out of view."""
    front = points[:, 2] > MIN_DEPTH_M
    points = np.where(front[:, None], points, [0.0, 0.0, 1.0])
    pixels = camera.project(points)
    for _ in range(ITERATIONS):
        rows = np.clip(pixels[:, 1], 0, camera.height - 1)
        later_s = shutter_s * camera.share_of_rows(rows)
        pixels = camera.project(points + later_s[:, None] * velocities(points, twist))
    inside = front & (pixels > 0).all(axis=1)
    inside &= (pixels < [camera.width - 1, camera.height - 1]).all(axis=1)
    return np.where(inside[:, None], pixels, np.nan)


class RunProblem:
    """The calibration problem of a run, from landmarks that are found again for each round.

    Args:
        world, run: of the same system, at the same moment.
        reader: depth images of its keyframes.
        given: the camera that is in question; the run's may have more, which was found before.

    Raises:
        InputError: a keyframe's depth image is missing or broken.
    """

    def __init__(self, world: WorldMap, run: SavedRun, reader: DepthReader, given: Camera) -> None:
        seen = connected_views(run.tables, reader.keyframe_ids, MAX_KEYFRAMES)
        seen = seen.select(world.landmarks.in_map[seen.landmark_ids])
        self._reader, self._camera, self._given = reader, run.camera, given
        self._keyframe_ids = np.unique(seen.keyframe_ids)
        landmark_ids, views = np.unique(seen.landmark_ids, return_counts=True)
        most = np.argsort(-views, kind="stable")
        most = most[np.cumsum(views[most]) <= MAX_OBSERVATIONS]
        landmark_ids = np.sort(landmark_ids[most])
        self._search = LandmarkSearch(world, run, self._keyframe_ids, landmark_ids)
        self._poses = run.tables.keyframes.get(self._keyframe_ids)
        self._points = run.tables.landmarks.get(landmark_ids)
        self._seen = seen
        self._depths: tuple[Ints, Depths] | None = None
        self._rows = np.zeros(0, np.int64), np.zeros(0, np.int64)

    @property
    def large_enough(self) -> bool:
        """Whether enough keyframes share landmarks."""
        return len(self._keyframe_ids) >= MIN_KEYFRAMES and len(self._points) > 0

    def problem(self, shutter_s: float, radius_px: float) -> CalibrationProblem:
        """The problem with landmarks searched by a readout time in windows of a radius."""
        found = self._search.find(self._poses, self._points, shutter_s, radius_px).seen_twice()
        keyframe_rows, keyframes = np.unique(found.keyframes, return_inverse=True)
        landmark_rows, landmarks = np.unique(found.landmarks, return_inverse=True)
        self._rows = keyframe_rows, landmark_rows
        camera = self._camera
        nominal = sensor_sigmas(self._seen, camera, found.inverse_depth)
        depths = self._depths_at(found, nominal)
        T_camera_world = inverse(self._poses)[found.keyframes]
        points = transform(T_camera_world, self._points[found.landmarks][:, None])[:, 0]
        moving = velocities(points, self._search.twists[found.keyframes])
        views = CalibrationViews(
            keyframes=keyframes,
            landmarks=landmarks,
            pixels=found.pixels,
            places=camera.image_places(found.pixels),
            inverse_depth=depths.inverse_depth,
            inverse_depth_rate=depths.rate,
            lag_s=depths.lag_s,
            sigma_px=found.sigma_px,
            sigma_inverse=np.hypot(nominal, depths.rms),
            shutter_velocity=camera.share_of_rows(found.pixels[:, 1])[:, None] * moving,
        )
        start = parameters_of(self._given, self._given.depth_scale)
        poses, points_world = self._poses[keyframe_rows], self._points[landmark_rows]
        return CalibrationProblem(
            views, poses, points_world, start, estimated_priors(self._given, FREE), GAUGE_SIGMAS
        )

    def move_to(self, result: CalibrationResult) -> None:
        """Go on from the poses and points that were found for the last problem."""
        keyframes, landmarks = self._rows
        self._poses[keyframes] = result.poses_world_camera
        self._points[landmarks] = result.points_world

    def _depths_at(self, found: FoundAgain, sigmas: Array) -> Depths:
        """Depth measurements at keypoints; those of the first round only, later ones have none."""
        if self._depths is None:
            seen = self._keyframe_ids, found.keyframes
            measured = measured_depths(self._reader, seen, found.pixels, sigmas)
            self._depths = found.keys, measured
        keys, measured = self._depths
        order = np.argsort(keys, kind="stable")
        rows = order[np.minimum(np.searchsorted(keys[order], found.keys), len(keys) - 1)]
        return measured.select(rows, keys[rows] == found.keys)


def estimate_again(
    world: WorldMap, run: SavedRun, reader: DepthReader, given: Camera, worth_s: float
) -> Estimate | None:
    """What a run's keyframes say of the camera given for it; None if they are too few.

    Landmarks are searched with the run's camera first, then with that found. If the first round
    finds the given camera's times, within ``worth_s``, there is no other.

    Raises:
        InputError: a keyframe's depth image is missing or broken.
    """
    problems = RunProblem(world, run, reader, given)
    if not problems.large_enough:
        return None
    shutter_s, estimate, other = run.camera.rolling_shutter_s, None, False
    for radius_px in RADII_PX:
        problem = problems.problem(shutter_s, radius_px)
        result = calibrate(problem, QUICK)
        if estimate is None and given.rolling_shutter_s:
            other = _is_in_other_order(problem, result)
        problems.move_to(result)
        estimate = replace(estimate_of(problem, result), in_other_order=other)
        shutter_s = float(estimate.found[SHUTTER])
        if max(abs(estimate.found[i] - estimate.before[i]) for i in TIMES) < worth_s:
            break
    return estimate


def _is_in_other_order(problem: CalibrationProblem, result: CalibrationResult) -> bool:
    """Whether rows are surely read in the order opposite to that of the camera's readout time.

    Keypoints then fit better with a readout time of the other sign.
    """
    sigmas = problem.prior_sigmas.copy()
    sigmas[SHUTTER] = SHUTTER_PRIOR_S
    free = calibrate(replace(problem, prior_sigmas=sigmas), QUICK)
    found_s = free.calibration[SHUTTER] * np.sign(problem.calibration[SHUTTER])
    sigma_s = np.sqrt(free.covariance[SHUTTER, SHUTTER])
    better = free.noise_scales[0] < result.noise_scales[0]
    return bool(found_s + OTHER_ORDER_SIGMAS * sigma_s < 0 and better)
