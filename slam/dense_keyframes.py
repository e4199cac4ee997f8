"""One keyframe after the other through the fusion into the folder of the dense map."""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graph.errors import InputError
from mapping.dense import DenseConfig, DenseKeyframe, DenseMapper, FusedKeyframe
from mapping.inverse_depth import DepthNoise, from_sensor
from mapping.labels import InstanceEvidence, KeyframeLabels, keyframe_labels, widened
from mapping.submaps import make_submap
from semantics.segmenter import Segmenter
from slam.configuration import resolve
from slam.dense_folder import DenseFolder
from slam.dense_input import MappedRun, image_name, load, undistorted_labels
from slam.dense_options import MapOptions
from slam.features import FeatureConfig
from slam.world_map import Keyframe

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class OpenMap:
    """A dense map that is being made.

    Attributes:
        run: what of.
        segmenter: finds instances in its images.
        folder: where it goes.
        options: as given, what they left open filled in.
    """

    run: MappedRun
    segmenter: Segmenter
    folder: DenseFolder
    options: MapOptions


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


def dense_config(options: MapOptions) -> DenseConfig:
    """The configuration of the fusion, with the run's own model of its depth sensor."""
    features = resolve(FeatureConfig, options.run / "config.yaml", section="features")
    noise = DepthNoise(
        disparity_sigma_px=features.disparity_sigma_px, max_depth_m=features.max_depth_m
    )
    return DenseConfig(noise=noise, source=options.source, device=options.device)


class KeyframeWork:
    """One pass over the keyframes of a map, oldest first."""

    def __init__(self, opened: OpenMap) -> None:
        self.counts = FusionCounts()
        self._opened = opened
        self._mapper = DenseMapper(opened.run.camera, dense_config(opened.options))
        self._evidence: dict[int, InstanceEvidence] = {}
        number = opened.segmenter.labels.number
        self._moving = {number(name) for name in opened.options.without or ()}
        self._segment: int | None = None

    def take(self, keyframe: Keyframe) -> None:
        """Read a keyframe and save what its arrival finishes; leave out one that is broken.

        Keyframes of different map segments have no frame in common and are not fused.

        Raises:
            InputError: the disk is full.
        """
        if keyframe.segment != self._segment:
            self.finish()
            self._segment = keyframe.segment
        try:
            dense, moving = self._labelled(keyframe)
        except InputError as error:
            logger.warning("%s; left out", error)
            self.counts.left_out[keyframe.id] = str(error)
            return
        folder, options = self._opened.folder, self._opened.options
        wanted = not folder.is_done(keyframe.id)
        self.counts.reused += not wanted
        if wanted and options.moving and moving.any():
            folder.write_moving(
                make_submap(self._unfused(dense, moving), self._mapper.camera, options.voxel_m)
            )
        moves = widened(moving)
        still_m = np.where(moves, np.float32(np.nan), dense.depth_m)
        still = dataclasses.replace(dense, depth_m=still_m, unmatched=moves)
        self._mapper.move(self._opened.run.poses())
        started_s = time.perf_counter()
        finished = self._mapper.push(still, wanted)
        self._save(finished, started_s)

    def finish(self) -> None:
        """Save what still waits. Raises InputError if the disk is full."""
        started_s = time.perf_counter()
        self._save(self._mapper.flush(), started_s)

    def _labelled(self, keyframe: Keyframe) -> tuple[DenseKeyframe, NDArray[np.bool_]]:
        """The keyframe with its instances, and where moving ones are (H, W)."""
        run, segmenter = self._opened.run, self._opened.segmenter
        dense, rgb = load(run, keyframe, self._opened.options.source)
        instances = segmenter.segment(rgb, image_name(run, keyframe))
        labels = keyframe_labels(instances, rgb.shape[:2], len(segmenter.labels))
        self._evidence[keyframe.id] = _evidence(run, keyframe, labels)
        numbers = undistorted_labels(labels.numbers, run.camera)
        moving = [k for k, found in enumerate(instances, 1) if found.label in self._moving]
        return dataclasses.replace(dense, instances=numbers), np.isin(numbers, moving)

    def _unfused(self, dense: DenseKeyframe, where: NDArray[np.bool_]) -> FusedKeyframe:
        """What the sensor alone says of some pixels."""
        depth_m = np.where(where, dense.depth_m, np.float32(np.nan))
        measured = from_sensor(depth_m, self._mapper.camera, self._mapper.config.noise)
        return FusedKeyframe(dense, measured, where.astype(np.uint8))

    def _save(self, finished: Sequence[FusedKeyframe], started_s: float) -> None:
        voxel_m, folder = self._opened.options.voxel_m, self._opened.folder
        submaps = [make_submap(r, self._mapper.camera, voxel_m) for r in finished]
        elapsed_ms = 1e3 * (time.perf_counter() - started_s)
        for result, submap in zip(finished, submaps, strict=True):
            folder.write(submap, result.map, self._evidence[submap.anchor])
            self.counts.fused += 1
            self.counts.fuse_ms.append(elapsed_ms / len(finished))
        for keyframe_id in [i for i in self._evidence if folder.is_done(i)]:
            del self._evidence[keyframe_id]


def _evidence(run: MappedRun, keyframe: Keyframe, labels: KeyframeLabels) -> InstanceEvidence:
    """What the masks say, and the landmarks on them."""
    rows, ids = run.world.observed(keyframe)
    columns, lines = np.rint(keyframe.features.image_pixels[rows]).astype(np.int64).T
    height, width = labels.numbers.shape
    numbers = labels.numbers[lines.clip(0, height - 1), columns.clip(0, width - 1)]
    return InstanceEvidence(labels.log_likelihoods, ids[numbers > 0], numbers[numbers > 0])


def run_began(run: Path) -> str:
    """When a run was begun, by its log: what an overwritten run left is of no use."""
    path = run / "log.txt"
    if not path.is_file():
        return ""
    with path.open(encoding="utf-8", errors="replace") as file:
        return file.readline().strip()
