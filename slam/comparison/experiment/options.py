"""Options of a comparison, and the part of an experiment that they select."""

from __future__ import annotations

import glob
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from bmask_slam.comparison.experiment.experiment import Experiment, OtherSystem
from bmask_slam.graph.errors import InputError, did_you_mean

EVERY, NAMED = "*", "{sequence}"
Value = TypeVar("Value")
Files = dict[tuple[str, str], Path]
"""Trajectory file by method and SEQUENCE or SEQUENCE@SEED; of EVERY sequence a pattern."""


@dataclass(frozen=True)
class CompareOptions:
    """Options of a comparison.

    Attributes:
        data: folders in which recordings and trajectories are looked for, before those of the
            environment variable BMASK_SLAM_DATA and ``data``.
        references: ground truth by sequence, instead of its own.
        trajectories: of other systems, by method and sequence.
        seeds, sequences, configurations: those to use; None for all.
        workers: jobs at a time; None: as many as there are cores.
        ray: address of a Ray cluster to use instead of this machine.
        with_scale: align all runs and trajectories by Sim(3), also if the experiment does not.
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
    """``METHOD:SEQUENCE=FILE``, ``METHOD:SEQUENCE@SEED=FILE`` or ``METHOD:*=PATTERN``.

    Raises InputError.
    """
    name, separator, file = text.partition("=")
    method, colon, sequence = name.rpartition(":")
    if not (separator and colon and method and sequence and file):
        raise InputError(f"--trajectory {text}: write it as METHOD:SEQUENCE=FILE")
    return (method, sequence), Path(file)


def with_trajectories(experiment: Experiment, files: Files) -> Experiment:
    """The experiment with the given trajectories, which replace its own or add a system.

    Raises:
        InputError: a file that does not exist, an unknown sequence, or a method's name in use.
    """
    systems = dict(experiment.systems)
    for (method, sequence), file in _without_patterns(experiment, files).items():
        known = [s.name for s in experiment.sequences]
        if sequence.partition("@")[0] not in known:
            raise InputError(
                f"--trajectory {method}:{sequence}: no such sequence; there are: {', '.join(known)}"
            )
        used = [*experiment.configurations, *(q.method for q in experiment.published)]
        if method in used:
            raise InputError(f"--trajectory {method}:{sequence}: {method!r} is another row's name")
        if not file.is_file():
            raise InputError(f"{file}: no such file; give a trajectory in TUM format")
        system = systems.get(method, OtherSystem())
        given = {**system.trajectories, sequence: str(file.absolute())}
        systems[method] = replace(system, trajectories=given)
    return replace(experiment, systems=systems)


def _without_patterns(experiment: Experiment, files: Files) -> Files:
    """The files with those that a pattern stands for, one for each sequence that has one.

    In the pattern of the sequence ``*`` ``{sequence}`` is the sequence's name, other ``*`` and
    ``?`` are those of a shell. Raises InputError if a pattern fits no file, or several.
    """
    found = {key: file for key, file in files.items() if key[1] != EVERY}
    for (method, sequence), pattern in files.items():
        if sequence != EVERY:
            continue
        where = f"--trajectory {method}:*={pattern}"
        if NAMED not in str(pattern):
            raise InputError(f"{where}: write {NAMED} where the name of the sequence stands")
        before = len(found)
        for source in experiment.sequences:
            text = str(pattern).replace(NAMED, glob.escape(source.name))
            fitting = sorted(glob.glob(text, recursive=True))
            if len(fitting) > 1:
                raise InputError(f"{where}: {fitting[0]} and {fitting[1]} fit; make it narrower")
            if fitting:
                found[method, source.name] = Path(fitting[0])
        if len(found) == before:
            raise InputError(f"{where}: no file fits for any sequence; correct the pattern")
    return found


def select_part(experiment: Experiment, options: CompareOptions) -> Experiment:
    """The part of an experiment that the options select, with their files.

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
    experiment = with_trajectories(experiment, options.trajectories)
    selected = set(names if options.sequences is None else options.sequences)
    rows = options.configurations
    sequences = tuple(
        replace(s, reference=options.references.get(s.name, s.reference))
        for s in experiment.sequences
        if s.name in selected
    )
    seeds = options.seeds or experiment.seeds
    return replace(
        _without_others(experiment, selected, seeds),
        sequences=sequences,
        configurations={
            k: v for k, v in experiment.configurations.items() if rows is None or k in rows
        },
        seeds=seeds,
        with_scale=experiment.with_scale or options.with_scale,
    )


def _without_others(experiment: Experiment, selected: set[str], seeds: Sequence[int]) -> Experiment:
    """Without the trajectories and published figures of other sequences, and of other seeds.

    A rendered sequence looks otherwise with each seed; of a recorded one seeds are repetitions.
    """
    rendered = {source.name for source in experiment.sequences if source.render is not None}

    def is_wanted(key: str) -> bool:
        name, _, seed = key.partition("@")
        is_other = name in rendered and seed.isdecimal() and int(seed) not in seeds
        return name in selected and not is_other

    def only(values: Mapping[str, Value]) -> dict[str, Value]:
        return {key: value for key, value in values.items() if is_wanted(key)}

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
    flag: str, names: Iterable[str] | None, known: Iterable[str], experiment: Experiment
) -> None:
    unknown = [name for name in names or () if name not in known]
    if unknown:
        listed, near = ", ".join(known), did_you_mean(unknown[0], known)
        raise InputError(
            f"{flag} {unknown[0]}: not in {experiment.file}; there are: {listed}{near}"
        )
