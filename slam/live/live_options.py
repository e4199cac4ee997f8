"""What a live run is asked for beside its camera and configuration."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.run_folder.origin import Origin
from bmask_slam.viewer.scene import ViewOptions


@dataclass(frozen=True)
class LiveOptions:
    """Where results go and what they are compared to.

    Attributes:
        out: run folder, as an offline run's; None: nothing is written.
        overwrite: replace the run that it holds.
        reference: trajectory to compare with at the end.
        view: where a viewer shows it, if anywhere.
        images: folder that the frames are of, if any: a segmenter looks masks up for it, and
            `bmask-slam map` reads it.
        title: of the picture.
        dense: make a dense map as well; needs ``out``.
    """

    out: Path | None = None
    overwrite: bool = False
    reference: Trajectory | None = None
    view: ViewOptions = field(default_factory=ViewOptions)
    images: Path = Path()
    title: str = "live"
    dense: bool = False

    @property
    def origin(self) -> Origin:
        """The sequence folder that the frames come from, if any, for config.yaml."""
        return Origin(None if self.images == Path() else self.images)
