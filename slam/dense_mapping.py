"""Dense mapping of a finished run: its keyframes fused one by one into submaps."""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graph.errors import InputError
from mapping.dense import (
    WINDOW,
    DenseConfig,
    DenseKeyframe,
    DenseMapper,
    DepthSource,
    FusedKeyframe,
)
from mapping.inverse_depth import DepthNoise
from mapping.labels import keyframe_labels, widened
from mapping.submaps import make_submap
from semantics.segmenter import NoSegmenter, Segmenter
from semantics.segmenter_table import SegmenterOptions, make_segmenter
from slam.configuration import resolve
from slam.dense_folder import DenseFolder
from slam.dense_input import MappedRun, image_name, load, open_run, undistorted_labels
from slam.features import FeatureConfig
from slam.world_map import Keyframe

logger = logging.getLogger(__name__)

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class MapOptions:
    """What is mapped, and how.

    Attributes:
        run: folder of a finished run.
        sequence: its images, if they have moved.
        masks: what finds the instances, None for no labels.
        without: classes that are left out of the map, since they move.
        voxel_m: at most one point in a cube of this edge.
        source: where depth comes from, see `mapping.dense.DenseConfig`.
        device: torch's name of where depth is fused.
        mesh, plan: whether to make them.
    """

    run: Path
    sequence: Path | None = None
    masks: SegmenterOptions | None = None
    without: tuple[str, ...] = ()
    voxel_m: float = 0.01
    source: DepthSource = "sensor"
    device: str = "cpu"
    mesh: bool = False
    plan: bool = False


@dataclass(eq=False)
class FusionCounts:
    """What became of the keyframes.

    Attributes:
        fused: in this call.
        reused: finished before.
        left_out: by id, why.
        fuse_ms: of each that was fused, Steps 1 to 6 without reading and writing files.
    """

    fused: int = 0
    reused: int = 0
    left_out: dict[int, str] = field(default_factory=dict)
    fuse_ms: list[float] = field(default_factory=list)


def open_map(options: MapOptions) -> tuple[MappedRun, Segmenter, DenseFolder]:
    """The run, what finds instances in its images, and the folder of its dense map.

    Raises:
        InputError: the run, its sequence or the masks cannot be used, or a class is not known.
    """
    if not 0.001 <= options.voxel_m <= 1:
        raise InputError(f"voxel {options.voxel_m} m: must be between 0.001 and 1")
    run = open_run(options.run, options.sequence)
    segmenter: Segmenter = NoSegmenter()
    if options.masks is not None:
        segmenter = make_segmenter(options.masks, run.sequence.folder)
    for name in options.without:
        if segmenter.labels.number(name) == 0:
            known = ", ".join(segmenter.labels.names[1:]) or "none, give --masks"
            raise InputError(f"--without {name!r}: no such class; there are: {known}")
    return run, segmenter, DenseFolder(options.run, _settings(options, segmenter))


def _settings(options: MapOptions, segmenter: Segmenter) -> dict[str, Any]:
    masks = None if options.masks is None else options.masks.described()
    return {
        "voxel_m": options.voxel_m,
        "masks": masks,
        "source": options.source,
        "without": list(options.without),
        "labels": list(segmenter.labels.names),
        "noise": dataclasses.asdict(dense_config(options).noise),
    }


def dense_config(options: MapOptions) -> DenseConfig:
    """The configuration of the fusion, with the run's own model of its depth sensor."""
    features = resolve(FeatureConfig, options.run / "config.yaml", section="features")
    noise = DepthNoise(
        disparity_sigma_px=features.disparity_sigma_px, max_depth_m=features.max_depth_m
    )
    return DenseConfig(noise=noise, source=options.source, device=options.device)


def fuse_run(
    source: tuple[MappedRun, Segmenter],
    folder: DenseFolder,
    options: MapOptions,
    progress: Progress = lambda done, total: None,
) -> FusionCounts:
    """Fuse every keyframe that is not finished and save its submap.

    Keyframes that cannot be used are left out with a warning.

    Raises:
        InputError: no keyframe can be used, or the disk is full.
    """
    run, segmenter = source
    mapper = DenseMapper(run.camera, dense_config(options))
    work = _Work(mapper, segmenter, folder, options)
    needed = _needed(run.keyframes, folder)
    for k, keyframe in enumerate(run.keyframes):
        if needed[k]:
            work.take(run, keyframe)
        else:
            work.counts.reused += 1
        progress(k + 1, len(run.keyframes))
    work.finish()
    if not work.counts.fused + work.counts.reused:
        reason = next(iter(work.counts.left_out.values()), "it has none")
        raise InputError(f"{run.path}: no keyframe can be mapped; the first: {reason}")
    return work.counts


def _needed(keyframes: list[Keyframe], folder: DenseFolder) -> NDArray[np.bool_]:
    """Which keyframes (K,) must be read: the unfinished, and those in their windows."""
    unfinished = np.array([not folder.is_done(k.id) for k in keyframes], bool)
    near = np.convolve(unfinished, np.ones(2 * WINDOW + 1))[WINDOW : WINDOW + len(keyframes)]
    return np.asarray(near > 0.5)


class _Work:
    """One pass over the keyframes."""

    def __init__(
        self, mapper: DenseMapper, segmenter: Segmenter, folder: DenseFolder, options: MapOptions
    ) -> None:
        self.counts = FusionCounts()
        self._mapper, self._segmenter = mapper, segmenter
        self._folder, self._options = folder, options
        self._likelihoods: dict[int, NDArray[np.float32]] = {}
        self._moving = {segmenter.labels.number(name) for name in options.without}

    def take(self, run: MappedRun, keyframe: Keyframe) -> None:
        """Read a keyframe and save what its arrival finishes."""
        try:
            dense = self._labelled(run, keyframe)
        except InputError as error:
            logger.warning("%s; left out", error)
            self.counts.left_out[keyframe.id] = str(error)
            return
        wanted = not self._folder.is_done(keyframe.id)
        self.counts.reused += not wanted
        started_s = time.perf_counter()
        finished = self._mapper.push(dense, wanted)
        self._save(finished, started_s)

    def finish(self) -> None:
        """Save what still waits."""
        started_s = time.perf_counter()
        self._save(self._mapper.flush(), started_s)

    def _labelled(self, run: MappedRun, keyframe: Keyframe) -> DenseKeyframe:
        """The keyframe with its instances, without the depth of moving ones."""
        dense, rgb = load(run, keyframe, self._options.source != "motion")
        name = image_name(run, keyframe)
        instances = self._segmenter.segment(rgb, name)
        labels = keyframe_labels(instances, rgb.shape[:2], len(self._segmenter.labels))
        self._likelihoods[keyframe.id] = labels.log_likelihoods
        numbers = undistorted_labels(labels.numbers, run.camera)
        moving = [k for k, found in enumerate(instances, 1) if found.label in self._moving]
        depth_m = np.where(widened(numbers, moving), np.float32(np.nan), dense.depth_m)
        return dataclasses.replace(dense, instances=numbers, depth_m=depth_m)

    def _save(self, finished: list[FusedKeyframe], started_s: float) -> None:
        submaps = [make_submap(r, self._mapper.camera, self._options.voxel_m) for r in finished]
        elapsed_ms = 1e3 * (time.perf_counter() - started_s)
        for result, submap in zip(finished, submaps, strict=True):
            self._folder.write(submap, result.map, self._likelihoods[submap.anchor])
            self.counts.fused += 1
            self.counts.fuse_ms.append(elapsed_ms / len(finished))
        for keyframe_id in [i for i in self._likelihoods if self._folder.is_done(i)]:
            del self._likelihoods[keyframe_id]
