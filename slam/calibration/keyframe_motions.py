"""By what keyframes and other frames are interpreted anew with a camera that was found.

Their rows were exposed one after the other, and their depth images some time before or after: with
another readout time or delay, keypoints and depths move by the camera's velocity.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

import numpy as np

from bmask_slam.back_end.reinterpretation import KeyframeMotion
from bmask_slam.calibration.motion import twists_at
from bmask_slam.calibration.views import frames_of
from bmask_slam.features.brisk import FeatureConfig
from bmask_slam.features.keypoint_depth import sample_depth
from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.threads import in_threads
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.sequences.sequence import Sequence
from bmask_slam.world.frame_observations import FrameObservations, FrameView
from bmask_slam.world.keyframe import Keyframe

DepthChange = Callable[[Keyframe], tuple[Ints, Array]]
"""Keypoints (N,) of a keyframe, and what to add to their inverse depths (N,) in 1/m."""
FrameChange = Callable[[float, Array], tuple[Ints, Array]]
"""The same from a frame's stamp and the places (N, 2) of its keypoints in the image."""


def keyframe_motions(
    keyframes: Collection[Keyframe],
    paths: Mapping[int, Trajectory],
    depth_change: DepthChange | None,
) -> dict[int, KeyframeMotion]:
    """The motion of keyframes, by id.

    ``paths`` has the trajectory of each segment; ``depth_change`` is None if the delay of depth is
    the old one.
    """

    def motion(k: Keyframe) -> KeyframeMotion:
        twist = _twist_of(k.timestamp_s, paths.get(k.segment))
        return KeyframeMotion(twist, *(depth_change(k) if depth_change else ()))

    return dict(zip((k.id for k in keyframes), in_threads(motion, keyframes), strict=True))


def frame_motions(
    frames: FrameObservations, paths: Mapping[int, Trajectory], depth_change: FrameChange | None
) -> dict[float, KeyframeMotion]:
    """The motion of the other frames, by stamp."""
    motions: dict[float, KeyframeMotion] = {}
    for path in paths.values():
        known = set(path.timestamps_s.tolist())
        views = [view for view in frames.views if view.timestamp_s in known]
        stamps_s = [view.timestamp_s for view in views]
        twists = twists_at(path, np.array(stamps_s))

        def motion(seen: tuple[FrameView, Array]) -> KeyframeMotion:
            view, twist = seen
            pixels = view.columns[:, 2:4].astype(float)
            change = depth_change(view.timestamp_s, pixels) if depth_change else ()
            return KeyframeMotion(twist, *change)

        found = in_threads(motion, zip(views, twists, strict=True))
        motions |= dict(zip(stamps_s, found, strict=True))
    return motions


def motions_without_images(
    frames: FrameObservations, paths: Mapping[int, Trajectory], old: Camera, new: Camera
) -> dict[float, KeyframeMotion]:
    """The motion of the other frames whose images are gone, by stamp.

    Empty if the cameras differ in the delay of depth: what that does is not known without images.
    """
    if old.depth_time_offset_s != new.depth_time_offset_s:
        return {}
    return frame_motions(frames, paths, None)


def _twist_of(stamp_s: float, path: Trajectory | None) -> Array:
    """The camera's velocity (6,) at a stamp; zero where it is not known."""
    if path is None or not len(path):
        return np.zeros(6)
    return twists_at(path, np.array([stamp_s]))[0]


def depth_change_between(
    before: Sequence, after: Sequence, seen: tuple[float, Array], config: FeatureConfig
) -> tuple[Ints, Array]:
    """What another delay does to the depths of keypoints, by their images; 0 where one has none.

    ``seen`` are a frame's stamp and the places (N, 2) of its keypoints in the image. The sequences
    are the same images with either delay. Raises InputError for a broken image.
    """
    old, new = (_inverse_depth(images, *seen, config) for images in (before, after))
    return np.arange(len(old)), np.nan_to_num(new - old)


def _inverse_depth(
    sequence: Sequence, stamp_s: float, pixels: Array, config: FeatureConfig
) -> Array:
    """As tracking measures it at keypoints, in 1/m (N,); NaN if the sequence has no such frame."""
    frames = frames_of({0: stamp_s}, sequence)
    if not frames:
        return np.full(len(pixels), np.nan)
    return 1.0 / sample_depth(sequence.depth(frames[0])[0], pixels, config)[0]
