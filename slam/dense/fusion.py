"""Keyframes and their masks through the fusion into the folder of a dense map."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from bmask_slam.config.configuration import resolve
from bmask_slam.dense.folder import DenseFolder
from bmask_slam.dense.input import undistorted_labels
from bmask_slam.dense.options import MapOptions
from bmask_slam.features.brisk import FeatureConfig
from bmask_slam.graph.arrays import Array, Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.mapping.inverse_depth.dense_mapper import (
    DenseConfig,
    DenseKeyframe,
    DenseMapper,
    FusedKeyframe,
)
from bmask_slam.mapping.inverse_depth.depth_map import DepthNoise, from_sensor
from bmask_slam.mapping.products.submaps import Submap, make_submap
from bmask_slam.mapping.products.surface_labels import InstanceEvidence, keyframe_labels, widened
from bmask_slam.run_folder.map_file import run_semantics
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.semantics.labels import LabelSet


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


@dataclass(frozen=True, eq=False)
class ShownInstances:
    """What a keyframe's masks say.

    Attributes:
        numbers: (H, W) uint16, the instance of each undistorted pixel, from 1; 0 for none.
        moving: (H, W) pixels of instances that are left out of the map, since they move.
        evidence: of the classes of the instances.
    """

    numbers: NDArray[np.uint16]
    moving: Mask
    evidence: InstanceEvidence


def dense_config(options: MapOptions) -> DenseConfig:
    """The configuration of the fusion, with the run's own model of its depth sensor."""
    features = resolve(FeatureConfig, options.run / "config.yaml", section="features")
    noise = DepthNoise(
        disparity_sigma_px=features.disparity_sigma_px, max_depth_m=features.max_depth_m
    )
    return DenseConfig(noise=noise, source=options.source, device=options.device)


class KeyframeFusion:
    """Takes keyframes in and saves each one's submap once its neighbours came.

    Attributes:
        counts: what became of them.
    """

    def __init__(
        self, camera: Camera, labels: LabelSet, folder: DenseFolder, options: MapOptions
    ) -> None:
        """For options that name the classes that are left out."""
        self.counts = FusionCounts()
        self._camera, self._folder, self._options = camera, folder, options
        self._classes = len(labels)
        self._moving = [labels.number(name) for name in options.without or ()]
        self._semantics = run_semantics(options.run)
        self._mapper = DenseMapper(camera, dense_config(options))
        self._evidence: dict[int, InstanceEvidence] = {}
        self._segment: int | None = None

    def read(
        self, instances: Sequence[Instance], landmark_ids: Ints, pixels: Array
    ) -> ShownInstances:
        """The instances of an image as it was taken, and which landmarks (L,) are on them.

        ``pixels`` (L, 2) are where those were detected. An instance that the run would make no
        object of, since its class score is too low, does not count.
        """
        instances = [i for i in instances if i.class_score >= self._semantics.object_score]
        shape = self._camera.height, self._camera.width
        labels = keyframe_labels(instances, shape, self._classes, self._semantics.labels)
        columns, lines = np.rint(pixels).astype(np.int64).T
        on = labels.numbers[lines.clip(0, shape[0] - 1), columns.clip(0, shape[1] - 1)]
        evidence = InstanceEvidence(labels.log_likelihoods, landmark_ids[on > 0], on[on > 0])
        numbers = undistorted_labels(labels.numbers, self._camera)
        moving = [k for k, found in enumerate(instances, 1) if found.label in self._moving]
        return ShownInstances(numbers, np.isin(numbers, moving), evidence)

    def take(
        self, dense: DenseKeyframe, segment: int, shown: ShownInstances, poses: Mapping[int, Array]
    ) -> list[Submap]:
        """Take a keyframe in; what its arrival finishes, saved.

        Keyframes of different map segments have no frame in common and are not fused.
        ``poses`` are the T_world_camera (4, 4) of keyframes by id as they are at this moment.

        Raises:
            InputError: the disk is full.
        """
        before = self.finish() if segment != self._segment else []
        self._segment = segment
        folder, moving = self._folder, shown.moving
        wanted = not folder.is_done(dense.id)
        self.counts.reused += not wanted
        if wanted:
            self._evidence[dense.id] = shown.evidence
        dense = replace(dense, instances=shown.numbers)
        if wanted and self._options.moving and moving.any():
            apart = self._unfused(dense, moving)
            folder.write_moving(make_submap(apart, self._mapper.camera, self._options.voxel_m))
        moves = widened(moving)
        still_m = np.where(moves, np.float32(np.nan), dense.depth_m)
        still = replace(dense, depth_m=still_m, unmatched=moves)
        self._mapper.move(poses)
        started_s = time.perf_counter()
        return before + self._save(self._mapper.push(still, wanted), started_s)

    def move(self, poses: Mapping[int, Array]) -> None:
        """Take over the poses of keyframes that wait, as optimised since."""
        self._mapper.move(poses)

    def relabel(self, keyframe_id: int, shown: ShownInstances) -> None:
        """Take over a keyframe's masks that come late, whether it waits or is saved.

        Raises:
            InputError: the disk is full.
        """
        moves = widened(shown.moving)
        if self._folder.is_done(keyframe_id):
            about = (shown.numbers, moves)
            self._folder.relabel(keyframe_id, self._mapper.camera, about, shown.evidence)
        elif keyframe_id in self._evidence:
            self._evidence[keyframe_id] = shown.evidence
            self._mapper.relabel(keyframe_id, shown.numbers, moves)

    def forget(self, keyframe_ids: Collection[int]) -> None:
        """Keyframes left the map: so do their submaps."""
        self._mapper.forget(keyframe_ids)
        for number in keyframe_ids:
            self._evidence.pop(number, None)
            self._folder.remove(number)

    def finish(self) -> list[Submap]:
        """Save what still waits. Raises InputError if the disk is full."""
        started_s = time.perf_counter()
        return self._save(self._mapper.flush(), started_s)

    def _unfused(self, dense: DenseKeyframe, where: Mask) -> FusedKeyframe:
        """What the sensor alone says of some pixels."""
        depth_m = np.where(where, dense.depth_m, np.float32(np.nan))
        measured = from_sensor(depth_m, self._mapper.camera, self._mapper.config.noise)
        return FusedKeyframe(dense, measured, where.astype(np.uint8))

    def _save(self, finished: Sequence[FusedKeyframe], started_s: float) -> list[Submap]:
        voxel_m, folder = self._options.voxel_m, self._folder
        submaps = [make_submap(r, self._mapper.camera, voxel_m) for r in finished]
        elapsed_ms = 1e3 * (time.perf_counter() - started_s)
        for result, submap in zip(finished, submaps, strict=True):
            folder.write(submap, result.map, self._evidence.pop(submap.anchor))
            self.counts.fused += 1
            self.counts.fuse_ms.append(elapsed_ms / len(finished))
        return submaps
