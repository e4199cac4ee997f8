"""What an experiment needs: the locations of sequences and files, and the jobs to run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from bmask_slam.comparison.experiment.data_folders import data_folders, find_file, locate_sequence
from bmask_slam.comparison.experiment.experiment import Experiment, SequenceSource
from bmask_slam.comparison.experiment.options import CompareOptions
from bmask_slam.comparison.jobs.cells import (
    CellKey,
    SequenceData,
    recorded_sequence,
    rendered_sequence,
    run_jobs,
)
from bmask_slam.comparison.jobs.job import Job

TrajectoryFiles = dict[tuple[str, str], Path | None]
"""Trajectory file by method and SEQUENCE or SEQUENCE@SEED; None if it was not found."""


@dataclass(frozen=True)
class Plan:
    """The jobs of a comparison, and the files that it uses.

    Attributes:
        experiment: the chosen part of it.
        folder: of the comparison, absolute.
        sequences: recorded ones, and one for each seed of a rendered one.
        jobs: the run of each cell; none for a sequence without images.
        files: trajectories of other systems.
    """

    experiment: Experiment
    folder: Path
    sequences: tuple[SequenceData, ...]
    jobs: dict[CellKey, Job]
    files: TrajectoryFiles

    def cells(self) -> Iterator[CellKey]:
        """Every cell of this system."""
        for source in self.experiment.sequences:
            for name in self.experiment.configurations:
                yield from (CellKey(source.name, name, seed) for seed in self.experiment.seeds)

    def sequence(self, name: str, seed: int | None) -> SequenceData:
        """A sequence by name and seed; the first of that name if the seed is None or not run."""
        found = [s for s in self.sequences if s.source.name == name]
        return next((s for s in found if s.seed == seed), found[0])


def make_plan(experiment: Experiment, folder: Path, options: CompareOptions) -> Plan:
    """Find all sequences and files of an experiment, and make its jobs."""
    folders = data_folders(options.data)
    files: TrajectoryFiles = {
        (method, key): find_file(path, experiment, folders)
        for method, system in experiment.systems.items()
        for key, path in system.trajectories.items()
    }
    sequences: list[SequenceData] = []
    for source in experiment.sequences:
        if source.render is not None:
            render = source.render
            sequences += (rendered_sequence(source, render, s, folder) for s in experiment.seeds)
        else:
            location = locate_sequence(source, experiment, folders, _files_of(source, files))
            sequences.append(recorded_sequence(source, location))
    jobs = run_jobs(experiment, sequences, folder)
    return Plan(experiment, folder, tuple(sequences), jobs, files)


def _files_of(source: SequenceSource, files: TrajectoryFiles) -> list[Path]:
    return [p for (_, key), p in files.items() if p and key.partition("@")[0] == source.name]
