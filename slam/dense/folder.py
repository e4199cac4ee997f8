"""The folder RUN/dense: finished keyframes of a dense map, and what they were made with.

==================  ==============================================================================
settings.json       what the keyframes were fused with; another setting begins anew
depth/ID            fused inverse depth and its sigma, quantised
labels/ID           log likelihoods of the keyframe's instances, one row each, and landmarks on them
submaps/ID          its points; written last, so that a keyframe that has one is finished
cloud.ply, .pcd     the cloud, with normals, label, probability and sigma of each point
semantic.ply, .pcd  the same in the colours of the labels
objects/ID-CLASS    a cloud of each object of the run
moving/ID, .ply     what moves, if it is kept: points of each keyframe, and all of them
mesh.ply            the mesh
plan.png            the map from above
view_*.png          pictures of cloud and mesh
dense.json          counts and times
==================  ==============================================================================
"""

from __future__ import annotations

import json
import logging
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.array_file import FileKind, read_arrays, write_arrays
from bmask_slam.graph.whole_file import whole_file
from bmask_slam.mapping.inverse_depth.depth_files import read_fused, write_fused
from bmask_slam.mapping.inverse_depth.depth_map import InverseDepthMap
from bmask_slam.mapping.products.submaps import Submap, read_submap, relabelled, write_submap
from bmask_slam.mapping.products.surface_labels import InstanceEvidence
from bmask_slam.runtime.memory import give_back_memory

logger = logging.getLogger(__name__)

LABEL_FILE = FileKind("keyframe labels", 2)
PARTS = ("depth", "labels", "moving", "submaps")


class DenseFolder:
    """RUN/dense, opened for settings that are a dictionary of JSON values."""

    def __init__(self, run: Path, settings: dict[str, Any]) -> None:
        """Make the folder, or keep what it holds of the same settings.

        Raises:
            InputError: it cannot be written.
        """
        self.path = run / "dense"
        try:
            self.path.mkdir(exist_ok=True)
            self._clear_unless(settings)
            for name in PARTS:
                (self.path / name).mkdir(exist_ok=True)
            self.write_text("settings.json", json.dumps(settings, indent=1, sort_keys=True) + "\n")
        except OSError as error:
            raise InputError(
                f"{self.path}: cannot be written ({error.strerror}); free some space"
            ) from error

    @classmethod
    def opened(cls, run: Path) -> DenseFolder:
        """The dense map of a run, as it is. Raises InputError if there is none."""
        path = run / "dense" / "settings.json"
        if not path.is_file():
            raise InputError(f"{path}: no dense map here; make it with bmask-slam map {run}")
        return cls(run, json.loads(path.read_text(encoding="utf-8")))

    def _clear_unless(self, settings: dict[str, Any]) -> None:
        """Remove keyframes that were made with other settings."""
        path = self.path / "settings.json"
        before = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None
        if before == json.loads(json.dumps(settings)):
            return
        if before is not None:
            logger.warning("%s: was made with other settings; begun anew", self.path)
        path.unlink(missing_ok=True)
        for name in PARTS:
            shutil.rmtree(self.path / name, ignore_errors=True)

    def is_done(self, keyframe_id: int) -> bool:
        """Whether the keyframe is finished."""
        return self._file("submaps", keyframe_id).is_file()

    def write(self, submap: Submap, fused: InverseDepthMap, evidence: InstanceEvidence) -> None:
        """Save a finished keyframe. Raises InputError, with nothing half written, if it cannot."""
        write_fused(self._file("depth", submap.anchor), fused)
        write_arrays(self._file("labels", submap.anchor), LABEL_FILE, {}, vars(evidence))
        write_submap(self._file("submaps", submap.anchor), submap)
        give_back_memory()

    def relabel(
        self,
        keyframe_id: int,
        camera: Camera,
        shown: tuple[NDArray[np.uint16], Mask],
        evidence: InstanceEvidence,
    ) -> None:
        """Give a finished keyframe its instances (H, W), without what moves in it (H, W).

        Raises:
            InputError: it cannot be written; what was there stays.
        """
        instances, moves = shown
        told = relabelled(self.submap(keyframe_id), camera, instances, moves)
        if moves.any():
            still = self.fused(keyframe_id).without(moves)
            write_fused(self._file("depth", keyframe_id), still)
        write_arrays(self._file("labels", keyframe_id), LABEL_FILE, {}, vars(evidence))
        write_submap(self._file("submaps", keyframe_id), told)

    def remove(self, keyframe_id: int) -> None:
        """Without a keyframe, whatever is there of it; its submap goes first."""
        for kind in reversed(PARTS):
            self._file(kind, keyframe_id).unlink(missing_ok=True)

    def write_moving(self, submap: Submap) -> None:
        """Save what moves in a keyframe. Raises InputError if it cannot."""
        write_submap(self._file("moving", submap.anchor), submap)

    def moving(self, keyframe_id: int) -> Submap | None:
        """What moves in a keyframe, if that was kept."""
        path = self._file("moving", keyframe_id)
        return read_submap(path) if path.is_file() else None

    def submap(self, keyframe_id: int) -> Submap:
        """The points of a finished keyframe."""
        return read_submap(self._file("submaps", keyframe_id))

    def evidence(self, keyframe_id: int) -> InstanceEvidence:
        """What its masks say of its instances, and the landmarks on them."""
        arrays = read_arrays(self._file("labels", keyframe_id), LABEL_FILE)[1]
        return InstanceEvidence(
            np.asarray(arrays["log_likelihoods"], np.float32),
            np.asarray(arrays["landmark_ids"], np.int64),
            np.asarray(arrays["landmark_instances"], np.uint16),
        )

    def fused(self, keyframe_id: int) -> InverseDepthMap:
        """The inverse depth of a finished keyframe."""
        return read_fused(self._file("depth", keyframe_id))

    def write_text(self, name: str, text: str) -> None:
        """Replace a text file."""
        with whole_file(self.path / name) as temporary:
            temporary.write_text(text, encoding="utf-8")

    def _file(self, kind: str, keyframe_id: int) -> Path:
        return self.path / kind / f"{keyframe_id:06d}"
