"""The jobs of an experiment: a rendering for each rendered sequence, and a run for each cell."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path

from bmask_slam.comparison.experiment.data_folders import SequenceLocation
from bmask_slam.comparison.experiment.experiment import Configuration, Experiment, SequenceSource
from bmask_slam.comparison.experiment.experiment_file import slug
from bmask_slam.comparison.experiment.provenance import (
    code_hash,
    configuration_hash,
    folder_hash,
    rendered_hash,
)
from bmask_slam.comparison.jobs.job import Job
from bmask_slam.graph.files.file_names import plain_path
from bmask_slam.rendering.config import RenderConfig

SEQUENCES, CELLS = "sequences", "cells"
SEED_SETTING = "loops.verification.seed={}"


@dataclass(frozen=True)
class CellKey:
    """A cell of this system: names of sequence and configuration, and the seed."""

    sequence: str
    configuration: str
    seed: int


@dataclass(frozen=True)
class SequenceData:
    """A sequence on disk, or one that will be rendered.

    Attributes:
        source: its entry in the experiment.
        seed: of a rendered sequence; None for a recorded one.
        folder: of the images; None if there are none.
        reference: its ground truth; None if there is none.
        problem: why there are no images.
        contents: hash of what its images depend on.
        render: the job that renders it; None for a recorded one.
    """

    source: SequenceSource
    seed: int | None
    folder: Path | None
    reference: Path | None
    problem: str = ""
    contents: str = ""
    render: Job | None = None


def recorded_sequence(source: SequenceSource, location: SequenceLocation) -> SequenceData:
    """A recorded sequence, the same for every seed."""
    contents = "" if location.folder is None else folder_hash(location.folder, source.camera)
    return SequenceData(
        source, None, location.folder, location.reference, location.problem, contents
    )


def rendered_sequence(
    source: SequenceSource, config: RenderConfig, seed: int, out: Path
) -> SequenceData:
    """A rendered sequence with its job; ``config`` without the seed."""
    seeded = replace(config, seed=seed, true_depth=True)
    folder = plain_path(out, f"{SEQUENCES}/{slug(source.name)}-{seed}")
    contents = rendered_hash(seeded)
    path = str(folder)
    job = Job(
        f"rendering {source.name}, seed {seed}",
        f"rendering {source.name}",
        ("render", config.name, *_render_arguments(seeded), "--out", path, "--quiet"),
        product=str(folder / "groundtruth.txt"),
        record=str(plain_path(out, f"{SEQUENCES}/{folder.name}.record/record.json")),
        log=f"{path}.record/log.txt",
        depends={"sequence": contents},
        clear=path,
    )
    return SequenceData(source, seed, folder, folder / "groundtruth.txt", "", contents, job)


def _render_arguments(config: RenderConfig) -> Iterator[str]:
    """The command-line options of this configuration."""
    yield from ("--seed", str(config.seed))
    for name in (f.name for f in fields(config) if f.name not in ("name", "seed", "noise")):
        flag, value = f"--{name.replace('_', '-')}", getattr(config, name)
        if value is True:
            yield flag
        elif isinstance(value, tuple):
            yield from (flag, ",".join(value)) if value else ()
        elif value is not None and value is not False:
            yield from (flag, str(value))
    if not config.noise:
        yield "--no-noise"


def run_jobs(
    experiment: Experiment, sequences: Iterable[SequenceData], out: Path
) -> dict[CellKey, Job]:
    """The run of each cell; none for a sequence without images."""
    jobs: dict[CellKey, Job] = {}
    for data in (s for s in sequences if s.folder is not None):
        seeds = experiment.seeds if data.seed is None else (data.seed,)
        for name, configuration in experiment.configurations.items():
            for seed in seeds:
                key = CellKey(data.source.name, name, seed)
                jobs[key] = _run_job(data, key, configuration, out)
    return jobs


def _run_job(data: SequenceData, key: CellKey, configuration: Configuration, out: Path) -> Job:
    source, name, seed = data.source, key.configuration, key.seed
    run = plain_path(out, f"{CELLS}/{slug(source.name)}/{slug(name)}/{seed}/run")
    folder = run.parent
    setting = SEED_SETTING.format(seed)
    words = ["run", str(data.folder), "--out", str(run), "--quiet", "--overwrite"]
    words += [*configuration.arguments(), "--set", setting]
    if source.camera is not None:
        words += ["--camera", str(source.camera.absolute())]
    has_truth = data.seed is not None and (configuration.segmenter != "none" or configuration.dense)
    return Job(
        f"{source.name}, {name}, seed {seed}",
        f"{source.name}, {name}",
        tuple(words),
        product=str(run / "metrics.json"),
        record=str(folder / "cell.json"),
        log=str(folder / "log.txt"),
        depends={
            "code": code_hash(),
            "sequence": data.contents,
            "configuration": configuration_hash(configuration, (setting,)),
        },
        sequence=str(data.folder) if has_truth else "",
        run=str(run),
    )
