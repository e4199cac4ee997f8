"""The surface of a run: the keyframes' fused depth first, then every tracked frame."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bmask_slam.dense.folder import DenseFolder
from bmask_slam.dense.keyframe_input import MAX_STAMP_ERROR_S, undistort_images
from bmask_slam.dense.options import MapOptions, fusion_config
from bmask_slam.dense.saved_map import MappedRun, SavedMap
from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.trajectory import nearest_indices, read_tum
from bmask_slam.mapping.inverse_depth.depth_map import from_sensor
from bmask_slam.mapping.inverse_depth.regularisation import regularise
from bmask_slam.mapping.surface.depth_frame import DepthFrame, depth_frame, mark_unexplained
from bmask_slam.mapping.surface.extraction import (
    MIN_WITNESSES,
    Surface,
    extract,
    without_crumbs,
)
from bmask_slam.mapping.surface.gate import KeyframeSurface
from bmask_slam.mapping.surface.volume import SurfaceVolume
from bmask_slam.run_folder.frame_file import FRAMES, read_frames
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.torch_threads import one_thread
from bmask_slam.tracking.results import TrackingStatus
from bmask_slam.world.world_map import Keyframe

logger = logging.getLogger(__name__)

AHEAD = 3
"""Frames that are prepared while another is integrated."""


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


def make_surface(
    fused: FusedMap, progress: Callable[[int, int], None] = lambda done, total: None
) -> Surface:
    """The surface of the keyframes and, where their images are known, of all tracked frames.

    A frame is used where it is not in front of the keyframes' surface, from which people were cut
    out. What they did not see is kept where enough frames saw it.
    """
    run, voxel_m = fused.run, fused.options.voxel_m
    with one_thread():
        volume = SurfaceVolume(voxel_m, run.camera)
        for keyframe in fused.keyframes():
            volume.integrate(_keyframe(fused, keyframe))
        frames = tracked_frames(run) if isinstance(run, MappedRun) else []
        if fused.options.source not in ("sensor", "both") or not frames:
            return without_crumbs(extract(volume, 1), voxel_m)
        gate = KeyframeSurface(extract(volume, 1).vertices, run.camera)
        for number, frame in enumerate(_prepared(fused, frames, gate)):
            if frame is not None:
                volume.integrate(frame)
            progress(number + 1, len(frames))
        return without_crumbs(extract(volume, MIN_WITNESSES), voxel_m)


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
    same &= ~np.isin(nearest, _reckoned(run.path / FRAMES))
    poses = trajectory.poses_world_camera
    return [(int(nearest[k]), poses[k]) for k in np.flatnonzero(same).tolist()]


def _reckoned(path: Path) -> Ints:
    """Indices of the frames whose poses are by odometry alone."""
    if not path.is_file():
        return np.zeros(0, np.int64)
    frames = read_frames(path)
    return frames.index[np.array(frames.status) == TrackingStatus.DEAD_RECKONING.value]


def frames_a_keyframe(fused: FusedMap) -> float:
    """How many tracked frames there are for each keyframe, at least 1."""
    run = fused.run
    frames = len(tracked_frames(run)) if isinstance(run, MappedRun) else 0
    return max(frames / max(len(fused.keyframes()), 1), 1.0)


def _keyframe(fused: FusedMap, keyframe: Keyframe) -> DepthFrame:
    folder, camera, voxel_m = fused.folder, fused.run.camera, fused.options.voxel_m
    depth, rgb = folder.fused(keyframe.id), folder.colours(keyframe.id)
    pixels = folder.evidence(keyframe.id).pixels
    if {depth.rho.shape, rgb.shape[:2], pixels.shape} != {(camera.height, camera.width)}:
        raise InputError(
            f"{folder.path}: the images of keyframe {keyframe.id} are not of the camera's size; "
            "remove the folder and map again"
        )
    return depth_frame(depth, rgb, keyframe.T_world_camera, camera, voxel_m)


def _prepared(
    fused: FusedMap, frames: list[tuple[int, Array]], gate: KeyframeSurface
) -> Iterator[DepthFrame | None]:
    """The frames in order, some prepared ahead by a second thread."""
    with ThreadPoolExecutor(1) as thread:
        waiting = [thread.submit(_frame, fused, *frame, gate) for frame in frames[:AHEAD]]
        for number in range(len(frames)):
            if number + AHEAD < len(frames):
                waiting.append(thread.submit(_frame, fused, *frames[number + AHEAD], gate))
            yield waiting.pop(0).result()


def _frame(
    fused: FusedMap, index: int, T_world_camera: Array, gate: KeyframeSurface
) -> DepthFrame | None:
    """A frame after Step 3 and the gate; None if its images cannot be read."""
    run = fused.run
    assert isinstance(run, MappedRun)
    try:
        rgb, depth_m = undistort_images(run.sequence.load(index), run.camera)
    except InputError as error:
        logger.warning("%s; not in the surface", error)
        return None
    measurement = fusion_config(fused.options).measurement
    measured = regularise(from_sensor(depth_m, run.camera, measurement))
    verdict = gate.judge(measured.depth_m(), T_world_camera)
    measured = measured.without(verdict.in_front)
    frame = depth_frame(measured, rgb, T_world_camera, run.camera, fused.options.voxel_m)
    mark_unexplained(frame, verdict.unexplained)
    return frame
