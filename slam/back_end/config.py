"""The settings of the back end: map, graph, loops and sensors."""

from __future__ import annotations

from dataclasses import dataclass, field

from bmask_slam.back_end.factor_selection import FactorSelectionConfig
from bmask_slam.back_end.landmark_management import MappingConfig
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.sensors.config import SensorsConfig
from bmask_slam.loops.closing import LoopClosingConfig


@dataclass(frozen=True)
class BackEndConfig:
    """Settings of the map, of factor selection, of the graph, of its loops, and of sensors."""

    mapping: MappingConfig = field(default_factory=MappingConfig)
    factor_selection: FactorSelectionConfig = field(default_factory=FactorSelectionConfig)
    graph: SmootherConfig = field(default_factory=SmootherConfig)
    loops: LoopClosingConfig = field(default_factory=LoopClosingConfig)
    sensors: SensorsConfig = field(default_factory=SensorsConfig)
