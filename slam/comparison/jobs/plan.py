"""An experiment with everything found that it needs: where sequences and files are, what to run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from bmask_slam.comparison.experiment.data_folders import data_folders, find_file, find_site
from bmask_slam.comparison.experiment.experiment import Experiment, SequenceSource
from bmask_slam.comparison.experiment.options import CompareOptions
from bmask_slam.comparison.jobs.cells import Key, Place, drawn_place, recorded_place, run_jobs
from bmask_slam.comparison.jobs.job import Job

Found = dict[tuple[str, str], Path | None]
"""Trajectory file by method and SEQUENCE or SEQUENCE@SEED; None where it is not there."""


@dataclass(frozen=True)
class Plan:
    """What is to be done in a folder.

    Attributes:
        experiment: the chosen part of it.
        folder: of the comparison, absolute.
        places: where the sequences are, one for each seed of a rendered one.
        jobs: the runs; none for a sequence without images.
        files: of other systems.
    """

    experiment: Experiment
    folder: Path
    places: tuple[Place, ...]
    jobs: dict[Key, Job]
    files: Found

    def cells(self) -> Iterator[Key]:
        """Every cell of this system's own: sequence, configuration, seed."""
        for source in self.experiment.sequences:
            for name in self.experiment.configurations:
                yield from ((source.name, name, seed) for seed in self.experiment.seeds)

    def place(self, sequence: str, seed: int | None) -> Place:
        """Where a sequence is; without a seed, or with one that is not run, its first."""
        own = [p for p in self.places if p.source.name == sequence]
        return next((p for p in own if p.seed == seed), own[0])


def make_plan(experiment: Experiment, folder: Path, options: CompareOptions) -> Plan:
    """Look for all sequences and files of an experiment, and say what is to be run."""
    folders = data_folders(options.data)
    files: Found = {
        (method, key): find_file(path, experiment, folders)
        for method, system in experiment.systems.items()
        for key, path in system.trajectories.items()
    }
    places: list[Place] = []
    for source in experiment.sequences:
        if source.render is not None:
            drawn = (drawn_place(source, source.render, s, folder) for s in experiment.seeds)
            places += drawn
        else:
            beside = _files_of(source, files)
            site = find_site(source, experiment, folders, beside)
            places.append(recorded_place(source, site))
    return Plan(experiment, folder, tuple(places), run_jobs(experiment, places, folder), files)


def _files_of(source: SequenceSource, files: Found) -> list[Path]:
    return [p for (_, key), p in files.items() if p and key.partition("@")[0] == source.name]
