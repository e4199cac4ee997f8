"""bmask-slam: RGB-D SLAM on a factor graph, with labelled landmarks, objects and a dense map.

The public names are those of ``__all__``; each is imported when it is first asked for, so that
``import bmask_slam`` loads nothing else. docs/python.md describes them.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bmask_slam.api import make_segmenter, map_run, merge_runs, run
    from bmask_slam.evaluation import evaluate
    from bmask_slam.events import Event, EventKind
    from bmask_slam.graph.camera import Camera
    from bmask_slam.graph.errors import InputError
    from bmask_slam.graph.factors.keys import key_of_keyframe, key_of_landmark
    from bmask_slam.live.live_slam import LiveSlam
    from bmask_slam.live.start import LiveOptions
    from bmask_slam.run_folder.reader import Run
    from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions
    from bmask_slam.sequences.frame import Frame
    from bmask_slam.sequences.sequence import open_sequence
    from bmask_slam.system import SlamSystem
    from bmask_slam.system_config import SystemConfig
    from bmask_slam.tracking.results import FrameResult, TrackingStatus, Velocity

__version__ = "0.1.0"
__all__ = [
    "Camera",
    "Event",
    "EventKind",
    "Frame",
    "FrameResult",
    "InputError",
    "LiveOptions",
    "LiveSlam",
    "Run",
    "SegmenterOptions",
    "SlamSystem",
    "SystemConfig",
    "TrackingStatus",
    "Velocity",
    "__version__",
    "evaluate",
    "key_of_keyframe",
    "key_of_landmark",
    "make_segmenter",
    "map_run",
    "merge_runs",
    "open_sequence",
    "run",
]

_MODULES = {
    "Camera": "graph.camera",
    "Event": "events",
    "EventKind": "events",
    "Frame": "sequences.frame",
    "FrameResult": "tracking.results",
    "InputError": "graph.errors",
    "LiveOptions": "live.start",
    "LiveSlam": "live.live_slam",
    "Run": "run_folder.reader",
    "SegmenterOptions": "semantics.segmenters.segmenter_table",
    "SlamSystem": "system",
    "SystemConfig": "system_config",
    "TrackingStatus": "tracking.results",
    "Velocity": "tracking.results",
    "evaluate": "evaluation",
    "key_of_keyframe": "graph.factors.keys",
    "key_of_landmark": "graph.factors.keys",
    "make_segmenter": "api",
    "map_run": "api",
    "merge_runs": "api",
    "open_sequence": "sequences.sequence",
    "run": "api",
}
"""The module of each public name."""


def __getattr__(name: str) -> Any:
    """A public name, imported now (PEP 562)."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
