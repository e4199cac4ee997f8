"""Fusion of keyframes and their masks, one after the other, into the folder of a dense map."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from bmask_slam.dense.folder import DenseFolder
from bmask_slam.dense.keyframe_input import undistort_labels
from bmask_slam.dense.options import MapOptions, fusion_config
from bmask_slam.graph.arrays import Array, Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.mapping.inverse_depth.dense_mapper import DenseKeyframe, DenseMapper, FusedKeyframe
from bmask_slam.mapping.inverse_depth.depth_map import from_sensor
from bmask_slam.mapping.products.submaps import make_submap
from bmask_slam.mapping.products.surface_labels import InstanceEvidence, dilate, keyframe_labels
from bmask_slam.run_folder.map_file import run_semantics
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.semantics.instances.surfaces import Segmented, surfaces_of
from bmask_slam.semantics.labels import LabelSet


@dataclass(eq=False)
class FusionCounts:
    """What happened to the keyframes.

    Attributes:
        fused: number of keyframes that were fused.
        reused: number of keyframes that were finished before.
        skipped: keyframes that could not be used, by id, with the reason.
        fuse_ms: time of Steps 1 to 5 for each fused keyframe, without reading and writing files.
    """

    fused: int = 0
    reused: int = 0
    skipped: dict[int, str] = field(default_factory=dict)
    fuse_ms: list[float] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class KeyframeInstances:
    """The instances in a keyframe's image.

    Attributes:
        numbers: (H, W) uint16, the instance at each undistorted pixel, from 1; 0 for none.
        excluded: (H, W) pixels of instances whose classes are excluded from the map.
        evidence: about the classes of the instances.
    """

    numbers: NDArray[np.uint16]
    excluded: Mask
    evidence: InstanceEvidence


class KeyframeFusion:
    """Fuses keyframes and saves each when its neighbours have come.

    Attributes:
        counts: what happened to the keyframes.
    """

    def __init__(
        self, camera: Camera, labels: LabelSet, folder: DenseFolder, options: MapOptions
    ) -> None:
        """``options`` are resolved."""
        self.counts = FusionCounts()
        self._camera, self._folder, self._options = camera, folder, options
        self._classes = len(labels)
        self._excluded = [labels.number(name) for name in options.excluded or ()]
        self._semantics = run_semantics(options.run)
        self._mapper = DenseMapper(camera, fusion_config(options))
        self._evidence: dict[int, InstanceEvidence] = {}
        self._segment: int | None = None

    def label_pixels(
        self, instances: Sequence[Instance], landmark_ids: Ints, pixels: Array
    ) -> KeyframeInstances:
        """The instances of an image, and the landmarks (L,) on them.

        ``pixels`` (L, 2) are where the landmarks were detected; like the masks they are distorted.
        Instances with a class score below the run's ``sure_score`` do not count.
        """
        strong = [i for i in instances if i.class_score >= self._semantics.sure_score]
        instances = Segmented(strong, surfaces_of(instances))
        shape = self._camera.height, self._camera.width
        labels = keyframe_labels(instances, shape, self._classes, self._semantics.labels)
        columns, lines = np.rint(pixels).astype(np.int64).T
        on = labels.numbers[lines.clip(0, shape[0] - 1), columns.clip(0, shape[1] - 1)]
        known = (on > 0) & (on <= len(instances))
        observed, stuff = (landmark_ids[known], on[known]), labels.stuff
        numbers = undistort_labels(labels.numbers, self._camera)
        evidence = InstanceEvidence(
            labels.log_likelihoods, *observed, stuff.log_p, stuff.names, numbers
        )
        excluded = [k for k, found in enumerate(instances, 1) if found.label in self._excluded]
        return KeyframeInstances(numbers, np.isin(numbers, excluded), evidence)

    def add(
        self,
        keyframe: DenseKeyframe,
        segment: int,
        instances: KeyframeInstances,
        poses: Mapping[int, Array],
    ) -> list[FusedKeyframe]:
        """Add a keyframe; those that this completes are saved and returned.

        Keyframes of different map segments have no frame in common and are not fused.
        ``poses`` are the current T_world_camera (4, 4) of keyframes by id.

        Raises:
            InputError: the disk is full.
        """
        completed = self.finish() if segment != self._segment else []
        self._segment = segment
        excluded = instances.excluded
        to_fuse = not self._folder.is_done(keyframe.id)
        self.counts.reused += not to_fuse
        keyframe = replace(keyframe, instances=instances.numbers)
        if to_fuse:
            self._evidence[keyframe.id] = instances.evidence
            if self._options.keep_excluded and excluded.any():
                self._save_excluded(keyframe, excluded)
        hidden = dilate(excluded)
        depth_m = np.where(hidden, np.float32(np.nan), keyframe.depth_m)
        keyframe = replace(keyframe, depth_m=depth_m, unmatched=hidden)
        self._mapper.update_poses(poses)
        started_s = time.perf_counter()
        return completed + self._save(self._mapper.add(keyframe, to_fuse), started_s)

    def update_poses(self, poses: Mapping[int, Array]) -> None:
        """Replace the poses of waiting keyframes by T_world_camera (4, 4), by id."""
        self._mapper.update_poses(poses)

    def relabel(self, keyframe_id: int, instances: KeyframeInstances) -> None:
        """Replace the instances of a keyframe whose masks came late, whether it waits or is saved.

        Keyframes that are fused after that get nothing from what it hides.

        Raises:
            InputError: the disk is full.
        """
        numbers, hidden = instances.numbers, dilate(instances.excluded)
        evidence = instances.evidence
        if self._folder.is_done(keyframe_id):
            self._folder.relabel(keyframe_id, hidden, evidence)
        elif keyframe_id in self._evidence:
            self._evidence[keyframe_id] = evidence
        self._mapper.relabel(keyframe_id, numbers, hidden)

    def remove(self, keyframe_ids: Collection[int]) -> None:
        """Remove keyframes that left the map, with what was saved of them."""
        self._mapper.remove(keyframe_ids)
        for number in keyframe_ids:
            self._evidence.pop(number, None)
            self._folder.remove(number)

    def finish(self) -> list[FusedKeyframe]:
        """Fuse and save the keyframes that still wait. Raises InputError if the disk is full."""
        started_s = time.perf_counter()
        return self._save(self._mapper.flush(), started_s)

    def _save_excluded(self, keyframe: DenseKeyframe, excluded: Mask) -> None:
        """Save the excluded pixels of a keyframe as the sensor measured them, not fused."""
        depth_m = np.where(excluded, keyframe.depth_m, np.float32(np.nan))
        measured = from_sensor(depth_m, self._mapper.camera, self._mapper.config.measurement)
        points = FusedKeyframe(keyframe, measured, excluded.astype(np.uint8))
        self._folder.write_excluded(make_submap(points, self._camera, self._options.voxel_m))

    def _save(self, finished: list[FusedKeyframe], started_s: float) -> list[FusedKeyframe]:
        elapsed_ms = 1e3 * (time.perf_counter() - started_s)
        for result in finished:
            self._folder.write(result, self._evidence.pop(result.keyframe.id))
            self.counts.fused += 1
            self.counts.fuse_ms.append(elapsed_ms / len(finished))
        return finished
