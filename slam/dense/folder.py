"""The folder RUN/dense: finished keyframes of a dense map, and the settings they were made with.

==================  ==============================================================================
settings.json       how the keyframes were fused; other settings start a new map
depth/ID            fused inverse depth and its sigma, quantised
colours/ID.jpg      its undistorted colours
labels/ID           log likelihoods of its instances, one row each, landmarks on them, and
                    the instance of each pixel; written last: a keyframe that has it is finished
cloud.ply           the cloud, with normals, label, probability and sigma of each point
semantic.ply        the same in the colours of the labels, if there are labels
*.pcd               with --pcd: the same clouds for ROS and PCL
objects/ID-CLASS    a cloud of each object of the run
moving/ID, .ply     with --moving: excluded points of each keyframe, and the cloud of all of them
frames/             while `live --map` runs: frames between keyframes, for the growing surface
volume/             with --keep-volume: the surface's voxels, and which frames are in them
mesh.ply, .glb      the mesh, with the same columns; for viewers
plan.png            the map from above
view_*.png          pictures of cloud and mesh
legend.json         colours of the labels
dense.json          counts and times
==================  ==============================================================================
"""

from __future__ import annotations

import json
import logging
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from shlex import quote
from typing import Any

import cv2
import numpy as np

from bmask_slam.dense.options import MapOptions, fusion_config
from bmask_slam.graph.arrays import Arrays, Image, Ints, Mask
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.array_file import FileKind, check_like, read_arrays, write_arrays
from bmask_slam.graph.files.file_names import refuse_link
from bmask_slam.graph.files.json_file import Name, check_json, read_json
from bmask_slam.graph.files.reading import MAX_LINE, read_bytes
from bmask_slam.graph.files.whole_file import whole_file, writing
from bmask_slam.mapping.inverse_depth.dense_mapper import FusedKeyframe
from bmask_slam.mapping.inverse_depth.depth_map import (
    InverseDepthMap,
    read_depth_map,
    write_depth_map,
)
from bmask_slam.mapping.products.pictures import write_picture
from bmask_slam.mapping.products.submaps import Submap, read_submap, write_submap
from bmask_slam.mapping.products.surface_labels import InstanceEvidence
from bmask_slam.runtime.memory import give_back_memory
from bmask_slam.semantics.instances.image_files import decode_bytes
from bmask_slam.semantics.labels import LabelSet

logger = logging.getLogger(__name__)

LABEL_FILE = FileKind("keyframe labels", 2, compressed=True)
_NO_EVIDENCE = InstanceEvidence(
    np.zeros((0, 0), np.float32), np.zeros(0, np.int64), np.zeros(0, np.uint16)
)
NewIds = Callable[[Ints], Ints]
PARTS, FRAMES = ("depth", "colours", "moving", "labels"), "frames"
OLD_PARTS = ("submaps", "volume", FRAMES)
METHOD = 4
"""Version of the method; to be raised when the same settings give other submaps than before."""


def folder_settings(
    options: MapOptions, labels: LabelSet, stereo_bf_px_m: float | None = None
) -> dict[str, Any]:
    """The settings of a dense map as its folder stores them; of resolved options.

    ``stereo_bf_px_m`` is that of the stereo pairs, None without pairs.
    """
    settings = {
        "method": METHOD,
        "run": _first_log_line(options.run),
        "voxel_m": options.voxel_m,
        "masks": None if options.masks is None else options.masks.described(),
        "source": options.source,
        "without": list(options.excluded or ()),
        "moving": options.keep_excluded,
        "labels": list(labels.names),
        "noise": asdict(fusion_config(options).measurement),
    }
    return settings if options.source == "sensor" else settings | {"stereo_bf": stereo_bf_px_m}


def _read_settings(path: Path) -> dict[str, Any]:
    return read_json(path, dict[str, Any], "remove it to start the dense map again")


def _first_log_line(run: Path) -> str:
    """The first line of a run's log, with the time when it began.

    When a run is overwritten the line changes, so that the dense map of the old run is not used.
    """
    path = run / "log.txt"
    if not path.is_file():
        return ""
    with path.open(encoding="utf-8", errors="replace") as file:
        return file.readline(MAX_LINE).strip()


class DenseFolder:
    """The folder RUN/dense for some settings, a dictionary of JSON values."""

    def __init__(self, run: Path, settings: dict[str, Any]) -> None:
        """Make the folder, or keep its keyframes if they were made with the same settings.

        Raises:
            InputError: it cannot be written.
        """
        self.settings = settings
        self.open_in(run)

    def open_in(self, run: Path) -> None:
        """Go on in the folder of this run; raises InputError if it cannot be written."""
        self.path = run / "dense"
        for path in (self.path, *(self.path / name for name in PARTS)):
            refuse_link(path)
        with writing(self.path):
            self.path.mkdir(exist_ok=True)
            self._clear_unless(self.settings)
            for name in PARTS:
                (self.path / name).mkdir(exist_ok=True)
            self.write_text(
                "settings.json", json.dumps(self.settings, indent=1, sort_keys=True) + "\n"
            )

    @classmethod
    def open(cls, run: Path) -> DenseFolder:
        """The dense map of a run with its own settings. Raises InputError if there is none."""
        path = run / "dense" / "settings.json"
        if not path.is_file():
            cure = f"make it with bmask-slam map {quote(str(run))}"
            raise InputError(f"{path}: no dense map here; {cure}")
        return cls(run, _read_settings(path))

    @classmethod
    def reading(cls, run: Path) -> DenseFolder:
        """The dense map of a run, of which nothing is changed. Raises InputError as ``open``."""
        found = cls.__new__(cls)
        found.path = run / "dense"
        found.settings = _read_settings(found.path / "settings.json")
        return found

    def is_like(self, other: DenseFolder) -> bool:
        """Whether their keyframes were made in the same way, of whatever run."""
        mine, theirs = (json.loads(json.dumps(f.settings | {"run": ""})) for f in (self, other))
        return bool(mine == theirs)

    def take_over(
        self, other: DenseFolder, keyframe_ids: Mapping[int, int], new_landmarks: NewIds
    ) -> int:
        """Copy the finished keyframes of another folder; how many there were.

        ``keyframe_ids`` are their new ids by the old ones, ``new_landmarks`` gives those of
        landmarks. Raises InputError if they cannot be read or written.
        """
        done = [(old, new) for old, new in keyframe_ids.items() if other.is_done(old)]
        for old, new in done:
            evidence = other.evidence(old)
            evidence = replace(evidence, landmark_ids=new_landmarks(evidence.landmark_ids))
            if (excluded := other.excluded(old)) is not None:
                self.write_excluded(replace(excluded, anchor=new))
            other.colours(old), other.fused(old)  # a link may lead to a file that is neither
            _copy(other._image(old), self._image(new))
            _copy(other._file("depth", old), self._file("depth", new))
            _write_evidence(self._file("labels", new), evidence)
        return len(done)

    def _clear_unless(self, settings: dict[str, Any]) -> None:
        """Remove the keyframes unless they were made with these settings."""
        path = self.path / "settings.json"
        before = _read_settings(path) if path.is_file() else None
        if before == json.loads(json.dumps(settings)):
            return
        if before is not None:
            logger.warning("%s: was made with other settings; started again", self.path)
        path.unlink(missing_ok=True)
        for name in (*PARTS, *OLD_PARTS):
            shutil.rmtree(self.path / name, ignore_errors=True)

    def is_done(self, keyframe_id: int) -> bool:
        """Whether the keyframe is finished, and its depth still there."""
        return all(self._file(kind, keyframe_id).is_file() for kind in ("labels", "depth"))

    def finished(self) -> list[int]:
        """Ids of the finished keyframes."""
        names = (path.name for path in (self.path / "labels").glob("[0-9]*"))
        ids = (int(name) for name in names if re.fullmatch("[0-9]{6,18}", name))
        return sorted(number for number in ids if self.is_done(number))

    def write(self, result: FusedKeyframe, evidence: InstanceEvidence) -> None:
        """Save a finished keyframe. Raises InputError, with no half-written file, if it cannot."""
        number = result.keyframe.id
        write_depth_map(self._file("depth", number), result.map)
        write_picture(self._image(number), result.keyframe.rgb)
        _write_evidence(self._file("labels", number), evidence)
        give_back_memory()

    def relabel(self, keyframe_id: int, excluded: Mask, evidence: InstanceEvidence) -> None:
        """Replace the evidence of a finished keyframe, remove its excluded pixels (H, W).

        Raises:
            InputError: it cannot be written; the old files stay.
        """
        if excluded.any():
            write_depth_map(
                self._file("depth", keyframe_id), self.fused(keyframe_id).without(excluded)
            )
        _write_evidence(self._file("labels", keyframe_id), evidence)

    def remove(self, keyframe_id: int) -> None:
        """Remove all files of a keyframe, its labels first."""
        for kind in reversed(PARTS):
            self._file(kind, keyframe_id).unlink(missing_ok=True)
        self._image(keyframe_id).unlink(missing_ok=True)

    def write_excluded(self, submap: Submap) -> None:
        """Save the excluded points of a keyframe. Raises InputError if it cannot."""
        write_submap(self._file("moving", submap.anchor), submap)

    def excluded(self, keyframe_id: int) -> Submap | None:
        """The excluded points of a keyframe, if they were saved."""
        path = self._file("moving", keyframe_id)
        return read_submap(path) if path.is_file() else None

    def colours(self, keyframe_id: int) -> Image:
        """Colours (H, W, 3) of a finished keyframe. Raises InputError if they cannot be read."""
        path = self._image(keyframe_id)
        data = read_bytes(path, f"remove {self.path} and map again")
        return np.asarray(decode_bytes(data, cv2.IMREAD_COLOR_RGB, str(path)), np.uint8)

    def evidence(self, keyframe_id: int) -> InstanceEvidence:
        """The evidence of a finished keyframe about the classes of its instances."""
        path = self._file("labels", keyframe_id)
        header, arrays = read_arrays(path, LABEL_FILE)
        for name in ("stuff", "pixels"):
            arrays.setdefault(name, getattr(_NO_EVIDENCE, name))  # older files have none
        kinds = _arrays(_NO_EVIDENCE)
        arrays = {n: a.astype(kinds[n].dtype) if n in kinds else a for n, a in arrays.items()}
        check_like(arrays, kinds, path)
        alike = len(arrays["landmark_ids"]) == len(arrays["landmark_instances"])
        if not alike or not arrays["log_likelihoods"].shape[1]:
            raise InputError(f"{path}: its arrays do not fit together; remove it and map again")
        names = check_json(header.get("stuff", []), list[Name], f"{path}: its classes", "map again")
        if arrays["stuff"].shape[1] != len(names) or (len(arrays["stuff"]) and not names):
            raise InputError(
                f"{path}: regions of {arrays['stuff'].shape[1]} classes, but {len(names)} names; "
                "remove it and map again"
            )
        if arrays["pixels"].max(initial=0) >= len(arrays["log_likelihoods"]) + len(arrays["stuff"]):
            raise InputError(f"{path}: a pixel of an instance that is not there; map again")
        return InstanceEvidence(**arrays, stuff_names=tuple(names))

    def fused(self, keyframe_id: int) -> InverseDepthMap:
        """The fused inverse depth of a finished keyframe."""
        return read_depth_map(self._file("depth", keyframe_id))

    def written_ns(self, keyframe_id: int) -> int:
        """When the fused depth of a finished keyframe was written, in ns."""
        return self._file("depth", keyframe_id).stat().st_mtime_ns

    def write_text(self, name: str, text: str) -> None:
        """Write a text file, or replace it."""
        with whole_file(self.path / name) as temporary:
            temporary.write_text(text, encoding="utf-8")

    def _image(self, keyframe_id: int) -> Path:
        return self.path / "colours" / f"{keyframe_id:06d}.jpg"

    def _file(self, kind: str, keyframe_id: int) -> Path:
        return self.path / kind / f"{keyframe_id:06d}"


def _copy(source: Path, target: Path) -> None:
    """Copy a file whole. Raises InputError if it cannot be read or written."""
    with writing(target), whole_file(target) as temporary:
        temporary.write_bytes(read_bytes(source, "map its run again"))


def _write_evidence(path: Path, evidence: InstanceEvidence) -> None:
    write_arrays(path, LABEL_FILE, {"stuff": list(evidence.stuff_names)}, _arrays(evidence))


def _arrays(evidence: InstanceEvidence) -> Arrays:
    return {name: a for name, a in vars(evidence).items() if isinstance(a, np.ndarray)}
