"""Dense mapping of a run: its keyframes fused one by one into submaps, after it or on the way."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from bmask_slam.datasets.weights import find_weights
from bmask_slam.dense.folder import DenseFolder
from bmask_slam.dense.fusion import FusionCounts, dense_config
from bmask_slam.dense.input import MappedRun, open_run
from bmask_slam.dense.keyframes import KeyframeWork, OpenMap
from bmask_slam.dense.options import MapOptions
from bmask_slam.graph.arrays import Mask
from bmask_slam.graph.errors import InputError
from bmask_slam.mapping.inverse_depth.dense_mapper import WINDOW, DepthSource
from bmask_slam.run_folder.map_file import run_semantics
from bmask_slam.semantics.beliefs.movability import read_priors
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.segmenters.segmenter import Segmenter
from bmask_slam.semantics.segmenters.segmenter_table import make_segmenter
from bmask_slam.sequences.right_images import RIGHT_LIST, read_right_images
from bmask_slam.world.world_map import Keyframe

Progress = Callable[[int, int], None]
LIKELY_MOVING = 0.5
METHOD = 3
"""Counts up when the same settings come to give other submaps."""


def open_map(options: MapOptions) -> OpenMap:
    """A finished run, what finds instances in its images, and the folder of its dense map.

    Raises:
        InputError: the run, its sequence or the masks cannot be used, or a class is not known.
    """
    run = open_run(options.run, options.sequence)
    masks = options.masks or run_semantics(options.run).segmenter
    segmenter = make_segmenter(masks, run.sequence.folder, find_weights)
    return assembled(run, segmenter, dataclasses.replace(options, masks=masks))


def assembled(run: MappedRun, segmenter: Segmenter, options: MapOptions) -> OpenMap:
    """The same for options in which ``masks`` are named already."""
    options = settled(options, segmenter.labels)
    run = _with_pairs(run, options.source)
    settings = folder_settings(options, segmenter.labels)
    if options.source != "sensor":
        settings["stereo_bf"] = None if run.right is None else run.camera.stereo_bf_px_m
    return OpenMap(run, segmenter, DenseFolder(run.path, settings), options)


def settled(options: MapOptions, labels: LabelSet) -> MapOptions:
    """The options with the classes that are left out, checked. Raises InputError."""
    if not 0.001 <= options.voxel_m <= 1:
        raise InputError(f"voxel {options.voxel_m} m: must be between 0.001 and 1")
    without = options.without
    if without is None:
        priors = read_priors("movability").of(labels)
        moving = np.flatnonzero(priors > LIKELY_MOVING).tolist()
        without = tuple(labels.names[k] for k in moving)
    for name in without:
        if labels.number(name) == 0:
            known = ", ".join(labels.names[1:]) or "none, give --segmenter or --masks"
            raise InputError(f"--without {name!r}: no such class; there are: {known}")
    return dataclasses.replace(options, without=without)


def _with_pairs(run: MappedRun, source: DepthSource) -> MappedRun:
    """The run with its right images and the bf of the pairs, if the source of depth uses them."""
    there = source == "both" and (run.sequence.folder / RIGHT_LIST).is_file()
    if source != "stereo" and not there:
        return run
    right = read_right_images(run.sequence, run.camera)
    return dataclasses.replace(run, camera=right.camera, right=right)


def folder_settings(options: MapOptions, labels: LabelSet) -> dict[str, Any]:
    """What a dense map is made with, as its folder keeps it; of ``settled`` options."""
    return {
        "method": METHOD,
        "run": _run_began(options.run),
        "voxel_m": options.voxel_m,
        "masks": None if options.masks is None else options.masks.described(),
        "source": options.source,
        "without": list(options.without or ()),
        "moving": options.moving,
        "labels": list(labels.names),
        "noise": dataclasses.asdict(dense_config(options).noise),
    }


def _run_began(run: Path) -> str:
    """When a run was begun, by its log: what an overwritten run left is of no use."""
    path = run / "log.txt"
    if not path.is_file():
        return ""
    with path.open(encoding="utf-8", errors="replace") as file:
        return file.readline().strip()


def fuse_run(opened: OpenMap, progress: Progress = lambda done, total: None) -> FusionCounts:
    """Fuse every keyframe that is not finished and save its submap.

    Keyframes that cannot be used are left out with a warning.

    Raises:
        InputError: no keyframe can be used, or the disk is full.
    """
    run, work = opened.run, KeyframeWork(opened)
    needed = _needed(run.keyframes, opened.folder)
    for k, keyframe in enumerate(run.keyframes):
        if needed[k]:
            work.take(keyframe)
        else:
            work.counts.reused += 1
        progress(k + 1, len(run.keyframes))
    work.finish()
    if not work.counts.fused + work.counts.reused:
        reason = next(iter(work.counts.left_out.values()), "it has none")
        raise InputError(f"{run.path}: no keyframe can be mapped; the first: {reason}")
    return work.counts


def _needed(keyframes: list[Keyframe], folder: DenseFolder) -> Mask:
    """Which keyframes (K,) must be read: the unfinished, and those in their windows."""
    unfinished = np.array([not folder.is_done(k.id) for k in keyframes], bool)
    near = np.convolve(unfinished, np.ones(2 * WINDOW + 1))[WINDOW : WINDOW + len(keyframes)]
    return np.asarray(near > 0.5)
