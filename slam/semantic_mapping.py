"""What the map's things are: keyframes' masks vote on landmarks."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graph.array_file import Arrays, nested, part
from graph.camera import Camera
from graph.errors import InputError
from graph.geometry import Array, inverse, transform
from semantics.instances import Instance
from semantics.label_store import LabelEstimates, LabelStore, LabelStoreConfig
from semantics.labels import LabelSet
from semantics.segmenter import NoSegmenter, Segmenter
from semantics.segmenter_table import SegmenterOptions
from semantics.votes import VoteConfig, check_instances, claim_pixels, vote
from slam.frame import Frame
from slam.landmarks import Ints
from slam.mapper import Mapper
from slam.world_map import Keyframe

logger = logging.getLogger(__name__)

DEFAULT_SEGMENTER = "none"
DEPTH_STEP = 2
"""Of a keyframe's depth image every second pixel each way waits for its masks."""
MAX_WAITING = 100


@dataclass(frozen=True)
class SemanticsConfig:
    """Where masks come from, and what is believed of them."""

    segmenter: SegmenterOptions = field(default_factory=lambda: SegmenterOptions(DEFAULT_SEGMENTER))
    votes: VoteConfig = field(default_factory=VoteConfig)
    labels: LabelStoreConfig = field(default_factory=LabelStoreConfig)


@dataclass(frozen=True)
class Attachment:
    """What became of a keyframe's masks.

    Attributes:
        keyframe_id: whose they are.
        instances: how many there were.
        landmark_ids: (N,) that they spoke about.
        refused: why they were not used; "" if they were.
    """

    keyframe_id: int
    instances: int = 0
    landmark_ids: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    refused: str = ""


@dataclass(frozen=True)
class LandmarkLabels:
    """What landmarks (N,) are: estimates of ``names``."""

    names: LabelSet
    estimates: LabelEstimates


@dataclass(frozen=True)
class _View:
    """What a keyframe observes: pixels (N, 2) as detected, landmark ids (N,), and its pose."""

    pixels: Array
    landmark_ids: Ints
    T_world_camera: Array


class SemanticMapper:
    """Segments keyframes and keeps what their masks say about the map, also when they come late.

    Without a segmenter and without masks it does nothing. The map is never changed.
    """

    def __init__(
        self, camera: Camera, config: SemanticsConfig, segmenter: Segmenter | None = None
    ) -> None:
        self.camera = camera
        self.config = config
        self.segmenter = segmenter or NoSegmenter()
        self.names = self.segmenter.labels
        self.labels = LabelStore(len(self.names), config.labels)
        self._done: set[int] = set()
        self._waiting: dict[int, NDArray[np.float32]] = {}

    @property
    def enabled(self) -> bool:
        """Whether there are labels to tell apart."""
        return len(self.names) > 1

    def observe(self, frame: Frame, keyframe: Keyframe, mapper: Mapper) -> None:
        """Segment a keyframe and let its masks vote; follow what became of the map.

        Raises:
            InputError: the first keyframe cannot be segmented; later ones are passed over.
        """
        self.follow(mapper)
        if not len(self.segmenter.labels) > 1:
            return
        self.expect(keyframe.id, frame.depth_m)
        try:
            instances = self.segmenter.segment(frame.rgb, frame.name)
            self.attach(keyframe.id, instances, mapper)
        except InputError as error:
            if not self._done:
                raise
            logger.warning("keyframe %d has no masks: %s", keyframe.id, error)

    def expect(self, keyframe_id: int, depth_m: NDArray[np.float32]) -> None:
        """Keep of a keyframe what its masks will need, (H, W) z-depth in m, until they come."""
        self._waiting[keyframe_id] = depth_m[::DEPTH_STEP, ::DEPTH_STEP].copy()
        if len(self._waiting) > MAX_WAITING:
            del self._waiting[min(self._waiting)]

    def attach(self, keyframe_id: int, instances: Sequence[Instance], mapper: Mapper) -> Attachment:
        """Use the masks of a keyframe, at any time after it was made, once.

        Fused landmarks are followed; a culled keyframe's masks still reach its landmarks.

        Raises:
            InputError: masks of another size or with labels that are not in the label set.
        """
        size = (self.camera.height, self.camera.width)
        check_instances(instances, size, self.names, f"keyframe {keyframe_id}")
        view = self._view(keyframe_id, mapper)
        refused = "" if view is not None else "it is not in the map"
        if keyframe_id in self._done:
            refused = "it has its masks already"
        if view is None or refused:
            logger.info("masks of keyframe %d are not used: %s", keyframe_id, refused)
            return Attachment(keyframe_id, len(instances), refused=refused)
        self._done.add(keyframe_id)
        depth_m = self._waiting.pop(keyframe_id, None)
        if depth_m is None:
            depth_m = np.full((size[0] // DEPTH_STEP, size[1] // DEPTH_STEP), np.nan, np.float32)
        claims = claim_pixels(instances, depth_m, size, self.config.votes)
        points = mapper.world.landmarks.points_world[view.landmark_ids]
        z_m = transform(inverse(view.T_world_camera), points)[:, 2]
        votes = vote(claims, view.pixels, z_m, len(self.names), self.config.votes)
        ids = view.landmark_ids[votes.rows]
        self.labels.update(ids, votes.distributions, votes.weights)
        return Attachment(keyframe_id, len(instances), ids)

    def follow(self, mapper: Mapper) -> None:
        """Landmarks that were fused take what was known of them along; culled ones lose it."""
        landmarks, known = mapper.world.landmarks, self.labels.known()
        if landmarks.alive[known].all():
            return
        gone = known[~landmarks.alive[known]]
        heirs = landmarks.current(gone)
        alive = landmarks.alive[heirs]
        self.labels.move(gone[alive], heirs[alive])
        self.labels.drop(gone[~alive])

    def landmark_labels(self, ids: Ints) -> LandmarkLabels | None:
        """What landmarks (N,) are; None where nothing tells labels apart."""
        return LandmarkLabels(self.names, self.labels.estimates(ids)) if self.enabled else None

    def state(self) -> Arrays:
        """All that was learned, as named arrays."""
        waiting = list(self._waiting.values())
        return {
            "names": np.array(self.names.names),
            "done": np.array(sorted(self._done), np.int64),
            "waiting": np.array(list(self._waiting), np.int64),
            "waiting_shape": np.array([depth_m.shape for depth_m in waiting], np.int64).ravel(),
            "waiting_depth_m": np.array(waiting, np.float32).ravel(),
            **nested(labels=self.labels.state()),
        }

    def restore(self, state: Arrays, path: Path) -> None:
        """Go on from a state.

        Raises:
            InputError: it was learned with another label set.
        """
        names = LabelSet(tuple(state["names"].tolist()))
        if len(names) > 1 and self.enabled and names != self.names:
            raise InputError(
                f"{path}: its landmarks have {len(names) - 1} labels that are not the segmenter's "
                f"{len(self.names) - 1}; take the segmenter that it was made with, or none"
            )
        if len(names) > 1:
            self.names = names
        self.labels = LabelStore(len(self.names), self.config.labels)
        if len(names) == len(self.names):
            self.labels.restore(part(state, "labels"))
        self._done = set(state["done"].tolist())
        waiting = state["waiting"].tolist()
        shape = state["waiting_shape"].reshape(-1, 2)[:1].ravel().tolist() or [0, 0]
        depths_m = state["waiting_depth_m"].reshape(len(waiting), *shape)
        self._waiting = dict(zip(waiting, depths_m, strict=True))

    def begin_session(self) -> None:
        """Masks of keyframes of an earlier recording are not waited for."""
        self._waiting = {}

    def _view(self, keyframe_id: int, mapper: Mapper) -> _View | None:
        world = mapper.world
        keyframe = world.keyframes.get(keyframe_id)
        if keyframe is not None:
            rows, ids = world.observed(keyframe)
            return _View(keyframe.features.image_pixels[rows], ids, keyframe.T_world_camera)
        culled = world.culled.get(keyframe_id)
        heir_id, T_heir_keyframe = mapper.history.heir(keyframe_id)
        heir = world.keyframes.get(heir_id)
        if culled is None or heir is None:
            return None
        rows = np.flatnonzero(culled.landmark_ids >= 0)
        ids = world.landmarks.current(culled.landmark_ids[rows])
        alive = world.landmarks.alive[ids]
        pose = heir.T_world_camera @ T_heir_keyframe
        return _View(culled.image_pixels[rows[alive]], ids[alive], pose)
