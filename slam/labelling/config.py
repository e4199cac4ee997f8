"""Settings of the semantics: where masks come from, and how they become labels and objects."""

from __future__ import annotations

from dataclasses import dataclass, field

from bmask_slam.semantics.beliefs.label_fusion import LabelStoreConfig
from bmask_slam.semantics.beliefs.votes import VoteConfig
from bmask_slam.semantics.objects.config import ObjectConfig
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions

DEFAULT_SEGMENTER = "light"


@dataclass(frozen=True)
class SemanticsConfig:
    """Where masks come from, and how they are used.

    Instances with a class score below ``object_score``, found where the segmenter's ``min_score``
    is lower, vote on labels only: they make no objects, and are no evidence of motion.
    """

    segmenter: SegmenterOptions = field(
        default_factory=lambda: SegmenterOptions(DEFAULT_SEGMENTER, min_score=0.3)
    )
    object_score: float = 0.5
    votes: VoteConfig = field(default_factory=VoteConfig)
    labels: LabelStoreConfig = field(default_factory=LabelStoreConfig)
    objects: ObjectConfig = field(default_factory=ObjectConfig)
