"""The surface of a run: the keyframes' fused depth first, then every tracked frame."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bmask_slam.dense.folder import DenseFolder
from bmask_slam.dense.keyframe_input import MAX_STAMP_ERROR_S, undistort_images
from bmask_slam.dense.options import MapOptions, fusion_config
from bmask_slam.dense.saved_map import MappedRun, SavedMap
from bmask_slam.graph.arrays import Array, Arrays, Floats, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.file_names import refuse_link
from bmask_slam.graph.files.whole_file import remove, writing
from bmask_slam.graph.trajectory import nearest_indices, read_tum, rows_after_gaps
from bmask_slam.mapping.inverse_depth.depth_map import MeasurementConfig, from_sensor
from bmask_slam.mapping.inverse_depth.regularisation import regularise
from bmask_slam.mapping.products.surface_labels import dilate
from bmask_slam.mapping.surface.depth_frame import DepthFrame, depth_frame, mark_unexplained
from bmask_slam.mapping.surface.extraction import (
    MIN_JUDGE_M2,
    MIN_WITNESSES,
    Surface,
    extract,
    without_crumbs,
)
from bmask_slam.mapping.surface.following import FollowingSurface, read_kept
from bmask_slam.mapping.surface.gate import DepthView, KeyframeSurface, judge_of
from bmask_slam.mapping.surface.volume import SurfaceVolume
from bmask_slam.run_folder.frame_file import FRAMES, read_frames
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.torch_threads import one_thread
from bmask_slam.sequences.frame import Frame
from bmask_slam.sequences.prefetch import prefetched
from bmask_slam.tracking.results import TrackingStatus
from bmask_slam.world.keyframe import Keyframe

logger = logging.getLogger(__name__)

Progress = Callable[[int, int], None]

VOLUME, INDEX = "volume", "index"
"""The folder of a volume that is kept, and its file of what is in it."""
BESIDE_PX = 20
"""Depth so near to a mask that was cut out may be of the same person."""


@dataclass(frozen=True, eq=False)
class FusedMap:
    """A dense map whose keyframes are fused.

    Attributes:
        run: the map of the run. labels: of its instances. folder: RUN/dense. options: resolved.
    """

    run: SavedMap
    labels: LabelSet
    folder: DenseFolder
    options: MapOptions

    def keyframes(self) -> list[Keyframe]:
        """The keyframes that are fused, oldest first."""
        return [k for k in self.run.keyframes if self.folder.is_done(k.id)]


def make_surface(fused: FusedMap, progress: Progress = lambda done, total: None) -> Surface:
    """The surface of the keyframes and, where their images are known, of all tracked frames.

    A frame is used where it is not in front of the keyframes' surface, from which people were cut
    out. What they did not see is kept where enough frames saw it. If the volume of an earlier call
    was kept, only frames whose poses moved are read again, and those that share blocks with them.

    Raises:
        InputError: images of a keyframe cannot be used, or the disk is full.
    """
    run, options = fused.run, fused.options
    frames = tracked_frames(run) if isinstance(run, MappedRun) else []
    if options.source not in ("sensor", "both"):
        frames = []
    with one_thread():
        return _SurfaceMaker(fused).make(dict(frames), progress)


class _SurfaceMaker:
    """Integrates the keyframes of a dense map, then frames. A keyframe's number is -1 - its id."""

    def __init__(self, fused: FusedMap) -> None:
        """Raises InputError: the volume cannot be stored."""
        self._fused = fused
        self._gate: KeyframeSurface | None = None
        self._measurement = fusion_config(fused.options).measurement
        self._keyframes = {-1 - k.id: k for k in fused.keyframes()}
        self._folder = fused.folder.path / VOLUME
        refuse_link(self._folder)
        arrays = read_or_clear(self._folder, self._made_of()) if self._kept else None
        keys = np.zeros(0, np.int64) if arrays is None else arrays["keys"]
        volume = self._volume(self._folder, keys) if self._kept else self._volume()
        self._surface = FollowingSurface(volume, self._load)
        if arrays is not None:
            self._surface.restore(arrays)

    @property
    def _kept(self) -> bool:
        return self._fused.options.keep_volume

    def make(self, frames: dict[int, Array], progress: Progress) -> Surface:
        """The surface of all keyframes and of frames at T_world_camera (4, 4)."""
        surface, voxel_m = self._surface, self._fused.options.surface_voxel_m
        poses = {n: k.T_world_camera for n, k in self._keyframes.items()} | frames
        alone = FollowingSurface(self._volume(), self._load) if len(surface) else surface
        for number in self._keyframes if frames or alone is surface else ():
            alone.add(number, self._keyframe(number, poses[number]))
        if frames:
            seen = without_crumbs(extract(alone.volume, 1), voxel_m, MIN_JUDGE_M2)
            self._gate = judge_of(seen.vertices, self._views(), self._fused.run.camera)
        gone = [n for n in surface if n not in poses]
        read = surface.follow(poses, gone, lambda done: progress(done, len(poses)))
        if read:
            logger.info("%d frames and keyframes were integrated again", read)
        new = {n: T for n, T in frames.items() if n not in surface}
        handled = len(poses) - len(new)
        progress(handled, len(poses))
        ahead = prefetched(self._frame(number, T) for number, T in new.items())
        for done, (number, frame) in enumerate(zip(new, ahead, strict=True), handled + 1):
            if frame is not None:
                surface.add(number, frame)
            progress(done, len(poses))
        found = extract(surface.volume, MIN_WITNESSES if frames else 1)
        if self._kept:
            surface.save(self._folder / INDEX, self._made_of())
        return without_crumbs(found, voxel_m)

    def _views(self) -> Iterator[DepthView]:
        """The fused depth of the keyframes, oldest first, without what is beside cut-out masks."""
        numbers = [self._fused.labels.number(n) for n in self._fused.options.excluded or ()]
        for keyframe in self._keyframes.values():
            yield (
                unmasked_depth_m(self._fused.folder, keyframe.id, numbers),
                keyframe.T_world_camera,
            )

    def _volume(self, folder: Path | None = None, kept: Ints | None = None) -> SurfaceVolume:
        folder = self._fused.folder.path if folder is None else folder
        options, camera = self._fused.options, self._fused.run.camera
        return SurfaceVolume(options.surface_voxel_m, camera, folder=folder, kept=kept)

    def _made_of(self) -> dict[str, Any]:
        """What a kept volume must be of, beside the settings of the folder: all but poses."""
        ids = sorted(k.id for k in self._keyframes.values())
        return {
            "camera": repr(self._fused.run.camera),
            "voxel_m": self._fused.options.surface_voxel_m,
            "keyframes": [[number, self._fused.folder.written_ns(number)] for number in ids],
        }

    def _load(self, number: int, T_world_camera: Array) -> DepthFrame | None:
        if number < 0:
            return self._keyframe(number, T_world_camera)
        return self._frame(number, T_world_camera)

    def _keyframe(self, number: int, T_world_camera: Array) -> DepthFrame:
        fused = self._fused
        camera, voxel_m = fused.run.camera, fused.options.surface_voxel_m
        return keyframe_as_frame(fused.folder, -1 - number, T_world_camera, camera, voxel_m)

    def _frame(self, index: int, T_world_camera: Array) -> DepthFrame | None:
        """A frame after Step 3 and the gate; None if its images cannot be read."""
        run, options = self._fused.run, self._fused.options
        assert isinstance(run, MappedRun)
        assert self._gate is not None
        try:
            images = run.sequence.load(index)
        except InputError as error:
            logger.warning("%s; not in the surface", error)
            return None
        measured = self._measurement, options.surface_voxel_m
        return gated_frame(images, T_world_camera, self._gate, run.camera, *measured)


def keyframe_as_frame(
    folder: DenseFolder, keyframe_id: int, T_world_camera: Array, camera: Camera, voxel_m: float
) -> DepthFrame:
    """A fused keyframe for a volume. Raises InputError: its images cannot be used."""
    depth, rgb = folder.fused(keyframe_id), folder.colours(keyframe_id)
    pixels = folder.evidence(keyframe_id).pixels
    if {depth.rho.shape, rgb.shape[:2], pixels.shape} != {(camera.height, camera.width)}:
        raise InputError(
            f"{folder.path}: the images of keyframe {keyframe_id} are not of the camera's size; "
            "remove the folder and map again"
        )
    return depth_frame(depth, rgb, T_world_camera, camera, voxel_m)


def gated_frame(
    images: Frame,
    T_world_camera: Array,
    gate: KeyframeSurface,
    camera: Camera,
    measurement: MeasurementConfig,
    voxel_m: float,
) -> DepthFrame:
    """A frame, distorted, for a volume: after Step 3, without what the gate refuses."""
    rgb, depth_m = undistort_images(images, camera)
    measured = regularise(from_sensor(depth_m, camera, measurement))
    verdict = gate.judge(measured.depth_m(), T_world_camera)
    measured = measured.without(verdict.in_front)
    frame = depth_frame(measured, rgb, T_world_camera, camera, voxel_m)
    mark_unexplained(frame, verdict.unexplained)
    return frame


def unmasked_depth_m(folder: DenseFolder, keyframe_id: int, excluded: list[int]) -> Floats:
    """The fused depth (H, W) of a keyframe without what is beside instances of these classes."""
    evidence = folder.evidence(keyframe_id)
    of_excluded = np.isin(evidence.log_likelihoods.argmax(axis=1), excluded)
    cut_out = np.isin(evidence.pixels, np.flatnonzero(of_excluded))
    return folder.fused(keyframe_id).without(dilate(cut_out, BESIDE_PX)).depth_m()


def read_or_clear(folder: Path, made_of: dict[str, Any]) -> Arrays | None:
    """What ``read_kept`` finds in a folder of a volume; if nothing, an empty folder is made there.

    Raises:
        InputError: it cannot be written.
    """
    with writing(folder):
        arrays = read_kept(folder / INDEX, made_of)
        if arrays is None:
            remove(folder)
            folder.mkdir()
    return arrays


def tracked_frames(run: MappedRun) -> list[tuple[int, Array]]:
    """Index and final T_world_camera (4, 4) of the frames that images gave a pose.

    None without a trajectory; those reckoned by odometry alone are left out.
    """
    path = run.path / "trajectory.txt"
    if not path.is_file():
        return []
    trajectory, stamps_s = read_tum(path), run.sequence.timestamps_s
    nearest = nearest_indices(stamps_s, trajectory.timestamps_s)
    same = np.abs(stamps_s[nearest] - trajectory.timestamps_s) <= MAX_STAMP_ERROR_S
    same &= ~np.isin(trajectory.timestamps_s, _reckoned_s(run.path / FRAMES))
    poses = trajectory.poses_world_camera
    return [(int(nearest[k]), poses[k]) for k in np.flatnonzero(same).tolist()]


def lost_before(run: Path, stamps_s: Sequence[float]) -> Ints:
    """The rows of stamps (N,) before which frames are missing in the run's trajectory.txt.

    There the camera was lost, or another recording begins.
    """
    path = run / "trajectory.txt"
    found_s = read_tum(path).timestamps_s if path.is_file() else np.zeros(0)
    rows = rows_after_gaps(found_s)
    gaps_before = np.searchsorted((found_s[rows] + found_s[rows - 1]) / 2, stamps_s)
    return np.flatnonzero(np.diff(gaps_before) > 0) + 1


def _reckoned_s(path: Path) -> Array:
    """Stamps of the frames whose poses are by odometry alone, as trajectory.txt has them.

    Their indices do not serve: a live run counts the frames that it tracked.
    """
    if not path.is_file():
        return np.zeros(0)
    frames = read_frames(path)
    return frames.timestamps_s[np.array(frames.status) == TrackingStatus.DEAD_RECKONING.value]


def frames_a_keyframe(fused: FusedMap) -> float:
    """How many tracked frames there are for each keyframe, at least 1."""
    run = fused.run
    frames = len(tracked_frames(run)) if isinstance(run, MappedRun) else 0
    return max(frames / max(len(fused.keyframes()), 1), 1.0)
