"""Settings of the semantics: where masks come from, and how they become labels and objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from bmask_slam.labelling.label_views import LabelViewConfig
from bmask_slam.semantics.beliefs.label_fusion import LabelStoreConfig
from bmask_slam.semantics.beliefs.vote_config import VoteConfig
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.semantics.objects.config import ObjectConfig
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions

DEFAULT_SEGMENTER = "light"


@dataclass(frozen=True)
class SemanticsConfig:
    """Where masks come from, and how they are used.

    Where the errors of a segmenter's masks were measured (`semantics.beliefs.observation`), all its
    instances vote on labels, and those with a class score of ``object_score`` or more make objects.
    Of others, which are believed, instances vote from ``object_score`` and make objects from
    ``sure_score``. From that on instances are evidence of motion and reach the dense map.
    Keyframes are segmented, and other frames where ``label_views`` says so.
    """

    segmenter: SegmenterOptions = field(
        default_factory=lambda: SegmenterOptions(DEFAULT_SEGMENTER, min_score=0.15)
    )
    object_score: float = 0.3
    sure_score: float = 0.5
    label_views: LabelViewConfig = field(default_factory=LabelViewConfig)
    votes: VoteConfig = field(default_factory=VoteConfig)
    labels: LabelStoreConfig = field(default_factory=LabelStoreConfig)
    objects: ObjectConfig = field(default_factory=ObjectConfig)

    def least_scores(self, measured: bool) -> tuple[float, float]:
        """The least class scores of instances that vote on labels, and that make objects."""
        return (0.0, self.object_score) if measured else (self.object_score, self.sure_score)


def above(instances: Sequence[Instance], score: float) -> list[Instance]:
    """Those with a class score of this or more."""
    return [i for i in instances if i.class_score >= score]
