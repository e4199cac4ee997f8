"""Frames from a recorded sequence in any layout."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

import numpy as np

from bmask_slam.graph.camera import Camera
from bmask_slam.live.sources.pairing import GapMeter
from bmask_slam.live.sources.source import SourceCounts, paced
from bmask_slam.sequences.frame import Frame
from bmask_slam.sequences.sequence import Sequence


class RecordedSource:
    """A recorded sequence, at the rate of its stamps if ``realtime``.

    Attributes:
        counts: images that did not become frames so far, and gaps between frames.
        waits: see ``Source``; False if ``realtime``.
    """

    pairs = interpolates = True

    def __init__(self, sequence: Sequence, realtime: bool) -> None:
        self.name, self.camera = sequence.name, sequence.camera
        self.groundtruth = sequence.groundtruth
        self.counts = SourceCounts(
            unpaired_rgb=sequence.pairs.unpaired_rgb, unpaired_depth=sequence.pairs.unpaired_depth
        )
        self.waits = not realtime
        self._sequence = sequence

    def frames(self) -> Iterator[Frame]:
        """Each frame, not before its time if ``realtime``."""
        return self._frames() if self.waits else paced(self._frames())

    def use(self, camera: Camera) -> None:
        """Later frames have their depth at the colour image's time by this camera."""
        self.camera = camera

    def _frames(self) -> Iterator[Frame]:
        """The frames, from the sequence with the camera that is used when each is read."""
        sequence, start, last_s, broken_before = self._sequence, 0, -np.inf, 0
        gaps = GapMeter(self.counts)
        while start < len(sequence):
            camera = sequence.camera
            with closing(sequence.frames(start)) as frames:
                for frame in frames:
                    start, last_s = frame.index + 1, frame.timestamp_s
                    self.counts.broken = broken_before + len(sequence.skipped)
                    gaps.count(last_s)
                    yield frame
                    if self.camera != camera:
                        break
                else:
                    self.counts.broken = broken_before + len(sequence.skipped)
                    return
            broken_before += sum(index < start for index, _ in sequence.skipped)  # of those read
            sequence = sequence.with_camera(self.camera)
            start = int(np.searchsorted(sequence.timestamps_s, last_s, side="right"))

    def close(self) -> None:
        """Nothing to release: each frame opens and closes its own files."""
