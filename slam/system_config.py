"""Everything that can be configured, in one place."""

from __future__ import annotations

from dataclasses import dataclass, field

from graph.smoother_config import SmootherConfig
from slam.dynamics_config import DynamicsConfig
from slam.features import FeatureConfig
from slam.graph_feed import GraphFeedConfig
from slam.keyframes import KeyframeConfig
from slam.local_mapping import MappingConfig
from slam.loop_closing import LoopClosingConfig
from slam.relocalisation import RelocalisationConfig
from slam.semantic_mapping import SemanticsConfig
from slam.tracker import TrackingConfig


@dataclass(frozen=True)
class SystemConfig:
    """Everything that can be configured; YAML files hold only what differs from these defaults.

    ``final_adjustment``: a full bundle adjustment ends the run. ``covariances``: those of all
    keyframes are written with its results.
    """

    features: FeatureConfig = field(default_factory=FeatureConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    relocalisation: RelocalisationConfig = field(default_factory=RelocalisationConfig)
    feed: GraphFeedConfig = field(default_factory=GraphFeedConfig)
    graph: SmootherConfig = field(default_factory=SmootherConfig)
    loops: LoopClosingConfig = field(default_factory=LoopClosingConfig)
    semantics: SemanticsConfig = field(default_factory=SemanticsConfig)
    dynamics: DynamicsConfig = field(default_factory=DynamicsConfig)
    final_adjustment: bool = True
    covariances: bool = False
