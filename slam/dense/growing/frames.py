"""Which frames between keyframes a growing surface gets, and how many are on their way to it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse
from bmask_slam.mapping.surface.parts import Region, SurfacePart
from bmask_slam.sequences.frame import Frame
from bmask_slam.world.keyframe import Keyframe

EARLY = 0.9
"""A frame may come so early, as a share of the interval: stamps are not exact."""
MAX_SENT, MAX_BACKLOG = 8, 25
"""Frames that may be on their way, and that may wait for the surface though their keyframes are
there; one more is dropped."""


@dataclass(frozen=True)
class FrameOptions:
    """Which frames between keyframes are used, and how much of the disk they may take.

    Attributes:
        per_s: at most so many a second, by their stamps; 0: none, the surface is of keyframes.
        min_shift_m, min_turn_deg: the view must differ by one of these from that of the last one.
        max_bytes: of their images, which are kept until the end; no more are used then.
    """

    per_s: float = 5.0
    min_shift_m: float = 0.03
    min_turn_deg: float = 3.0
    max_bytes: int = 2 << 30

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 <= value < np.inf:
                raise InputError(f"{name} {value}: must be 0 or more")


@dataclass(frozen=True, eq=False)
class SurfaceFrame:
    """A tracked frame for the surface.

    Attributes:
        frame: its images as they were taken, distorted.
        after: the newest keyframe when it was taken.
        reference: the keyframe that it follows. T_reference_camera: (4, 4).
    """

    frame: Frame
    after: int
    reference: int
    T_reference_camera: Array

    @property
    def number(self) -> int:
        """Index of the frame."""
        return self.frame.index


@dataclass(frozen=True)
class FramesTaken:
    """From the surface: a frame has come, or -1, and how many wait to be integrated.

    Attributes:
        integrated: frames in the surface.
        unwritten: frames that could not be stored.
    """

    number: int
    backlog: int
    integrated: int
    unwritten: int


class FrameQueue:
    """Chooses frames, and sends them as long as the surface keeps up.

    Attributes:
        dropped: frames that were chosen while the surface was behind.
        integrated: in the surface. unwritten: for which there was no room on the disk.
        references: keyframes that the frames sent follow.
    """

    def __init__(self, options: FrameOptions, send: Callable[[SurfaceFrame], None]) -> None:
        self.dropped = self.integrated = self.unwritten = 0
        self.references: set[int] = set()
        self._options, self._send = options, send
        self._sent: dict[int, SurfaceFrame] = {}
        self._backlog, self._after = 0, -1
        self._last_s = -np.inf
        self._T_world_last: Array | None = None

    @property
    def full(self) -> bool:
        """Whether one more frame would be dropped."""
        return len(self._sent) >= MAX_SENT or self._backlog >= MAX_BACKLOG

    def offer(
        self,
        frame: Frame,
        T_world_camera: Array,
        reference: Keyframe,
        keyframe: Keyframe | None,
    ) -> None:
        """Send a frame that follows a keyframe, if it is needed; its images are copied.

        If it became a ``keyframe`` itself it is not needed.
        """
        if keyframe is not None:
            self._after = keyframe.id
        elif self._after >= 0 and self._shows_more(frame.timestamp_s, T_world_camera):
            self._choose(frame, T_world_camera, reference)

    def _choose(self, frame: Frame, T_world_camera: Array, reference: Keyframe) -> None:
        if self.full:
            self.dropped, self._last_s = self.dropped + 1, frame.timestamp_s
            return
        self._last_s, self._T_world_last = frame.timestamp_s, T_world_camera
        own = replace(frame, rgb=frame.rgb.copy(), depth_m=frame.depth_m.copy())
        T_reference_camera = inverse(reference.T_world_camera) @ T_world_camera
        chosen = SurfaceFrame(own, self._after, reference.id, T_reference_camera)
        self.references.add(reference.id)
        self._sent[chosen.number] = chosen
        self._send(chosen)

    def taken(self, message: FramesTaken) -> None:
        """The surface has a frame, or has worked."""
        self._sent.pop(message.number, None)
        self._backlog, self.integrated = message.backlog, message.integrated
        self.unwritten = max(self.unwritten, message.unwritten)

    def send_again(self) -> None:
        """Send to a new process what the old one may not have stored."""
        self._backlog = 0
        for chosen in self._sent.values():
            self._send(chosen)

    def _shows_more(self, timestamp_s: float, T_world_camera: Array) -> bool:
        options, T_world_last = self._options, self._T_world_last
        if T_world_last is None or options.per_s == 0:
            return options.per_s > 0
        if (timestamp_s - self._last_s) * options.per_s < EARLY:
            return False
        T = inverse(T_world_last) @ T_world_camera
        turn_deg = np.rad2deg(np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1)))
        return bool(
            np.linalg.norm(T[:3, 3]) > options.min_shift_m or turn_deg > options.min_turn_deg
        )


class ShownParts:
    """Parts of the surface as they come: for a viewer, which removes them, and for listeners.

    Attributes:
        parts: by region. keeps: whether there is a viewer.
        listeners: called with each part.
    """

    def __init__(self) -> None:
        self.parts: dict[Region, SurfacePart] = {}
        self.keeps = False
        self.listeners: list[Callable[[SurfacePart], None]] = []

    @property
    def wanted(self) -> bool:
        """Whether parts are to be made at all."""
        return self.keeps or bool(self.listeners)

    def take(self, part: SurfacePart) -> None:
        """Keep a part in place of what was there, and tell the listeners."""
        if self.keeps:
            self.parts[part.region] = part
        for listener in self.listeners:
            listener(part)
