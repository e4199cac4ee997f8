"""Provenance of figures, and hashes of what they depend on.

A result is kept if the hashes are equal.
"""

from __future__ import annotations

import hashlib
import json
import shlex
import sys
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

from bmask_slam import __version__, graph, mapping, semantics
from bmask_slam.comparison.experiment.experiment import OPTIONS, Configuration, Experiment
from bmask_slam.config.configuration import differences, dump, find_config, resolve
from bmask_slam.evaluation.reference import TRUTH, TRUTH_BODY
from bmask_slam.graph.files.data_files import data_path
from bmask_slam.graph.files.reading import read_bytes, read_text
from bmask_slam.rendering.config import RenderConfig
from bmask_slam.runtime.machine import commit, describe_machine, versions
from bmask_slam.system_config import SystemConfig

PACKAGES = ("gtsam", "numpy", "opencv-python-headless", "open3d", "scipy", "torch", "faiss-cpu")
SYSTEM = Path(__file__).parents[2]
LAYERS = (*tuple(Path(layer.__path__[0]) for layer in (graph, semantics, mapping)), SYSTEM)
NOT_HASHED = ("comparison", "viewer", "live", "rendering", "datasets")
"""Folders of slam that do not affect a run."""
LIBRARIES = ("gtsam", "numpy", "opencv-python-headless", "torch", "scipy", "faiss-cpu")
CONTENTS = ("rgb.txt", "depth.txt", "associations.txt", "camera.yaml", "annotations.json")


def provenance(experiment: Experiment, workers: int) -> dict[str, Any]:
    """Plain values by name, for JSON; ``workers``: jobs that ran at a time."""
    head, changed = commit()
    return {
        "version": __version__,
        "commit": f"{head} with changes" if changed else head,
        "code": code_hash(),
        "command": shlex.join(["bmask-slam", *sys.argv[1:]]) if sys.argv[1:] else "",
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "workers": workers,
        "machine": describe_machine(),
        "packages": versions(PACKAGES),
        "configurations": {k: _changed(v) for k, v in experiment.configurations.items()},
        "experiment": _paths_as_text(asdict(experiment)),
    }


def _changed(configuration: Configuration) -> dict[str, Any]:
    """Parameters by dotted path that differ from the defaults, and options."""
    file = find_config(configuration.config) if configuration.config else None
    found = differences(resolve(SystemConfig, file, configuration.set), SystemConfig())
    options = {name: getattr(configuration, name) for name in OPTIONS}
    return found | {name: value for name, value in options.items() if value}


def _paths_as_text(value: Any) -> Any:
    """The value with every path in it as text."""
    if isinstance(value, dict):
        return {key: _paths_as_text(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_paths_as_text(item) for item in value]
    return str(value) if isinstance(value, Path) else value


# --- Hashes --------------------------------------------------------------------------------------


@cache
def code_hash() -> str:
    """Hash of the code that a run uses, the network's weights, and the libraries' versions."""
    parts = [",".join(f"{name} {number}" for name, number in versions(LIBRARIES).items())]
    for folder in LAYERS:
        used = (p for p in folder.rglob("*.py") if p.relative_to(folder).parts[0] not in NOT_HASHED)
        parts += _contents(used, folder)
    weights = data_path("weights")
    return _digest([*parts, *_contents(weights.glob("*.safetensors"), weights)])


@cache
def rendering_hash() -> str:
    """Hash of the code that renders."""
    folder = SYSTEM / "rendering"
    return _digest(_contents(folder.rglob("*.py"), folder))


def rendered_hash(config: RenderConfig) -> str:
    """Hash of a rendered sequence: its configuration and the code that renders."""
    return _digest([rendering_hash(), json.dumps(asdict(config))])


def folder_hash(folder: Path, camera: Path | None) -> str:
    """Hash of a recorded sequence: lists and camera by content, images by name and size."""
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    sizes = (
        f"{p.relative_to(folder)} {p.stat().st_size}"
        for p in files
        if p.name not in (TRUTH, TRUTH_BODY)
    )
    lists = _contents((p for p in files if p.name in CONTENTS), folder)
    given = [read_text(camera, "give a camera.yaml")] if camera else []
    return _digest([*sizes, *lists, *given])


def configuration_hash(configuration: Configuration, settings: tuple[str, ...]) -> str:
    """Hash of the resolved configuration and the other options of a run."""
    file = find_config(configuration.config) if configuration.config else None
    resolved = dump(resolve(SystemConfig, file, (*configuration.set, *settings)))
    return _digest([resolved, *(str(getattr(configuration, name)) for name in OPTIONS)])


def _contents(files: Iterable[Path], root: Path) -> Iterator[str]:
    for path in sorted(files):
        yield f"{path.relative_to(root) if path.is_relative_to(root) else path.name} "
        yield hashlib.sha256(read_bytes(path, "restore it")).hexdigest()


def _digest(texts: Iterable[str]) -> str:
    digest = hashlib.sha256()
    for text in texts:
        digest.update(text.encode() + b"\0")
    return digest.hexdigest()[:16]
