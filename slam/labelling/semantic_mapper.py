"""Semantics of the map: keyframes and label views are segmented, and their masks used."""

from __future__ import annotations

import logging
from collections.abc import Callable

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.labelling.awaited_masks import MaskRequests, kept_depth
from bmask_slam.labelling.config import SemanticsConfig
from bmask_slam.labelling.label_views import (
    FIRST_LABEL_VIEW,
    LabelView,
    LabelViewDecision,
    described,
)
from bmask_slam.labelling.labelled_map import LabelledMap
from bmask_slam.moving.keyframe_masks import KeyframeMasks
from bmask_slam.semantics.segmenters.segmenter import NoSegmenter, Segmenter, begin_early
from bmask_slam.sequences.frame import Frame
from bmask_slam.tracking.results import Tracked
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.map_editor import MapReader

logger = logging.getLogger(__name__)


class SemanticMapper(LabelledMap):
    """Segments keyframes and label views, and labels the map by their masks.

    Without a segmenter and without masks it does nothing.

    Attributes:
        segmenter: makes masks. decision: says which frames are label views.
    """

    def __init__(
        self,
        camera: Camera,
        config: SemanticsConfig,
        map_reader: MapReader,
        segmenter: Segmenter | None = None,
        on_masks: Callable[[KeyframeMasks], None] | None = None,
    ) -> None:
        self.segmenter = segmenter or NoSegmenter()
        self._requests = MaskRequests()
        self.decision = LabelViewDecision(config.label_views, camera.width)
        names = self.segmenter.labels, getattr(self.segmenter, "measured", "")
        super().__init__(camera, config, map_reader, names, on_masks)

    def observe(self, frame: Frame, keyframe: Keyframe, urgent: bool = False) -> None:
        """Follow the map's changes and ask for a keyframe's masks, which ``use_masks`` uses.

        ``urgent``: before the next frame is tracked.
        """
        self.follow_map()
        if len(self.segmenter.labels) > 1:
            self._segments(keyframe)
            self.await_masks(keyframe, kept_depth(frame.depth_m))
            self._requests.add(keyframe.id, frame, self.segmenter, urgent)
            self.use_masks()

    def observe_frame(self, frame: Frame, tracked: Tracked, parent: Keyframe | None) -> None:
        """Ask for the masks of a frame that is no keyframe, if it is to be a label view.

        Its pose is kept relative to the keyframe ``parent``.
        """
        if parent is None or not self._takes_views:
            return
        if not self.decision.decide(frame.timestamp_s, tracked):
            return
        world = self._map.world
        number, world.label_views = FIRST_LABEL_VIEW + world.label_views, world.label_views + 1
        self._request(frame, LabelView.of(number, frame, tracked, parent))

    @property
    def _takes_views(self) -> bool:
        """Whether a label view would be segmented now."""
        return len(self.segmenter.labels) > 1

    def _request(self, frame: Frame, view: LabelView) -> None:
        """Ask for the masks of a label view."""
        begin_early(self.segmenter, frame.rgb, frame.name)
        self.await_view(view)
        self._requests.add(view.number, frame, self.segmenter)
        self.use_masks()

    def _segments(self, keyframe: Keyframe) -> None:
        """A keyframe is segmented: label views are decided by it."""
        rows, ids = self._map.world.observed(keyframe)
        pixels = keyframe.features.image_pixels[rows]
        self.decision.segmented(keyframe.timestamp_s, ids, pixels)

    def begin_frame(self) -> None:
        """A frame begins: the masks that are due with it are used."""
        self._requests.begin_frame()
        self.use_masks()

    def use_masks(self, everything: bool = False) -> None:
        """Use the masks that were asked for and are due, or all.

        Raises:
            InputError: the first keyframe cannot be segmented; later ones are skipped.
        """
        for asked in self._requests.take(everything):
            try:
                self.attach(asked.keyframe_id, self.segmenter.segment(asked.image, asked.name))
            except InputError as error:
                if not self._done:
                    raise
                of_view = asked.keyframe_id >= FIRST_LABEL_VIEW
                level = logging.INFO if of_view else logging.WARNING
                logger.log(level, "%s has no masks: %s", described(asked.keyframe_id), error)

    def begin_session(self) -> None:
        """Another recording begins: masks of earlier keyframes are not awaited."""
        super().begin_session()
        self._requests = MaskRequests()
        self.decision.forget()
