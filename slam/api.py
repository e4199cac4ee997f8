"""The system's commands as functions: keyword arguments are checked, a `Run` comes out."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, Unpack

import numpy as np

from bmask_slam.graph.errors import InputError
from bmask_slam.run_folder.reader import Run

if TYPE_CHECKING:
    from bmask_slam.semantics.segmenters.segmenter import Segmenter
    from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions
    from bmask_slam.system_config import SystemConfig

AnyPath = str | os.PathLike[str]


class RunKeywords(TypedDict, total=False):
    """Further keywords of `run`; each is the field of `RunOptions` of the same name."""

    overwrite: bool
    camera: AnyPath
    reference: AnyPath
    max_frames: int
    stride: int
    checkpoint_every: int
    map: AnyPath
    localise: AnyPath
    calibrate: str
    dense: bool
    mesh_voxel_m: float
    parallel: bool
    full_size: bool
    quiet: bool


class MapKeywords(TypedDict, total=False):
    """Further keywords of `map_run`; each but ``quiet`` is the field of `MapOptions`."""

    sequence: AnyPath
    excluded: tuple[str, ...]
    keep_excluded: bool
    voxel_m: float
    mesh_voxel_m: float
    source: str
    device: str
    pcd: bool
    keep_volume: bool
    quiet: bool


def run(
    sequence: AnyPath,
    out: AnyPath | None = None,
    *,
    segmenter: str | SegmenterOptions | None = None,
    config: SystemConfig | AnyPath | None = None,
    settings: Mapping[str, object] | None = None,
    **options: Unpack[RunKeywords],
) -> Run:
    """Run the system over a sequence, as ``bmask-slam run`` does, and return its run folder.

    Args:
        sequence: a recording in any layout of docs/data.md.
        out: the run folder; None: the first free ``runs/<sequence>[-<n>]``.
        segmenter: "light", "none", ..., or options; None: that of the configuration.
        config: a configuration, a YAML file, or the name of a shipped one, such as "paper".
        settings: values by dotted path that change ``config``, unless that is a `SystemConfig`.
        options: see `RunKeywords`; without ``quiet=False`` there is no progress bar.

    SIGINT and SIGTERM end the run after the current frame, and act as usual once it is saved.

    Raises:
        InputError: a broken sequence, a run folder that cannot be used, an unknown option, or one
            of the wrong type.
    """
    from bmask_slam.config.configuration import from_tree  # noqa: PLC0415
    from bmask_slam.offline import runner  # noqa: PLC0415 - loads GTSAM

    given = {"quiet": True, "sequence": sequence, "out": out, **options}
    resolved, name = _configuration(config, settings)
    if segmenter is not None:
        chosen = _segmenter_options(segmenter, resolved.semantics.segmenter)
        resolved = replace(resolved, semantics=replace(resolved.semantics, segmenter=chosen))
    checked = from_tree(runner.RunOptions, _plain(given, "run()"), "run()")
    summary = runner.run(replace(checked, config=resolved, config_name=name))
    if summary.stopped_by is not None:
        signal.raise_signal(summary.stopped_by)
    return Run(summary.folder)


def map_run(
    run: AnyPath,
    *,
    segmenter: str | SegmenterOptions | None = None,
    mesh: bool = False,
    plan: bool = False,
    **options: Unpack[MapKeywords],
) -> Run:
    """Make a dense map of a finished run, as ``bmask-slam map`` does, and return the run.

    Its ``dense_cloud`` and ``object_clouds`` are there then; keyframes that are finished are not
    done again.

    Args:
        run: a run folder or a `Run`.
        segmenter: "light", "none", ..., or options; None: that of the run.
        mesh: also write dense/mesh.ply and .glb. plan: also write dense/plan.png, a floor plan.
        options: see `MapKeywords`; without ``quiet=False`` there is no progress bar.

    Raises:
        InputError: the run, its sequence or the masks cannot be used, or an option is not known
            or of the wrong type.
    """
    from bmask_slam.config.configuration import from_tree  # noqa: PLC0415
    from bmask_slam.dense import map_run as dense  # noqa: PLC0415 - loads torch
    from bmask_slam.dense.options import MapOptions  # noqa: PLC0415
    from bmask_slam.runtime.progress import counting_bar  # noqa: PLC0415
    from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions  # noqa: PLC0415

    given: dict[str, Any] = {"run": run, "mesh": mesh, "plan": plan, **options}
    quiet = bool(given.pop("quiet", True))
    checked = from_tree(MapOptions, _plain(given, "map_run()"), "map_run()")
    if segmenter is not None:
        checked = replace(checked, masks=_segmenter_options(segmenter, SegmenterOptions()))
    with counting_bar(quiet) as progress:
        dense.map_run(checked, progress)
    return Run(run)


def merge_runs(*runs: AnyPath, out: AnyPath, overwrite: bool = False) -> Run:
    """Make one run of finished ones, as ``bmask-slam merge`` does, and return its run folder.

    Args:
        runs: run folders or `Run`, two or more; the world frame is that of the first.
        out: the run folder. overwrite: replace the run that it holds.

    Raises:
        InputError: runs that are not finished or do not fit together, a run that has no place in
            common with the others, or one that only looks alike.
    """
    from bmask_slam.merging import merge  # noqa: PLC0415 - loads GTSAM

    folders = tuple(Path(run) for run in runs)
    return Run(merge.merge_runs(merge.MergeOptions(folders, Path(out), overwrite)).folder)


def make_segmenter(
    segmenter: str | SegmenterOptions = "light", sequence: AnyPath = ""
) -> Segmenter:
    """Make what finds instances in images, for ``SlamSystem(camera, segmenter=...)``.

    Args:
        segmenter: "light", "none", ..., "module:Class", or options.
        sequence: folder of the images, which "truth" needs and "precomputed" names its masks by.

    Raises:
        InputError: an unknown name, or a file that is missing or does not fit.
    """
    from bmask_slam.datasets.weights import find_weights  # noqa: PLC0415
    from bmask_slam.semantics.segmenters import segmenter_table  # noqa: PLC0415
    from bmask_slam.semantics.segmenters.upright import Upright  # noqa: PLC0415

    options = _segmenter_options(segmenter, segmenter_table.SegmenterOptions())
    return segmenter_table.make_segmenter(options, Path(sequence), find_weights, Upright())


def _configuration(
    config: SystemConfig | AnyPath | None, settings: Mapping[str, object] | None
) -> tuple[SystemConfig, str]:
    """The resolved configuration, and its name for the run folder, "" if it has none."""
    from bmask_slam.config.configuration import find_config, resolve  # noqa: PLC0415
    from bmask_slam.system_config import SystemConfig  # noqa: PLC0415

    if isinstance(config, SystemConfig):
        if settings:
            raise InputError("settings beside a SystemConfig: change its fields instead")
        return config, ""
    file = None if config is None else find_config(os.fspath(config))
    given = {k: _plain_value(value, f"settings: {k}") for k, value in (settings or {}).items()}
    lines = [f"{path}={json.dumps(value)}" for path, value in given.items()]
    return resolve(SystemConfig, file, lines), file.stem if file else ""


def _segmenter_options(given: str | SegmenterOptions, base: SegmenterOptions) -> SegmenterOptions:
    from bmask_slam.semantics.segmenters import segmenter_table  # noqa: PLC0415

    if isinstance(given, str):
        return replace(base, name=segmenter_table.written(given))
    if not isinstance(given, segmenter_table.SegmenterOptions):
        raise InputError(
            f"segmenter: a {type(given).__name__}; give a name, 'module:Class' or SegmenterOptions "
            "(an object goes to SlamSystem)"
        )
    return given


def _plain(given: Mapping[str, Any], function: str) -> dict[str, Any]:
    """The keyword arguments of a function that are not None, as values of JSON. InputError."""
    return {
        name: _plain_value(value, f"{function}: {name}")
        for name, value in given.items()
        if value is not None
    }


def _plain_value(value: object, where: str) -> Any:
    """A value of JSON: a path, or a `Run`, as text, numbers of numpy as those of Python.

    Raises:
        InputError: an object of another kind, such as a `Camera`; ``where`` names the argument.
    """
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(key): _plain_value(item, where) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain_value(item, where) for item in value]
    if value is None or isinstance(value, (str, int, float)):
        return value
    raise InputError(f"{where}: a {type(value).__name__}; give a text, a number or a file")
