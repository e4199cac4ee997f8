"""Frames from pairs of ROS image messages, of a bag or of running topics."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from typing import Any

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.live.sources.pairing import Pair
from bmask_slam.live.sources.source import SourceCounts
from bmask_slam.sequences.bags.ros_images import colour_image, depth_image
from bmask_slam.sequences.bags.topics import BagCamera
from bmask_slam.sequences.checks import check_sizes
from bmask_slam.sequences.frame import Frame
from bmask_slam.sequences.images import depth_in_metres

logger = logging.getLogger(__name__)


def message_frames(
    pairs: Iterator[Pair[Any]],
    camera_now: Callable[[], Camera],
    found: BagCamera,
    counts: SourceCounts,
    names: tuple[str, str, str],
) -> Iterator[Frame]:
    """A frame of each pair; what cannot be decoded is counted in ``counts.broken`` and skipped.

    ``camera_now`` gives the camera to read each frame with, ``found`` says what depth values mean
    and which lens undistorts the images; ``names`` are those of colour topic,
    depth topic and source, for messages.
    """
    index = 0
    for pair in pairs:
        rgb_at, depth_at, source_at = (f"{name} at {pair.stamp_s:.6f}" for name in names)
        camera = camera_now()
        try:
            rgb = colour_image(pair.rgb, rgb_at).copy()  # messages are read-only
            stored = depth_image(pair.depth, depth_at)
            check_sizes(rgb, stored, camera, source_at, found.form.camera)
        except InputError as error:
            counts.broken += 1
            logger.warning("skipped: %s", error)
            continue
        if found.lens is not None:
            rgb = found.lens.undistorted_colour(rgb)
        depth_m = depth_in_metres(found.form.on_colour(stored, camera), camera)
        yield Frame(index, pair.stamp_s, rgb, depth_m, depth_lag_s=pair.lag_s)
        index += 1
