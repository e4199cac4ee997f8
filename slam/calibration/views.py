"""The measurements for self-calibration: raw pixels, raw depths and their rates of change."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from bmask_slam.calibration.motion import LandmarkVelocities, as_exposed
from bmask_slam.features.keypoint_depth import mean_on_plane, smooth_value
from bmask_slam.graph.arrays import Array, Floats, Ints, Mask
from bmask_slam.graph.calibration.model import CalibrationViews
from bmask_slam.graph.camera import NO_DEPTH_DISTORTION, Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_update import Observations
from bmask_slam.graph.factors.observability import component_labels
from bmask_slam.graph.threads import in_threads
from bmask_slam.graph.trajectory import nearest_indices
from bmask_slam.sequences.images import SURFACE_STEP
from bmask_slam.sequences.sequence import Sequence

Real = TypeVar("Real", Floats, Array)
MIN_VIEWS = 2
MIN_KEYFRAME_VIEWS = 12
MAX_RATE_STEP_S = 0.2
SAME_STAMP_S = 1e-5


def connected_views(tables: FactorTables, keyframe_ids: Ints, most: int) -> Observations:
    """The observations of the largest set of these keyframes that shared landmarks connect.

    Of more than ``most`` keyframes those with most observations are used. Landmarks observed once
    and keyframes that share few landmarks do not constrain the calibration. Relative poses, as of
    loops, are not used: they were measured with the calibration in question.
    """
    table = tables.observations
    found = table.all()
    found = found.select(np.isin(found.keyframe_ids, keyframe_ids))
    ids, count = np.unique(found.keyframe_ids, return_counts=True)
    if len(ids) > most:
        richest = ids[np.argsort(-count, kind="stable")[:most]]
        found = found.select(np.isin(found.keyframe_ids, richest))
    while True:
        views = group_sizes(found.landmark_ids)
        keep = (views >= MIN_VIEWS) & (group_sizes(found.keyframe_ids) >= MIN_KEYFRAME_VIEWS)
        if keep.all():
            break
        found = found.select(keep)
    return found.select(np.isin(found.keyframe_ids, _largest_part(found)))


def group_sizes(ids: Ints) -> Ints:
    """How often each of the ids (M,) occurs among them (M,)."""
    _, rows, count = np.unique(ids, return_inverse=True, return_counts=True)
    return np.asarray(count[rows])


def _largest_part(observations: Observations) -> Ints:
    """Ids of the keyframes in the largest part that shared landmarks connect."""
    ids = np.unique(observations.keyframe_ids)
    labels = component_labels(ids, observations, ())
    return ids[labels == np.bincount(labels, minlength=1).argmax()]


def make_views(
    observations: Observations, reader: SequenceDepths, motion: LandmarkVelocities
) -> tuple[CalibrationViews, Ints, Ints]:
    """The views of a run, and the ids (K,) and (L,) of keyframes and landmarks.

    The camera of the reader's sequence must be the run's. Pixels get back the distortion and the
    rolling shutter of the image; depths are read again from the raw depth images.

    Raises:
        InputError: a keyframe's depth image is missing or broken.
    """
    camera = reader.sequence.camera
    keyframe_ids, keyframes = np.unique(observations.keyframe_ids, return_inverse=True)
    landmark_ids, landmarks = np.unique(observations.landmark_ids, return_inverse=True)
    pixels = camera.distort(as_exposed(observations.measurements[:, :2], motion, camera))
    nominal = sensor_sigmas(observations, camera)
    depths = measured_depths(reader, (keyframe_ids, keyframes), pixels, nominal)
    views = CalibrationViews(
        keyframes=keyframes,
        landmarks=landmarks,
        pixels=pixels,
        places=camera.image_places(pixels),
        inverse_depth=depths.inverse_depth,
        inverse_depth_rate=depths.rate,
        lag_s=depths.lag_s,
        sigma_px=observations.sigmas_px[:, 0],
        sigma_inverse=np.hypot(nominal, depths.rms),
        shutter_velocity=camera.share_of_rows(pixels[:, 1])[:, None] * motion.velocities,
    )
    return views, keyframe_ids, landmark_ids


def sensor_sigmas(
    observations: Observations, camera: Camera, inverse_depth: Array | None = None
) -> Array:
    """Sigmas of inverse depths in 1/m by the depth sensor alone; the median's without depth.

    Those of the M observations, or of ``inverse_depth`` (N,).

    Those of the graph's observations include the roughness of the surface, which is fitted here:
    the camera's noise model is scaled to the smallest of them.
    """
    left, _, right = observations.measurements.T
    noise, seen = camera.noise_of_depth(), (left - right) / camera.stereo_bf_px_m
    graph = observations.sigmas_px[:, 2] / camera.stereo_bf_px_m
    scale = float(np.nanmin(graph / noise.inverse_depth_sigma(seen)))
    sigmas = scale * noise.inverse_depth_sigma(seen if inverse_depth is None else inverse_depth)
    return np.where(np.isfinite(sigmas), sigmas, np.nanmedian(sigmas))


@dataclass(frozen=True, eq=False)
class Depths:
    """Measurements of the depth images at M pixels.

    Attributes:
        inverse_depth: (M,) 1/m, of a plane fitted around the pixel; NaN where there is none.
        rms: (M,) 1/m, distance of the pixels around from the plane.
        rate: (M,) 1/(m s), change of the inverse depth at the pixel.
        lag_s: (M,), how much later the depth image was taken than the colour image.
    """

    inverse_depth: Array
    rms: Array
    rate: Array
    lag_s: Array

    @classmethod
    def missing(cls, count: int) -> Depths:
        """No measurements yet."""
        inverse_depth, rms, rate = np.full((3, count), np.nan)
        return cls(inverse_depth, rms, rate, np.zeros(count))

    def select(self, rows: Ints, known: Mask) -> Depths:
        """Those of some rows (m,), missing where they are not known (m,)."""
        return Depths(
            np.where(known, self.inverse_depth[rows], np.nan),
            np.where(known, self.rms[rows], np.nan),
            np.where(known, self.rate[rows], np.nan),
            np.where(known, self.lag_s[rows], 0.0),
        )

    def put(self, rows: Ints, measured: Depths) -> None:
        """Set what was measured at some rows (m,)."""
        self.inverse_depth[rows], self.rms[rows] = measured.inverse_depth, measured.rms
        self.rate[rows], self.lag_s[rows] = measured.rate, measured.lag_s


class DepthReader(Protocol):
    """Raw depth images of keyframes, which the camera's offset and distortion have not changed."""

    @property
    def keyframe_ids(self) -> Ints:
        """(K,) ascending, of the keyframes whose depth images are at hand."""

    def measure(self, keyframe_id: int, pixels: Array, sigmas: Array) -> Depths:
        """At pixels (m, 2) as exposed, whose inverse depths have these sigmas (m,) in 1/m.

        Raises:
            InputError: the depth image is missing or broken.
        """


def measured_depths(
    reader: DepthReader, keyframes: tuple[Ints, Ints], pixels: Array, sigmas: Array
) -> Depths:
    """What a reader measures at pixels (M, 2) as exposed.

    ``keyframes`` are the ids (K,) of keyframes and the row in them of each pixel (M,); the inverse
    depths have these sigmas (M,) in 1/m. Raises InputError as ``DepthReader.measure``.
    """
    ids, rows_of = keyframes

    def measured(row: int) -> tuple[Ints, Depths]:
        rows = np.flatnonzero(rows_of == row)
        return rows, reader.measure(int(ids[row]), pixels[rows], sigmas[rows])

    found = Depths.missing(len(pixels))
    for rows, depths in in_threads(measured, range(len(ids))):
        found.put(rows, depths)
    return found


def frames_of(stamps_s: dict[int, float], sequence: Sequence) -> dict[int, int]:
    """The frames of a sequence with these stamps, by the same keys; others are left out."""
    known = {k: s for k, s in stamps_s.items() if np.isfinite(s)}
    at = nearest_indices(sequence.timestamps_s, np.array(list(known.values())))
    near = np.abs(sequence.timestamps_s[at] - np.array(list(known.values()))) < SAME_STAMP_S
    pairs = zip(known, at.tolist(), near, strict=True)
    return {k: index for k, index, ok in pairs if ok}


class SequenceDepths:
    """The depth images of keyframes in a sequence.

    Args:
        stamps_s: of each keyframe, by id; those that the sequence does not have are left out.
    """

    def __init__(self, stamps_s: dict[int, float], sequence: Sequence) -> None:
        self.sequence, self._frames = sequence, frames_of(stamps_s, sequence)

    @property
    def keyframe_ids(self) -> Ints:
        """(K,) ascending."""
        return np.array(sorted(self._frames), np.int64)

    def measure(self, keyframe_id: int, pixels: Array, sigmas: Array) -> Depths:
        """As `DepthReader.measure`."""
        sequence, index = self.sequence, self._frames[keyframe_id]
        image = _raw_inverse_depth(sequence, index)
        lag_s = sequence.pairs.lags_s[index] - sequence.camera.depth_time_offset_s
        return measured_at(pixels, image, _rate_around(sequence, index), lag_s, sigmas)


def measured_at(pixels: Array, image: Array, rate: Array, lag_s: float, sigmas: Array) -> Depths:
    """Measurements at pixels (m, 2) of an image (H, W) of inverse depth, and of its rate."""
    planes, rms, max_step = smooth_value(image, pixels, sigmas)
    rates = mean_on_plane(rate, image, pixels, planes, max_step)
    return Depths(planes[:, 0], rms, rates, np.full(len(rms), lag_s))


def _raw_inverse_depth(sequence: Sequence, index: int) -> Array:
    """Inverse depth (H, W) of a frame as the sensor has it, only scaled; NaN where missing."""
    camera = dataclasses.replace(
        sequence.camera, depth_offset_m=0.0, depth_distortion=NO_DEPTH_DISTORTION
    )
    file = sequence.pairs.depth_files[index]
    return 1.0 / sequence.recording.read_depth(file, camera).astype(float)


def _rate_around(sequence: Sequence, index: int) -> Array:
    """Change (H, W) of inverse depth in a second, by the previous and the next depth image.

    NaN where the surface changed, and everywhere if an image is missing, broken or too far in time.
    """
    unknown = np.full((sequence.camera.height, sequence.camera.width), np.nan)
    if not 0 < index < len(sequence) - 1:
        return unknown
    around = [index - 1, index + 1]
    try:
        first, last = (_raw_inverse_depth(sequence, i) for i in around)
    except InputError:
        return unknown
    stamps_s = (sequence.pairs.timestamps_s + sequence.pairs.lags_s)[around]
    step_s = float(stamps_s[1] - stamps_s[0])
    return inverse_depth_change(first, last, step_s) / step_s


def inverse_depth_change(first: Real, last: Real, step_s: float) -> Real:
    """How much inverse depth (H, W) changes from one image to another, ``step_s`` later.

    NaN where the surface changed, and everywhere if no time passed, or too much.
    """
    change = last - first
    change[~(np.abs(change) <= SURFACE_STEP * first)] = np.nan
    if not 0 < step_s < MAX_RATE_STEP_S:
        change[:] = np.nan
    return change
