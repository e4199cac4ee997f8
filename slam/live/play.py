"""Plays a source into the live loop until it ends or is stopped."""

from __future__ import annotations

import logging
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, TypeAlias

from bmask_slam.config.configuration import resolve
from bmask_slam.graph.errors import InputError
from bmask_slam.live.live_slam import LiveSlam, Prepared
from bmask_slam.live.ros2.outputs import OPTICAL, Robot, Ros2Frames
from bmask_slam.live.ros2.publisher import Ros2Publisher
from bmask_slam.live.ros2.services import Ros2Services
from bmask_slam.live.sources.ros2_source import Ros2Source
from bmask_slam.live.sources.source import Newest, Source
from bmask_slam.runtime.progress import make_bar
from bmask_slam.runtime.stop_request import StopRequest
from bmask_slam.sequences.frame import Frame
from bmask_slam.sequences.prefetch import FEATURES_AHEAD, prefetched
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import FrameResult

logger = logging.getLogger(__name__)

KEPT = 3
"""Number of frames that wait for tracking otherwise; of more than these some are dropped."""
STOP_S = 1.0
"""Longest wait for the thread that reads the source, before the source may be played again."""
WAITING = 1
"""Largest number of keyframes that wait for the map if the source waits.

Tracking against a map that is far behind is lost.
"""

_Pairs: TypeAlias = Iterator[tuple[Frame, Prepared | None]]


@dataclass(frozen=True)
class PlayOptions:
    """How a source is played.

    Attributes:
        realtime: drop frames that tracking has no time for; else the source waits.
        silence_s: warn when no frame comes for this time.
        quiet: show no progress bar.
    """

    realtime: bool = True
    silence_s: float = 5.0
    quiet: bool = False


Listener: TypeAlias = Callable[[FrameResult, LiveSlam], None]
"""Called with each frame's result, in the thread that tracks."""


class Service(Protocol):
    """What is served beside tracking, in the thread that tracks."""

    def serve(self, run: LiveSlam) -> bool:
        """Do what is to be done; True ends playing. Called often, also where no frame comes."""


def play(
    slam: LiveSlam,
    source: Source,
    options: PlayOptions,
    listener: Listener | None = None,
    service: Service | None = None,
) -> signal.Signals | None:
    """Track a source's frames; returns the signal that ended it early, if one did.

    Frames that are refused are skipped with a warning. A ``service`` that ends it is the caller's
    to ask about; the source may then be played again.
    """
    pairs = _with_features(slam, source)
    with StopRequest() as stop, make_bar(None, options.quiet) as bar:
        chosen = (
            _newest(slam, pairs, options, stop)
            if options.realtime
            else prefetched(pairs, FEATURES_AHEAD)
        )
        for pair in chosen:
            if service is not None and service.serve(slam):
                break
            if pair is None:
                continue
            frame, prepared = pair
            if not options.realtime:  # its latency counts from now: it waited in the queue
                slam.catch_up(WAITING)
                prepared = prepared and replace(prepared, arrived_s=time.monotonic())
            try:
                result = _track(slam, source, frame, prepared)
                if listener is not None:
                    listener(result, slam)
            except InputError as error:
                logger.warning("%s", error)
            if not options.quiet:
                bar.set_postfix_str(slam.health().line(), refresh=False)
            bar.update()
            if stop.signal is not None:
                break
    return stop.signal


def _track(slam: LiveSlam, source: Source, frame: Frame, prepared: Prepared | None) -> FrameResult:
    """Track a frame; the source goes on with the camera that may have been found meanwhile."""
    camera = slam.camera
    result = slam.track(
        frame.timestamp_s, frame.rgb, frame.depth_m, prepared, frame.name, frame.depth_lag_s
    )
    if slam.camera != camera:
        same_size = slam.camera.reduced_by == source.camera.reduced_by
        source.use(slam.camera if same_size else slam.camera.recorded())
    return result


def _with_features(slam: LiveSlam, source: Source) -> _Pairs:
    """Frames with their features, which another thread iterates over ahead of tracking.

    None for a frame that is refused: ``track`` refuses it, and the next one is used.
    """
    for frame in source.frames():
        try:
            prepared = slam.prepare(frame.rgb, frame.depth_m)
        except InputError:
            yield frame, None
        else:
            yield frame, prepared


def _newest(
    slam: LiveSlam, pairs: _Pairs, options: PlayOptions, stop: StopRequest
) -> Iterator[tuple[Frame, Prepared | None] | None]:
    """Frames as they come, without those that tracking has no time for; None where none comes."""
    newest = Newest(pairs, KEPT)
    heard_s, silent = time.monotonic(), False
    try:
        while not newest.ended and stop.signal is None:
            pair = newest.get(0.1)
            slam.frames_dropped = newest.dropped
            if pair is not None:
                heard_s, silent = time.monotonic(), False
            elif not silent and time.monotonic() - heard_s > options.silence_s:
                silent = True
                logger.warning("no frame for %.0f s; waiting", options.silence_s)
            yield pair
    finally:
        newest.stop(STOP_S if stop.signal is None else 0.0)


@contextmanager
def finishing(
    slam: LiveSlam, publisher: Ros2Publisher | None, services: Ros2Services | None
) -> Iterator[LiveSlam]:
    """A run, all of which is published once more when it has ended.

    Also after an InputError, such as a source that has fallen silent, which is raised then.
    """
    failure: InputError | None = None
    with slam:
        try:
            yield slam
        except InputError as error:
            failure = error
    if publisher is not None:
        publisher.finish(slam)
    if failure is not None:
        if services is not None:
            services.end(slam.out)
        raise failure


def ros2_ends(
    source: Ros2Source, params: Path | None, config: SystemConfig
) -> tuple[SystemConfig, Ros2Publisher, Ros2Services]:
    """The settings with the sensors' mountings, what publishes the results, what serves calls.

    Args:
        params: file with `Ros2Frames`, as YAML.
    """
    frames = resolve(Ros2Frames, params)
    config = replace(config, sensors=source.mounted(config.sensors, frames))
    T, by_tf = frames.T_base_camera, False
    if T is None:
        T = source.T_base_camera(frames.base)
        by_tf = T is not None
    robot = Robot(
        OPTICAL if T is None else T,
        T is not None,
        by_tf,
        source.sensors.T_odom_base if source.sensors.has_odometry else None,
        source.ros_time,
    )
    services = Ros2Services(source.node, frames.prefix)
    return config, Ros2Publisher(source.node, frames, robot), services
