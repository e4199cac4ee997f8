"""How an experiment is carried out, and which part of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from bmask_slam.comparison.experiment.experiment import Experiment, OtherSystem
from bmask_slam.graph.errors import InputError

Value = TypeVar("Value")
Files = dict[tuple[str, str], Path]
"""Trajectory file by method and SEQUENCE or SEQUENCE@SEED."""


@dataclass(frozen=True)
class CompareOptions:
    """How an experiment is carried out.

    Attributes:
        data: folders in which recordings and trajectories are looked for, before those of the
            environment variable BMASK_SLAM_DATA and ``data``.
        references: ground truth by sequence, in place of its own.
        trajectories: of other systems, by method and sequence.
        seeds, sequences, configurations: only these of the experiment's; None for all.
        workers: jobs at a time; None: as many as there are cores.
        ray: address of a Ray cluster to use instead of this machine.
        with_scale: align all runs by Sim(3), whatever the experiment says.
        quiet: no progress bar.
    """

    data: tuple[Path, ...] = ()
    references: Mapping[str, Path] = field(default_factory=dict)
    trajectories: Files = field(default_factory=dict)
    seeds: tuple[int, ...] | None = None
    sequences: tuple[str, ...] | None = None
    configurations: tuple[str, ...] | None = None
    workers: int | None = None
    ray: str | None = None
    with_scale: bool = False
    quiet: bool = False

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise InputError(f"--jobs {self.workers}: must be at least 1")
        if self.seeds is not None and (not self.seeds or min(self.seeds) < 0):
            raise InputError(f"--seeds {self.seeds}: give whole numbers, none negative")


def parse_trajectory(text: str) -> tuple[tuple[str, str], Path]:
    """``METHOD:SEQUENCE=FILE`` or ``METHOD:SEQUENCE@SEED=FILE``. Raises InputError."""
    name, separator, file = text.partition("=")
    method, colon, sequence = name.rpartition(":")
    if not (separator and colon and method and sequence and file):
        raise InputError(f"--trajectory {text}: write it as METHOD:SEQUENCE=FILE")
    return (method, sequence), Path(file)


def with_files(experiment: Experiment, files: Files) -> Experiment:
    """The experiment with the given files in place of its own, and their systems if it lacks them.

    Raises:
        InputError: a file that does not exist, or a sequence or method that cannot be.
    """
    systems = dict(experiment.systems)
    for (method, sequence), file in files.items():
        there = [s.name for s in experiment.sequences]
        if sequence.partition("@")[0] not in there:
            raise InputError(
                f"--trajectory {method}:{sequence}: no such sequence; there are: {', '.join(there)}"
            )
        taken = [*experiment.configurations, *(q.method for q in experiment.published)]
        if method in taken:
            raise InputError(f"--trajectory {method}:{sequence}: {method!r} is another row's name")
        if not file.is_file():
            raise InputError(f"{file}: no such file; give a trajectory in TUM format")
        system = systems.get(method, OtherSystem())
        given = {**system.trajectories, sequence: str(file.absolute())}
        systems[method] = replace(system, trajectories=given)
    return replace(experiment, systems=systems)


def chosen(experiment: Experiment, options: CompareOptions) -> Experiment:
    """The part of an experiment that is asked for, with the files that are given.

    Raises:
        InputError: a name that the experiment does not have, or a file that does not exist.
    """
    names = [s.name for s in experiment.sequences]
    _check("--sequences", options.sequences, names, experiment)
    _check("--configurations", options.configurations, experiment.configurations, experiment)
    _check("--reference", options.references, names, experiment)
    for path in options.references.values():
        if not path.is_file():
            raise InputError(f"--reference {path}: no such file; give a trajectory in TUM format")
    experiment = with_files(experiment, options.trajectories)
    kept = set(names if options.sequences is None else options.sequences)
    rows = options.configurations
    sequences = tuple(
        replace(s, reference=options.references.get(s.name, s.reference))
        for s in experiment.sequences
        if s.name in kept
    )
    return replace(
        _without_others(experiment, kept),
        sequences=sequences,
        configurations={
            k: v for k, v in experiment.configurations.items() if rows is None or k in rows
        },
        seeds=options.seeds or experiment.seeds,
        with_scale=experiment.with_scale or options.with_scale,
    )


def _without_others(experiment: Experiment, kept: set[str]) -> Experiment:
    """Without the trajectories and published figures of other sequences."""

    def only(values: Mapping[str, Value]) -> dict[str, Value]:
        return {key: value for key, value in values.items() if key.partition("@")[0] in kept}

    systems = {
        name: replace(system, trajectories=only(system.trajectories))
        for name, system in experiment.systems.items()
    }
    published = (
        replace(q, figures={metric: only(v) for metric, v in q.figures.items()})
        for q in experiment.published
    )
    return replace(
        experiment,
        systems={name: system for name, system in systems.items() if system.trajectories},
        published=tuple(q for q in published if any(q.figures.values())),
    )


def _check(
    flag: str, asked: Iterable[str] | None, there: Iterable[str], experiment: Experiment
) -> None:
    unknown = [name for name in asked or () if name not in there]
    if unknown:
        known = ", ".join(there)
        raise InputError(f"{flag} {unknown[0]}: not in {experiment.file}; there are: {known}")
