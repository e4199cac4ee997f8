"""Loads the modules of worker processes while a command loads its own, which saves a second.

The server that workers are forked from loads them; commands call this before they import anything.
"""

from __future__ import annotations

from bmask_slam.live.processes.worker import load_ahead
from bmask_slam.runtime.machine import available_cores

SEGMENTATION = "bmask_slam.live.processes.segmentation"
WORKERS = ("bmask_slam.live.processes.map_process", SEGMENTATION)
NETWORK = (SEGMENTATION, "bmask_slam.semantics.segmenters.light_segmenter")


def load_workers() -> None:
    """Load what map and masks need, without the network: all workers would hold its libraries."""
    load_ahead(*WORKERS)


def load_network() -> None:
    """Load the shipped network's libraries, where it will have a process of its own."""
    if available_cores() > 1:
        load_ahead(*NETWORK)
