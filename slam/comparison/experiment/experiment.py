"""What is compared: sequences, configurations, seeds, other systems, published figures."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from bmask_slam.graph.trajectory import MAX_TIME_DIFFERENCE_S
from bmask_slam.rendering.config import RenderConfig

VERDICT_METRICS = ("ate_rmse", "rpe_trans_rmse_second", "rpe_rot_rmse_second")
"""Not times: cells that run side by side disturb each other's."""
OPTIONS = ("segmenter", "weights", "max_frames", "stride", "dense")
"""Options of a configuration besides its parameters."""


@dataclass(frozen=True)
class SequenceSource:
    """Where the images of a sequence come from.

    Attributes:
        name: as printed, unique.
        folder: a path relative to the experiment's file or a data folder, such as
            ``tum/freiburg1_xyz``; "" if it is rendered.
        render: what to render, with the seed of each cell; None for a folder.
        reference: file that replaces the folder's ground truth.
        camera: camera.yaml that replaces the folder's.
    """

    name: str
    folder: str = ""
    render: RenderConfig | None = None
    reference: Path | None = None
    camera: Path | None = None


@dataclass(frozen=True)
class Configuration:
    """This system with some of its parameters changed: the options of ``bmask-slam run``.

    Attributes:
        note: its purpose, printed with the tables.
        config: YAML file or the name of a shipped one.
        set: ``a.b=c`` each.
        segmenter, weights: as ``--segmenter`` and ``--weights``.
        max_frames, stride: as the options of these names.
        dense: also make a dense map.
    """

    note: str = ""
    config: str = ""
    set: tuple[str, ...] = ()
    segmenter: str = ""
    weights: str = ""
    max_frames: int | None = None
    stride: int | None = None
    dense: bool = False

    def arguments(self) -> list[str]:
        """The options of the command line ``bmask-slam run``."""
        named = ("config", "segmenter", "weights", "max_frames", "stride")
        given = {name: value for name in named if (value := getattr(self, name))}
        words = [w for name, v in given.items() for w in (f"--{name.replace('_', '-')}", str(v))]
        words += [word for setting in self.set for word in ("--set", setting)]
        return words + ["--map"] * self.dense


@dataclass(frozen=True)
class OtherSystem:
    """Another system, whose trajectory files are evaluated here.

    Attributes:
        note: what it is.
        with_scale: align its trajectories by Sim(3).
        trajectories: file by sequence, or by ``SEQUENCE@SEED`` of a rendered one; relative
            to the experiment's file or a data folder.
    """

    note: str = ""
    with_scale: bool = False
    trajectories: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Quotation:
    """Figures of one method from one source: by metric and sequence, in the metric's unit."""

    method: str
    source: str
    with_scale: bool = False
    figures: dict[str, dict[str, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Experiment:
    """The contents of an experiment's file.

    Attributes:
        name, title, description: texts for the report.
        file: its path; other paths are relative to its folder.
        sequences: in the order of the columns.
        configurations: by name, in the order of the rows; the first is the baseline.
        seeds: of the system, and of the images of rendered sequences.
        systems: other systems by name.
        published: figures from the literature.
        with_scale: align all runs by Sim(3), and the trajectories of all other systems.
        max_time_difference_s: largest difference of the stamps of associated poses.
        verdicts: metrics by which configurations are judged.
        networks: folders of trained networks by name, whose curves the report draws.
    """

    name: str
    title: str
    file: Path
    sequences: tuple[SequenceSource, ...]
    description: str = ""
    configurations: dict[str, Configuration] = field(default_factory=dict)
    seeds: tuple[int, ...] = (0,)
    systems: dict[str, OtherSystem] = field(default_factory=dict)
    published: tuple[Quotation, ...] = ()
    with_scale: bool = False
    max_time_difference_s: float = MAX_TIME_DIFFERENCE_S
    verdicts: tuple[str, ...] = VERDICT_METRICS
    networks: dict[str, Path] = field(default_factory=dict)

    def aligned_with_scale(self, system: str) -> bool:
        """Whether the trajectories of another system are aligned by Sim(3)."""
        return self.with_scale or self.systems[system].with_scale
