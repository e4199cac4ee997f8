"""Taking things out of the map and the graph together: what a mask covers, landmarks, a loop.

News about a keyframe may come seconds after it. By then its landmarks may have been fused into
others, culled, or retired from the graph, the keyframe may have been culled, its segment joined
to another, a loop closed. So everything is looked up by the ids as they are now. The graph is
asked first, since it may refuse; the map follows.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum, IntEnum

import numpy as np

from bmask_slam.back_end.factor_selection import read_back
from bmask_slam.graph.arrays import Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.graph_update import (
    GraphEstimate,
    GraphUpdate,
    Refusals,
    RelativePoseName,
    RemovalPolicy,
)
from bmask_slam.graph.smoother.smoother import Smoother
from bmask_slam.world.masked_keypoints import keypoints_under
from bmask_slam.world.world_map import Keyframe, WorldMap


class MaskScope(Enum):
    """What leaves where a mask covers a keyframe's keypoints."""

    VIEW = "view"
    """The keyframe's own observations: something stood before the landmarks there."""
    LANDMARKS = "landmarks"
    """The landmarks, with all observations: they are on the thing itself."""


class KeptReason(IntEnum):
    """Why a landmark that was asked for did not leave."""

    NOT_IN_MAP = 1
    """It never was, or was culled or pruned before."""
    KEYFRAME_CULLED = 2
    """Its observation left with the keyframe; nothing is left of it to take out."""
    REFUSED = 3
    """The whole request was refused."""


def _no_ids() -> Ints:
    return np.zeros(0, np.int64)


@dataclass(frozen=True)
class PruneReport:
    """What became of a request.

    Attributes:
        landmark_ids: (N,) sorted, out of the map and the graph with all their observations.
        observations: (N, 2) keyframe id, landmark id of those that left alone.
        loops: names of the relative poses that left.
        kept_ids, kept_reasons: (M,) landmarks that stay, and why (KeptReason).
        refused: why nothing was done; "" if it was.
        refused_variables: what the graph would have been left with, if that is the reason.
        dropped_landmarks: (N,) out of the graph as well, left underconstrained there; they are
            still in the map and may enter again.
        bridged_keyframes: (N,) left with too little, and held loosely where they are.
    """

    landmark_ids: Ints = field(default_factory=_no_ids)
    observations: Ints = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    loops: tuple[RelativePoseName, ...] = ()
    kept_ids: Ints = field(default_factory=_no_ids)
    kept_reasons: Ints = field(default_factory=_no_ids)
    refused: str = ""
    refused_variables: Refusals = field(default_factory=Refusals)
    dropped_landmarks: Ints = field(default_factory=_no_ids)
    anchored_keyframes: Ints = field(default_factory=_no_ids)


@dataclass(frozen=True)
class MapPruner:
    """Takes things out of one map and its graph, and leaves both consistent.

    ``policy`` says whether the graph refuses what would leave something underconstrained.
    Masks lose ``border_px`` all round, since segmentation errs there; negative widens them.
    """

    world: WorldMap
    smoother: Smoother
    camera: Camera
    policy: RemovalPolicy = RemovalPolicy.DROP
    border_px: int = 2

    def prune_mask(
        self, keyframe_id: int, mask: Mask, scope: MaskScope = MaskScope.VIEW
    ) -> PruneReport:
        """Take out what a keyframe observes under a mask (H, W) of its image, as recorded.

        The keypoints observe nothing from now on and make no landmark; under
        MaskScope.LANDMARKS all keypoints do so that observe the same landmarks.
        """
        expected = (self.camera.height, self.camera.width)
        if mask.shape != expected or mask.dtype != bool:
            given = f"{mask.dtype} of shape {mask.shape}"
            return PruneReport(refused=f"the mask is {given}, the image needs bool {expected}")
        keyframe = self.world.keyframes.get(keyframe_id)
        if keyframe is not None:
            keypoints = keypoints_under(mask, keyframe.features.image_pixels, self.border_px)
            return self._prune_view(keyframe, keypoints, scope)
        culled = self.world.culled.get(keyframe_id)
        if culled is None:
            return PruneReport(refused=f"keyframe {keyframe_id} is not in the map")
        keypoints = keypoints_under(mask, culled.image_pixels, self.border_px)
        ids = culled.landmark_ids[keypoints]
        if scope is MaskScope.LANDMARKS:
            return self.prune_landmarks(ids[ids >= 0])
        left = self.world.landmarks.living(self.world.landmarks.current(ids[ids >= 0]))
        return _with_kept(PruneReport(), left, KeptReason.KEYFRAME_CULLED)

    def prune_landmarks(self, ids: Ints) -> PruneReport:
        """Take landmarks (N,) out entirely; of fused ones, what they were fused into."""
        landmarks = self.world.landmarks
        known = (ids >= 0) & (ids < len(landmarks))
        unknown, ids = ids[~known], np.unique(landmarks.current(ids[known]))
        alive = landmarks.alive[ids]
        report = self._carry_out(ids[alive], np.zeros((0, 2), np.int64))
        absent = np.union1d(unknown, ids[~alive])
        return _with_kept(report, absent, KeptReason.NOT_IN_MAP)

    def prune_loop(self, keyframe_a: int, keyframe_b: int) -> PruneReport:
        """Take a loop out: its relative poses, and every landmark that it fused falls in two.

        A landmark is taken for fused by the loop if keyframes around both ends see it (covisible
        with an end and nearer to it in time), but none in between for half of the way or more;
        the newer side's views leave it.
        """
        ends = sorted((keyframe_a, keyframe_b))
        missing = [k for k in ends if k not in self.world.keyframes]
        if missing:
            return PruneReport(refused=f"keyframe {missing[0]} is not in the map")
        old_side, new_side = (self._side(end, ends) for end in ends)
        fused = np.intersect1d(self._seen_from(old_side), self._seen_from(new_side))
        fused = fused[self._longest_pause(fused) >= np.ptp(self._position(ends)) / 2]
        pairs = [
            np.stack([np.full(len(ids), k.id), ids], axis=1)
            for k in new_side
            if len(ids := np.intersect1d(self.world.observed(k)[1], fused))
        ]
        names = ((ends[0], ends[1], "loop"), (ends[1], ends[0], "loop"))
        update = GraphUpdate(
            remove_observations=np.concatenate([np.zeros((0, 2), np.int64), *pairs]),
            remove_relative_poses=names,
            removal_policy=self.policy,
        )
        report, estimate = self._ask(update)
        if estimate is None:
            return report
        self.world.split(fused, new_side, self.camera)
        read_back(self.world, estimate)
        return replace(report, loops=estimate.removal.relative_poses)

    def _side(self, end: int, ends: list[int]) -> list[Keyframe]:
        """Keyframes covisible with one end of a loop and nearer to it than to the other."""
        (other,) = (k for k in ends if k != end)
        _, seen = self.world.observed(self.world.keyframes[end])
        near = [k for _, k in self.world.covisible(seen, 1)]
        return [k for k in near if abs(k.id - end) < abs(k.id - other)]

    def _position(self, keyframe_ids: list[int]) -> Ints:
        """Place (N,) of keyframes among those in the map."""
        return np.searchsorted(sorted(self.world.keyframes), keyframe_ids)

    def _longest_pause(self, ids: Ints) -> Ints:
        """Keyframes (N,) from one view of each landmark to its next, at most; ids sorted."""
        views = [
            np.stack([np.searchsorted(ids, mine), np.full(len(mine), place)])
            for place, k in enumerate(sorted(self.world.keyframes))
            if len(mine := np.intersect1d(self.world.observed(self.world.keyframes[k])[1], ids))
        ]
        row, place = np.concatenate([np.zeros((2, 0), np.int64), *views], axis=1)
        order = np.lexsort((place, row))
        row, step = row[order], np.diff(place[order], prepend=0)
        first = np.diff(row, prepend=-1) > 0
        longest = np.zeros(len(ids), np.int64)
        np.maximum.at(longest, row[~first], step[~first])
        return longest

    def _seen_from(self, keyframes: list[Keyframe]) -> Ints:
        ids = [self.world.observed(keyframe)[1] for keyframe in keyframes]
        return np.unique(np.concatenate([np.zeros(0, np.int64), *ids]))

    def _prune_view(self, keyframe: Keyframe, keypoints: Ints, scope: MaskScope) -> PruneReport:
        ids = keyframe.landmark_ids[keypoints]
        alive = (ids >= 0) & self.world.landmarks.alive[ids]
        leaves = alive & (self.world.landmarks.observations[ids] <= 1)  # nobody else sees it
        if scope is MaskScope.LANDMARKS:
            leaves = alive
        single = ids[alive & ~leaves]
        pairs = np.stack([np.full(len(single), keyframe.id), single], axis=1)
        report = self._carry_out(np.unique(ids[leaves]), pairs)
        if not report.refused:
            self.world.mask(keyframe, keypoints)
        return _with_kept(report, ids[(ids >= 0) & ~alive], KeptReason.NOT_IN_MAP)

    def _carry_out(self, ids: Ints, pairs: Ints) -> PruneReport:
        """Take landmarks out of graph and map, single observations (N, 2) out of the graph."""
        if not len(ids) and not len(pairs):
            return PruneReport()
        update = GraphUpdate(
            remove_landmarks=ids, remove_observations=pairs, removal_policy=self.policy
        )
        report, estimate = self._ask(update)
        if estimate is None:
            return report
        self.world.mask_landmarks(ids)
        read_back(self.world, estimate)
        return report

    def _ask(self, update: GraphUpdate) -> tuple[PruneReport, GraphEstimate | None]:
        """Let the graph do it; without an estimate if it refused, then the map must not change."""
        estimate = self.smoother.update(update)
        refused = estimate.removal.refused
        ids, pairs = update.remove_landmarks, update.remove_observations
        if len(refused):
            text = f"{len(refused)} landmarks and keyframes would be left underconstrained"
            report = PruneReport(refused=text, refused_variables=refused)
            kept = np.union1d(ids, pairs[:, 1])
            return _with_kept(report, kept, KeptReason.REFUSED), None
        return PruneReport(
            landmark_ids=ids,
            observations=pairs,
            dropped_landmarks=estimate.dropped_landmarks,
            anchored_keyframes=estimate.anchored_keyframes,
        ), estimate


def _with_kept(report: PruneReport, ids: Ints, reason: KeptReason) -> PruneReport:
    """The report with more landmarks that stay."""
    return replace(
        report,
        kept_ids=np.concatenate([report.kept_ids, ids]),
        kept_reasons=np.concatenate([report.kept_reasons, np.full(len(ids), reason)]),
    )
