"""Landmarks that a blurred image shows without corners: measured where the flow takes them.

They are keypoints like others then: registered to the landmark's patch where the image allows it,
checked against the pose like every match, and observations of a keyframe if the frame becomes one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from bmask_slam.features.brisk import BriskExtractor, Features, select
from bmask_slam.features.matching import Matches
from bmask_slam.graph.arrays import Array, Arrays, Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.sequences.frame import Frame
from bmask_slam.tracking.image_motion import (
    Followed,
    ImageMotion,
    ImageMotionConfig,
    LastView,
    nothing_seen,
)
from bmask_slam.tracking.results import Tracked
from bmask_slam.world.landmark_table import LandmarkTable


@dataclass(frozen=True, eq=False)
class Guided:
    """Keypoints (M,) that were not detected, but where landmarks were followed to.

    They come after the ``detected`` keypoints of their frame.
    """

    features: Features
    landmark_ids: Ints
    detected: int


def with_guided(ids: Ints, matches: Matches, guided: Guided) -> tuple[Ints, Matches]:
    """Landmarks and matches, and further ones of guided landmarks without a match.

    Matches are of landmarks (query: position in ``ids``) and keypoints (train).
    """
    keypoints = guided.detected + np.arange(len(guided.landmark_ids))
    left = ~np.isin(guided.landmark_ids, ids[matches.query]) & ~np.isin(keypoints, matches.train)
    more, keypoints = guided.landmark_ids[left], keypoints[left]
    unseen = more[~np.isin(more, ids)]
    ids = np.concatenate([ids, unseen])
    order = np.argsort(ids, kind="stable")
    query = order[np.searchsorted(ids[order], more)]
    return ids, Matches(
        np.concatenate([matches.query, query]),
        np.concatenate([matches.train, keypoints]),
        np.concatenate([matches.distance, np.zeros(len(more), np.int64)]),
    )


def weighted(
    features: Features, matches: Matches, guided: Guided | None, config: ImageMotionConfig
) -> tuple[Features, Mask]:
    """The features with larger sigmas where keypoints rest on the flow alone; which matches do.

    Errors of the flow have common causes: blur, and the motion while the rows are read out. So
    these keypoints together weigh no more than as many of them as there are other matches, or than
    ``least_weight`` of them. Those where the landmark's patch was found are not among them: their
    sigmas are smaller than that of the flow.
    """
    if guided is None:
        return features, np.zeros(len(matches), bool)
    sigmas = features.sigmas_px.copy()
    pixel = sigmas[matches.train, 0]
    loose = (matches.train >= guided.detected) & (pixel >= config.sigma_px)
    others = max(np.count_nonzero(~loose), config.least_weight)
    sigmas[matches.train[loose], :2] *= math.sqrt(max(1.0, loose.sum() / others))
    return replace(features, sigmas_px=sigmas), loose


def without_unused(tracked: Tracked, guided: Guided) -> Tracked:
    """A tracked frame without those guided keypoints that observe no landmark."""
    first = guided.detected
    used = np.unique(tracked.keypoints[tracked.keypoints >= first])
    features = select(tracked.features, np.concatenate([np.arange(first), used]))
    moved = first + np.searchsorted(used, tracked.keypoints)
    keypoints = np.where(tracked.keypoints < first, tracked.keypoints, moved)
    return replace(tracked, features=features, keypoints=keypoints)


class GuidedLandmarks:
    """Remembers what the last tracked frame saw, and follows it into the next one.

    Attributes:
        frame: the frame that is looked at; None where none is.
        followed: what was followed into the frame that was begun; None if nothing was.
        surprise_px: how far the last frame was from where it had been expected.
    """

    def __init__(self, extractor: BriskExtractor, config: ImageMotionConfig) -> None:
        self.config = config
        self.frame: Frame | None = None
        self.followed: Followed | None = None
        self.surprise_px = 0.0
        self._last = nothing_seen()
        self._extractor = extractor
        self._motion = ImageMotion(extractor.camera, config)

    def use_camera(self, camera: Camera) -> None:
        """Follow corners as another camera sees them move."""
        self._motion.camera = camera

    @property
    def needed(self) -> bool:
        """Whether the next frame is hard to predict, or will probably show few landmarks."""
        few = self._last.inliers < self.config.few_inliers
        return few or self.surprise_px > self.config.surprise_px

    def state(self) -> Arrays:
        """What the last frame saw, as named arrays."""
        last = self._last
        return {
            "gray": last.gray.ravel(),
            "gray_shape": np.array(last.gray.shape),
            "image_pixels": last.image_pixels,
            "points_camera": last.points_camera,
            "landmark_ids": last.landmark_ids,
            "sigmas_px": last.sigmas_px,
            "inliers": np.array(last.inliers),
            "surprise_px": np.array(self.surprise_px),
        }

    def restore(self, state: Arrays) -> None:
        """Go on from a state."""
        self.surprise_px = float(state["surprise_px"])
        self._last = LastView(
            state["gray"].reshape(state["gray_shape"]),
            state["image_pixels"],
            state["points_camera"],
            state["landmark_ids"],
            state["sigmas_px"],
            int(state["inliers"]),
        )

    def forget(self) -> None:
        """The last frame does not show where the next one is."""
        self._last, self.surprise_px = nothing_seen(), 0.0
        self.end_frame()

    def end_frame(self) -> None:
        """Let go of what belongs to the frame that was looked at."""
        self.frame = self.followed = None

    def remember(
        self,
        features: Features,
        landmark_ids: Ints,
        poses: tuple[Array, Array],
        landmarks: LandmarkTable,
    ) -> None:
        """Keep what a tracked frame saw: landmarks (N,) of its features, -1 for none.

        The poses T_world_camera (4, 4) are the expected one and the one that was found. Sigmas
        that grew because many landmarks were followed do not grow again in the next frame.
        """
        followed, before = self.followed, self._last
        self.end_frame()
        self._last = self._motion.view(features, landmark_ids, poses[1], landmarks)
        if followed is not None:
            sigmas_px = np.full(len(landmarks) + 1, np.inf)  # the last entry is for id -1
            sigmas_px[before.landmark_ids[followed.rows]] = followed.sigmas_px
            sigmas_px[-1] = np.inf
            own = np.minimum(self._last.sigmas_px, sigmas_px[self._last.landmark_ids])
            self._last = replace(self._last, sigmas_px=own)
        self.surprise_px = self._motion.surprise_px(self._last, *poses)

    def follow_map(self, landmarks: LandmarkTable) -> None:
        """The map was changed by its owner: landmarks were fused or are no longer there."""
        ids = self._last.landmark_ids.copy()
        ids[ids >= len(landmarks)] = -1
        ids[ids >= 0] = landmarks.current(ids[ids >= 0])
        self._last = replace(self._last, landmark_ids=ids)

    def follow(self, features: Features, T_last_next: Array, ago_s: float) -> None:
        """Follow the last frame's corners, ``ago_s`` later, from an expected motion (4, 4)."""
        self.followed = None
        known = self.config.enabled and self.frame is not None
        if known and not ago_s > self.config.max_ago_s:
            self.followed = self._motion.follow(self._last, features, T_last_next, ago_s)

    def guided(self, features: Features, local_ids: Ints, landmarks: LandmarkTable) -> Guided:
        """The followed landmarks of the local map as keypoints of the frame that is looked at."""
        followed, frame = self.followed, self.frame
        assert followed is not None and frame is not None
        ids = self._last.landmark_ids[followed.rows]
        known = followed.estimate.inliers & np.isin(ids, landmarks.remaining(local_ids))
        pixels, sigmas_px = followed.image_pixels[known], followed.sigmas_px[known]
        ids, first = np.unique(ids[known], return_index=True)
        rows, keypoints = self._extractor.at(frame, features.gray, pixels[first])
        sigmas = keypoints.sigmas_px.copy()
        sigmas[:, :2] = sigmas_px[first][rows, None]
        return Guided(replace(keypoints, sigmas_px=sigmas), ids[rows], len(features))
