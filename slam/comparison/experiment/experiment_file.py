"""Reading an experiment: a YAML file with strict keys, or the name of a shipped one."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from bmask_slam.comparison.experiment.experiment import (
    VERDICT_METRICS,
    Configuration,
    Experiment,
    OtherSystem,
    Quotation,
    SequenceSource,
)
from bmask_slam.config.configuration import find_config, from_tree, resolve
from bmask_slam.graph.errors import InputError, did_you_mean
from bmask_slam.graph.files.data_files import given_or_shipped
from bmask_slam.graph.files.yaml_file import read_yaml
from bmask_slam.graph.trajectory import MAX_TIME_DIFFERENCE_S
from bmask_slam.rendering.config import SCENES, RenderConfig
from bmask_slam.reporting.metric_table import BY_NAME
from bmask_slam.system_config import SystemConfig

NAME = re.compile(r"[^/\\@=:\n]{1,60}")
GROUPS = ("sequences", "configurations", "systems", "published", "networks")


@dataclass(frozen=True)
class _Settings:
    """The keys of an experiment whose values are settings."""

    name: str = ""
    title: str = ""
    description: str = ""
    seeds: tuple[int, ...] = (0,)
    with_scale: bool = False
    max_time_difference_s: float = MAX_TIME_DIFFERENCE_S
    verdicts: tuple[str, ...] = VERDICT_METRICS

    def __post_init__(self) -> None:
        if not self.seeds or min(self.seeds) < 0 or len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"seeds = {list(self.seeds)}: give whole numbers, each once")
        if not 0 < self.max_time_difference_s <= 1:
            raise ValueError(
                f"max_time_difference_s = {self.max_time_difference_s:g}: give seconds, at most 1"
            )
        for name in self.verdicts:
            if name not in BY_NAME or BY_NAME[name].lower_is_better is None:
                cure = f"{_metrics(judged=True)}{did_you_mean(str(name), BY_NAME)}"
                raise ValueError(f"verdicts: {name!r} cannot be judged; {cure}")


@dataclass(frozen=True)
class _Folder:
    """The keys of a sequence besides ``render``."""

    folder: str = ""
    reference: Path | None = None
    camera: Path | None = None


def find_experiment(name: str | Path) -> Path:
    """An experiment's file from its path, or from the bare name of one in ``data/experiments``."""
    return given_or_shipped(name, "experiments")


def read_experiment(name: str | Path) -> Experiment:
    """The experiment in a file, or the shipped one of that name.

    Raises:
        InputError: naming the file, the dotted path, the value and the cure.
    """
    file = find_experiment(name)
    tree = _mapping(read_yaml(file), str(file), "the whole")
    known = [*(f.name for f in fields(_Settings)), *GROUPS]
    for key in tree:
        if key not in known:
            raise InputError(f"{file}: unknown key {key}; there are: {', '.join(known)}")
    settings = from_tree(_Settings, {k: v for k, v in tree.items() if k not in GROUPS}, str(file))
    sequences = tuple(_sequences(file, tree.get("sequences")))
    configurations = dict(_configurations(file, tree.get("configurations")))
    systems = dict(_systems(file, tree.get("systems")))
    published = tuple(_quotations(file, tree.get("published")))
    _check_names(file, sequences, (configurations, systems, {q.method: q for q in published}))
    _check_sequences(file, {s.name for s in sequences}, systems, published)
    return Experiment(
        settings.name or file.stem,
        settings.title or settings.name or file.stem,
        file,
        sequences,
        settings.description.strip(),
        configurations,
        settings.seeds,
        systems,
        published,
        settings.with_scale,
        settings.max_time_difference_s,
        settings.verdicts,
        dict(_networks(file, tree.get("networks"))),
    )


def _sequences(file: Path, tree: Any) -> Iterator[SequenceSource]:
    """A sequence is a text (its folder) or keys; ``render`` has the keys of RenderConfig."""
    if not tree:
        raise InputError(f"{file}: sequences is missing; give at least one, as NAME: FOLDER")
    for name, given in _mapping(tree, str(file), "sequences").items():
        where = f"{file}: sequences.{name}"
        keys = dict(_mapping({"folder": given} if isinstance(given, str) else given, where))
        render = keys.pop("render", None)
        rest = from_tree(_Folder, keys, where)
        if bool(rest.folder) == (render is not None):
            raise InputError(f"{where}: give either folder or render")
        files = {key: _relative_to(file, getattr(rest, key)) for key in ("reference", "camera")}
        config = None if render is None else _render(render, f"{where}.render")
        yield SequenceSource(name, rest.folder, config, **files)


def _render(tree: Any, where: str) -> RenderConfig:
    keys = _mapping(tree, where)
    if "seed" in keys:
        raise InputError(f"{where}: seed = {keys['seed']!r} is each cell's own; write it in seeds")
    if keys.get("name") not in SCENES:
        raise InputError(
            f"{where}: name = {keys.get('name')!r} is not a scene; there are: {', '.join(SCENES)}"
        )
    return from_tree(RenderConfig, keys, where)


def _configurations(file: Path, tree: Any) -> Iterator[tuple[str, Configuration]]:
    """The configurations; each is resolved once, so that a wrong key is found before any run."""
    for name, given in _mapping(tree or {}, str(file), "configurations").items():
        where = f"{file}: configurations.{name}"
        found = from_tree(Configuration, given or {}, where)
        if found.config and not re.fullmatch(r"[\w-]+", found.config):
            path = str(_relative_to(file, Path(found.config)))
            found = from_tree(Configuration, {**(given or {}), "config": path}, where)
        for key in ("max_frames", "stride"):
            value = getattr(found, key)
            if value is not None and value < 1:
                raise InputError(f"{where}: {key} = {value}: must be at least 1")
        try:
            resolve(SystemConfig, find_config(found.config) if found.config else None, found.set)
        except InputError as error:
            raise InputError(f"{where}: {error}") from error
        yield name, found


def _systems(file: Path, tree: Any) -> Iterator[tuple[str, OtherSystem]]:
    for name, given in _mapping(tree or {}, str(file), "systems").items():
        where = f"{file}: systems.{name}"
        keys = dict(_mapping(given, where))
        files = _mapping(keys.pop("trajectories", {}), where, "trajectories")
        for sequence, path in files.items():
            if not isinstance(path, str):
                raise InputError(f"{where}.trajectories.{sequence} = {path!r}: give a file's path")
        settings = from_tree(OtherSystem, keys, where)
        yield name, OtherSystem(settings.note, settings.with_scale, files)


def _networks(file: Path, tree: Any) -> Iterator[tuple[str, Path]]:
    """A folder each, relative to the experiment's file."""
    for name, path in _mapping(tree or {}, str(file), "networks").items():
        if not isinstance(path, str) or not (file.parent / path).is_dir():
            raise InputError(
                f"{file}: networks.{name} = {path!r}: no such folder; give that of a training"
            )
        yield name, (file.parent / path).absolute()


def _quotations(file: Path, tree: Any) -> Iterator[Quotation]:
    """Entries {method, source, with_scale, METRIC: {SEQUENCE: value}}."""
    if tree is not None and not isinstance(tree, list):
        raise InputError(
            f"{file}: published = {tree!r}: give a list of entries with method, source"
        )
    for number, given in enumerate(tree or ()):
        where = f"{file}: published[{number}]"
        keys = dict(_mapping(given, where))
        metrics = {key: keys.pop(key) for key in list(keys) if key in BY_NAME}
        for key in keys:
            if key not in ("method", "source", "with_scale"):
                raise InputError(
                    f"{where}: unknown key {key}; there are: method, source, with_scale and a "
                    f"metric ({_metrics()}){did_you_mean(key, BY_NAME)}"
                )
        for key in ("method", "source"):
            if not isinstance(keys.get(key), str) or not keys[key].strip():
                raise InputError(f"{where}: {key} is missing; give it as a text")
        if not isinstance(keys.get("with_scale", False), bool):
            raise InputError(f"{where}: with_scale = {keys['with_scale']!r}: give true or false")
        figures = {name: dict(_numbers(where, name, v)) for name, v in metrics.items()}
        yield Quotation(keys["method"], keys["source"], keys.get("with_scale", False), figures)


def _numbers(where: str, metric: str, tree: Any) -> Iterator[tuple[str, float]]:
    for sequence, value in _mapping(tree, where, metric).items():
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not value >= 0:
            raise InputError(
                f"{where}.{metric}.{sequence} = {value!r}: give a number, in metrics.json's unit"
            )
        yield sequence, float(value)


def _check_names(
    file: Path, sequences: Iterable[SequenceSource], groups: tuple[dict[str, Any], ...]
) -> None:
    """Check that names can be folders and are unique."""
    methods = [name for group in groups for name in group]
    for kind, names in (("sequence", [s.name for s in sequences]), ("method", methods)):
        slugs: dict[str, str] = {}
        for name in names:
            if not NAME.fullmatch(name) or not slug(name).strip("-."):
                raise InputError(f"{file}: {kind} {name!r}: use letters and digits, not / \\ @ = :")
            if slug(name) in slugs:
                raise InputError(f"{file}: {kind}s {slugs[slug(name)]!r} and {name!r}: too similar")
            slugs[slug(name)] = name


def _check_sequences(
    file: Path, known: set[str], systems: dict[str, OtherSystem], published: Iterable[Quotation]
) -> None:
    """Refuse figures and trajectories of sequences that are not in the experiment."""
    named = [(f"systems.{k}", key) for k, v in systems.items() for key in v.trajectories]
    named += [
        (f"published {q.method}", key) for q in published for f in q.figures.values() for key in f
    ]
    for where, key in named:
        if key.partition("@")[0] not in known:
            listed = ", ".join(sorted(known))
            raise InputError(f"{file}: {where}: no sequence {key!r}; there are: {listed}")


def slug(name: str) -> str:
    """The name of a folder for a name."""
    return re.sub(r"[^\w.-]+", "-", name)


def _mapping(tree: Any, source: str, path: str = "") -> dict[str, Any]:
    """The mapping with its keys as texts. Raises InputError."""
    if not isinstance(tree, dict):
        shown = f"{path} = {tree!r}" if path else repr(tree)
        raise InputError(f"{source}: {shown}: give a group of keys")
    return {str(key): value for key, value in tree.items()}


def _relative_to(file: Path, path: Path | None) -> Path | None:
    """A path relative to the experiment's file."""
    return None if path is None else file.parent / path


def _metrics(judged: bool = False) -> str:
    names = (m.name for m in BY_NAME.values() if not judged or m.lower_is_better is not None)
    return f"metrics are: {', '.join(names)}"
