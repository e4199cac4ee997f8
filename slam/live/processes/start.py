"""The processes of the live loop: all of them are started, or none."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

from bmask_slam.graph.camera import Camera
from bmask_slam.live.processes.dense_messages import DenseOrder
from bmask_slam.live.processes.remote_dense import RemoteDenseMapper
from bmask_slam.live.processes.segmentation import RemoteSegmenter
from bmask_slam.live.system import LiveSystem
from bmask_slam.semantics.segmenters.segmenter import NoSegmenter
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions
from bmask_slam.system_config import SystemConfig

SHOWN = 3000
"""Points of a submap that a viewer gets, at most."""


def start_system(
    camera: Camera, config: SystemConfig, scratch: Path, images: Path, run: Path | None, shown: bool
) -> LiveSystem:
    """The live system with its processes, which can work.

    Args:
        scratch: folder for its own files.
        images: folder that a segmenter looks masks up for.
        run: run folder for a dense map; None: there will be none.
        shown: whether a viewer wants to see that.

    Raises:
        InputError: one of them cannot start.
    """
    masks: SegmenterOptions = config.semantics.segmenter
    with ExitStack() as undo:
        segmenter, dense, labels = None, None, NoSegmenter.labels
        if masks.name != "none":
            segmenter = RemoteSegmenter(masks, images)
            undo.callback(segmenter.close)
            labels = segmenter.labels
        if run is not None:
            order = DenseOrder(run, camera, masks, labels.names, SHOWN if shown else 0)
            dense = RemoteDenseMapper(order)
            undo.callback(dense.close)
        system = LiveSystem(camera, config, scratch, segmenter, dense)
        undo.pop_all()
        return system
