"""The configuration of the whole system."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

from bmask_slam.back_end.config import BackEndConfig
from bmask_slam.back_end.factor_selection import FactorSelectionConfig
from bmask_slam.back_end.landmark_management import MappingConfig
from bmask_slam.features.brisk import FeatureConfig
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.sensors.config import SensorsConfig
from bmask_slam.labelling.config import SemanticsConfig
from bmask_slam.loops.closing import LoopClosingConfig
from bmask_slam.moving.config import MovingObjectConfig
from bmask_slam.tracking.config import TrackingConfig
from bmask_slam.tracking.keyframe_decision import KeyframeConfig
from bmask_slam.tracking.relocalisation import RelocalisationConfig


@dataclass(frozen=True)
class SystemConfig:
    """All settings; YAML files hold only what differs from these defaults.

    ``final_adjustment``: a full bundle adjustment ends the run. ``adjust_frames``: then the map is
    adjusted again, together with the frames that are no keyframes. ``smooth_trajectory``: then the
    poses of all frames are smoothed by the camera's inertia; live, they are filtered by it as they
    are given out. ``covariances``: those of all keyframes are written with its results.
    """

    features: FeatureConfig = field(default_factory=FeatureConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    relocalisation: RelocalisationConfig = field(default_factory=RelocalisationConfig)
    factor_selection: FactorSelectionConfig = field(default_factory=FactorSelectionConfig)
    graph: SmootherConfig = field(default_factory=SmootherConfig)
    loops: LoopClosingConfig = field(default_factory=LoopClosingConfig)
    sensors: SensorsConfig = field(default_factory=SensorsConfig)
    semantics: SemanticsConfig = field(default_factory=SemanticsConfig)
    moving_objects: MovingObjectConfig = field(default_factory=MovingObjectConfig)
    final_adjustment: bool = True
    adjust_frames: bool = True
    smooth_trajectory: bool = True
    covariances: bool = False

    @property
    def back_end(self) -> BackEndConfig:
        """The settings of map and graph."""
        return BackEndConfig(**{f.name: getattr(self, f.name) for f in fields(BackEndConfig)})
