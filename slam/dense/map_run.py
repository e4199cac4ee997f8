"""A dense map of a run in one call, from keyframes to pictures."""

from __future__ import annotations

import json
import logging
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bmask_slam.datasets.weights import find_weights
from bmask_slam.dense.folder import FRAMES, DenseFolder, folder_settings
from bmask_slam.dense.keyframe_fusion import FusionCounts, KeyframeFusion
from bmask_slam.dense.keyframe_input import KeyframeSnapshot, image_name, load_keyframe
from bmask_slam.dense.options import MapOptions, resolve_options
from bmask_slam.dense.products import Products, write_products
from bmask_slam.dense.saved_map import MappedRun, open_run, with_right_images
from bmask_slam.dense.surface import FusedMap
from bmask_slam.graph.arrays import Mask
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.file_lock import lock_file
from bmask_slam.graph.files.whole_file import remove
from bmask_slam.labelling.upright_images import upright_of
from bmask_slam.mapping.inverse_depth.dense_mapper import WINDOW, DenseKeyframe
from bmask_slam.run_folder.frame_file import FRAMES as FRAME_TABLE
from bmask_slam.run_folder.map_file import run_semantics
from bmask_slam.runtime.memory import give_back_memory
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.semantics.segmenters.segmenter import Segmenter
from bmask_slam.semantics.segmenters.segmenter_table import make_segmenter
from bmask_slam.semantics.segmenters.upright import Upright
from bmask_slam.semantics.torch_threads import one_thread
from bmask_slam.sequences.prefetch import prefetched
from bmask_slam.world.keyframe import Keyframe

logger = logging.getLogger(__name__)

Progress = Callable[[int, int], None]
_Read = tuple[DenseKeyframe, KeyframeSnapshot, list[Instance]]
"""A keyframe's images, undistorted and as they were, and the instances in them."""


@dataclass(frozen=True, eq=False)
class MapSummary:
    """The result of mapping.

    Attributes:
        folder: RUN/dense.
        counts: of keyframes.
        products: files, points and labels.
        products_s: time that the products took.
    """

    folder: Path
    counts: FusionCounts
    products: Products
    products_s: float


def map_run(options: MapOptions, progress: Progress = lambda done, total: None) -> MapSummary:
    """Fuse the keyframes that are not finished, then write the products.

    Raises:
        InputError: the run, its sequence or the masks cannot be used, a class is not known, no
            keyframe can be used, or the disk is full.
    """
    fused, counts = _fused(options, progress)
    give_back_memory()
    started_s = time.perf_counter()
    products = write_products(fused, progress)
    summary = MapSummary(fused.folder.path, counts, products, time.perf_counter() - started_s)
    write_summary(fused.folder, summary)
    remove_stored_frames(options.run, fused.folder.path)
    return summary


def remove_stored_frames(run: Path, dense: Path) -> None:
    """Remove the frames that a killed live run had stored, unless a run is being written there."""
    if (run / FRAME_TABLE).is_file():
        try:
            with (run / FRAME_TABLE).open("rb") as file:
                lock_file(file, run)
        except InputError:
            return
    remove(dense / FRAMES)


def _fused(options: MapOptions, progress: Progress) -> tuple[FusedMap, FusionCounts]:
    """The fused keyframes; the segmenter's memory is free again."""
    fusion = open_fusion(options)
    counts = fusion.fuse_all(progress)
    return FusedMap(fusion.run, fusion.segmenter.labels, fusion.folder, fusion.options), counts


class RunFusion:
    """Fuses the keyframes of a run, oldest first.

    Attributes:
        run: the run and its sequence.
        segmenter: finds the instances in its images.
        folder: RUN/dense.
        options: resolved.
    """

    def __init__(self, run: MappedRun, segmenter: Segmenter, options: MapOptions) -> None:
        """Raises InputError: the options do not fit the run, or the folder cannot be written."""
        self.options = resolve_options(options, segmenter.labels)
        self.run = with_right_images(run, options.source)
        self.segmenter = segmenter
        stereo_bf_px_m = None if self.run.right is None else self.run.camera.stereo_bf_px_m
        settings = folder_settings(self.options, segmenter.labels, stereo_bf_px_m)
        self.folder = DenseFolder(run.path, settings)
        camera, labels = self.run.camera, segmenter.labels
        self._fusion = KeyframeFusion(camera, labels, self.folder, self.options)

    def _read(self, keyframe: Keyframe) -> _Read | InputError:
        """Its images and instances, or why it cannot be used."""
        try:
            dense, snapshot = load_keyframe(self.run, keyframe, self.options.source)
            name = image_name(self.run, keyframe)
            return dense, snapshot, self.segmenter.segment(snapshot.frame.rgb, name)
        except InputError as error:
            return error

    def _fuse(self, keyframe: Keyframe, read: _Read | InputError) -> None:
        if isinstance(read, InputError):
            logger.warning("%s; skipped", read)
            self._fusion.counts.skipped[keyframe.id] = str(read)
            return
        dense, snapshot, instances = read
        labelled = self._fusion.label_pixels(instances, snapshot.landmark_ids, snapshot.pixels)
        self._fusion.add(dense, snapshot.segment, labelled, self.run.poses())

    def fuse_all(self, progress: Progress = lambda done, total: None) -> FusionCounts:
        """Fuse every keyframe that is not finished and save it.

        A second thread reads keyframes ahead and finds their instances.

        Raises:
            InputError: no keyframe can be used, or the disk is full.
        """
        keyframes, counts, needed = self.run.keyframes, self._fusion.counts, self._needed()
        before = int((~needed).sum())
        counts.reused += before
        chosen = [k for k, wanted in zip(keyframes, needed, strict=True) if wanted]
        with one_thread():
            read = prefetched(map(self._read, chosen))
            for done, (keyframe, found) in enumerate(zip(chosen, read, strict=True), 1):
                self._fuse(keyframe, found)
                progress(before + done, len(keyframes))
            self._fusion.finish()
        if not counts.fused + counts.reused:
            reason = next(iter(counts.skipped.values()), "it has none")
            raise InputError(f"{self.run.path}: no keyframe can be mapped; the first: {reason}")
        return counts

    def _needed(self) -> Mask:
        """Which keyframes (K,) must be read: the unfinished ones and those in their windows.

        Where depth may come from a sweep, also those with which the latter are matched.
        """
        unfinished = np.array([not self.folder.is_done(k.id) for k in self.run.keyframes], bool)
        before = 2 * WINDOW if self.options.source in ("both", "motion") else WINDOW
        near = np.convolve(unfinished, np.ones(before + WINDOW + 1))[before:]
        return np.asarray(near[: len(unfinished)] > 0.5)


def open_fusion(options: MapOptions) -> RunFusion:
    """The fusion of a finished run. Raises InputError as ``map_run``."""
    run = open_run(options.run, options.sequence)
    masks = options.masks or run_semantics(options.run).segmenter
    upright = Upright(run.side) if run.side else upright_of(masks, run.sequence)
    segmenter = make_segmenter(masks, run.sequence.folder, find_weights, upright)
    return RunFusion(run, segmenter, replace(options, masks=masks))


def write_summary(folder: DenseFolder, summary: MapSummary) -> None:
    """Write dense.json."""
    counts, products = summary.counts, summary.products
    values = {
        "keyframes_fused": counts.fused,
        "keyframes_reused": counts.reused,
        "keyframes_left_out": counts.skipped,
        "fuse_ms_median": float(np.median(counts.fuse_ms)) if counts.fuse_ms else None,
        "points": products.points,
        "label_shares": products.label_shares,
        "products_s": round(summary.products_s, 3),
    }
    folder.write_text("dense.json", json.dumps(values, indent=1) + "\n")


def format_summary(summary: MapSummary) -> str:
    """A few lines for the command line."""
    counts, products = summary.counts, summary.products
    lines = [f"keyframes   {counts.fused} fused, {counts.reused} were finished"]
    if counts.skipped:
        lines[0] += f", {len(counts.skipped)} left out"
    if counts.fuse_ms:
        lines.append(f"fusion      {np.median(counts.fuse_ms):.0f} ms a keyframe (median)")
    lines.append(f"points      {products.points}")
    shares = sorted(products.label_shares.items(), key=lambda item: -item[1])
    if len(shares) > 1:
        lines.append("labels      " + ", ".join(f"{n} {100 * s:.1f} %" for n, s in shares[:8]))
    folders = Counter(path.parent for path in products.files)
    names = [path.name for path in products.files if path.parent == summary.folder]
    names += [f"{p.name}/ ({n} files)" for p, n in folders.items() if p != summary.folder]
    lines.append(f"products    {', '.join(names)}")
    return "\n".join([*lines, f"Folder      {summary.folder}"])
