"""What a cell's result depends on, as short texts: equal ones mean that nothing has changed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from functools import cache
from importlib.metadata import version
from pathlib import Path

import bmask_slam
from bmask_slam import graph, mapping, semantics
from bmask_slam.comparison.experiment.experiment import OPTIONS, Configuration
from bmask_slam.config.configuration import dump, find_config, resolve
from bmask_slam.graph.data_files import data_path
from bmask_slam.rendering.sequence import RenderConfig
from bmask_slam.system_config import SystemConfig

SYSTEM = Path(bmask_slam.__path__[0])
LAYERS = (*tuple(Path(layer.__path__[0]) for layer in (graph, semantics, mapping)), SYSTEM)
ELSEWHERE = (
    "comparison",
    "viewer",
    "live",
    "rendering",
    "datasets",
)  # folders of slam that no run needs
LIBRARIES = ("gtsam", "numpy", "opencv-python-headless", "torch", "scipy", "faiss-cpu")
CONTENTS = ("rgb.txt", "depth.txt", "associations.txt", "camera.yaml", "annotations.json")


@cache
def code_print() -> str:
    """Of the code that runs, the network's weights, and the libraries."""
    versions = ",".join(f"{name} {version(name)}" for name in LIBRARIES)
    parts = [versions]
    for folder in LAYERS:
        used = (p for p in folder.rglob("*.py") if p.relative_to(folder).parts[0] not in ELSEWHERE)
        parts += _contents(used, folder)
    weights = data_path("weights")
    return _digest([*parts, *_contents(weights.glob("*.safetensors"), weights)])


@cache
def rendering_print() -> str:
    """Of the code that renders."""
    folder = SYSTEM / "rendering"
    return _digest(_contents(folder.rglob("*.py"), folder))


def drawn_print(config: RenderConfig) -> str:
    """Of a rendered sequence."""
    return _digest([rendering_print(), json.dumps(asdict(config))])


def folder_print(folder: Path, camera: Path | None) -> str:
    """Of a recorded sequence: its lists and camera by content, its images by name and size."""
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    sizes = (
        f"{p.relative_to(folder)} {p.stat().st_size}" for p in files if p.name != "groundtruth.txt"
    )
    lists = _contents((p for p in files if p.name in CONTENTS), folder)
    given = [camera.read_text(encoding="utf-8")] if camera else []
    return _digest([*sizes, *lists, *given])


def configuration_print(configuration: Configuration, settings: tuple[str, ...]) -> str:
    """Of the resolved parameters and the other options of a run."""
    file = find_config(configuration.config) if configuration.config else None
    resolved = dump(resolve(SystemConfig, file, (*configuration.set, *settings)))
    return _digest([resolved, *(str(getattr(configuration, name)) for name in OPTIONS)])


def _contents(files: Iterable[Path], root: Path) -> Iterator[str]:
    for path in sorted(files):
        yield f"{path.relative_to(root) if path.is_relative_to(root) else path.name} "
        yield hashlib.sha256(path.read_bytes()).hexdigest()


def _digest(texts: Iterable[str]) -> str:
    whole = hashlib.sha256()
    for text in texts:
        whole.update(text.encode() + b"\0")
    return whole.hexdigest()[:16]
