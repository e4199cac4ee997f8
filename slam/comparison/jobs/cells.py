"""From an experiment to jobs: what is rendered first, and a run for each cell."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path

from bmask_slam.comparison.experiment.data_folders import Site
from bmask_slam.comparison.experiment.experiment import Configuration, Experiment, SequenceSource
from bmask_slam.comparison.experiment.experiment_file import slug
from bmask_slam.comparison.experiment.provenance import (
    code_hash,
    configuration_hash,
    folder_hash,
    rendered_hash,
)
from bmask_slam.comparison.jobs.job import Job
from bmask_slam.rendering.sequence import RenderConfig

SEQUENCES, CELLS = "sequences", "cells"
SEED_SETTING = "loops.verification.seed={}"
Key = tuple[str, str, int]
"""A cell of this system: sequence, configuration, seed."""


@dataclass(frozen=True)
class Place:
    """A sequence as it lies on disk, or will when it is rendered.

    Attributes:
        source, seed: of it; the seed is None where it does not draw the images.
        folder, reference: None without.
        problem: why there are no images.
        contents: what its images depend on, as a short text.
        render: the job that draws it.
    """

    source: SequenceSource
    seed: int | None
    folder: Path | None
    reference: Path | None
    problem: str = ""
    contents: str = ""
    render: Job | None = None


def recorded_place(source: SequenceSource, site: Site) -> Place:
    """A recorded sequence, the same for every seed."""
    contents = "" if site.folder is None else folder_hash(site.folder, source.camera)
    return Place(source, None, site.folder, site.reference, site.problem, contents)


def drawn_place(source: SequenceSource, config: RenderConfig, seed: int, out: Path) -> Place:
    """A rendered sequence with its job; ``config`` without the seed."""
    drawn = replace(config, seed=seed, true_depth=True)
    folder = out / SEQUENCES / f"{slug(source.name)}-{seed}"
    contents = rendered_hash(drawn)
    beside = str(folder)
    job = Job(
        f"rendering {source.name}, seed {seed}",
        f"rendering {source.name}",
        ("render", config.name, *_render_arguments(drawn), "--out", beside, "--quiet"),
        product=str(folder / "groundtruth.txt"),
        record=f"{beside}.record/record.json",
        log=f"{beside}.record/log.txt",
        depends={"sequence": contents},
        fresh=beside,
    )
    return Place(source, seed, folder, folder / "groundtruth.txt", "", contents, job)


def _render_arguments(config: RenderConfig) -> Iterator[str]:
    """The command line that gives this configuration."""
    yield from ("--seed", str(config.seed))
    for name in (f.name for f in fields(config) if f.name not in ("name", "seed", "noise")):
        flag, value = f"--{name.replace('_', '-')}", getattr(config, name)
        if value is True:
            yield flag
        elif value is not None and value is not False:
            yield from (flag, str(value))
    if not config.noise:
        yield "--no-noise"


def run_jobs(experiment: Experiment, places: Iterable[Place], out: Path) -> dict[Key, Job]:
    """The runs by sequence, configuration and seed; none for a sequence without images."""
    jobs: dict[Key, Job] = {}
    for place in (p for p in places if p.folder is not None):
        seeds = experiment.seeds if place.seed is None else (place.seed,)
        for name, configuration in experiment.configurations.items():
            for seed in seeds:
                key = (place.source.name, name, seed)
                jobs[key] = _run_job(place, (name, configuration), seed, out)
    return jobs


def _run_job(place: Place, named: tuple[str, Configuration], seed: int, out: Path) -> Job:
    (name, configuration), source = named, place.source
    folder = out / CELLS / slug(source.name) / slug(name) / str(seed)
    run = folder / "run"
    setting = SEED_SETTING.format(seed)
    words = ["run", str(place.folder), "--out", str(run), "--quiet", "--overwrite"]
    words += [*configuration.arguments(), "--set", setting]
    if source.camera is not None:
        words += ["--camera", str(source.camera.absolute())]
    judged = place.seed is not None and (configuration.segmenter != "none" or configuration.dense)
    return Job(
        f"{source.name}, {name}, seed {seed}",
        f"{source.name}, {name}",
        tuple(words),
        product=str(run / "metrics.json"),
        record=str(folder / "cell.json"),
        log=str(folder / "log.txt"),
        depends={
            "code": code_hash(),
            "sequence": place.contents,
            "configuration": configuration_hash(configuration, (setting,)),
        },
        sequence=str(place.folder) if judged else "",
        run=str(run),
    )
