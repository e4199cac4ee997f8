"""Where figures come from: commit, machine, versions, command, the experiment in full."""

from __future__ import annotations

import shlex
import sys
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bmask_slam import __version__
from bmask_slam.comparison.experiment.experiment import OPTIONS, Configuration, Experiment
from bmask_slam.comparison.experiment.fingerprint import code_print
from bmask_slam.config.configuration import differences, find_config, resolve
from bmask_slam.runtime.machine import commit, describe_machine, versions
from bmask_slam.system_config import SystemConfig

PACKAGES = ("gtsam", "numpy", "opencv-python-headless", "open3d", "scipy", "torch", "faiss-cpu")


def provenance(experiment: Experiment, workers: int) -> dict[str, Any]:
    """By name: plain values that can be written as JSON.

    ``workers`` jobs ran beside each other, which tells what their times are worth.
    """
    head, changed = commit()
    return {
        "version": __version__,
        "commit": f"{head} with changes" if changed else head,
        "code": code_print(),
        "command": shlex.join(["bmask-slam", *sys.argv[1:]]) if sys.argv[1:] else "",
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "workers": workers,
        "machine": describe_machine(),
        "packages": versions(PACKAGES),
        "configurations": {k: _changed(v) for k, v in experiment.configurations.items()},
        "experiment": _plain(asdict(experiment)),
    }


def _changed(configuration: Configuration) -> dict[str, Any]:
    """What differs from the defaults of the code, parameters by dotted path, and the options."""
    file = find_config(configuration.config) if configuration.config else None
    found = differences(resolve(SystemConfig, file, configuration.set), SystemConfig())
    options = {name: getattr(configuration, name) for name in OPTIONS}
    return found | {name: value for name, value in options.items() if value}


def _plain(value: Any) -> Any:
    """Paths as text, all the way down."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value
