"""What a user looks at: clouds, mesh, floor plan and pictures of a dense map."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from bmask_slam.dense.folder import DenseFolder
from bmask_slam.dense.input import MappedRun, SavedMap, load
from bmask_slam.dense.keyframes import OpenMap
from bmask_slam.dense.options import MapOptions
from bmask_slam.graph.arrays import Array, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import make_pose
from bmask_slam.graph.whole_file import whole_file
from bmask_slam.mapping.products.cloud import Cloud, merged, spill
from bmask_slam.mapping.products.cloud_files import CloudWriter
from bmask_slam.mapping.products.floor_plan import FloorPlan, plan_frame
from bmask_slam.mapping.products.mesh import View, sampled, truncation_voxels, tsdf_mesh, write_mesh
from bmask_slam.mapping.products.object_clouds import ObjectClouds, ObjectRegion
from bmask_slam.mapping.products.pictures import Picture, palette, with_legend
from bmask_slam.mapping.products.surface_labels import LabelTable
from bmask_slam.run_folder.map_file import run_semantics
from bmask_slam.run_folder.semantic_files import OBJECTS, read_objects
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.world.world_map import Keyframe

PLAN_CELL_M, PLAN_SAMPLE = 0.03, 10
OUTSIDE_M = 1.0
"""The overview is taken from so far behind and above the first keyframe."""


@dataclass(frozen=True)
class Products:
    """What was written.

    Attributes:
        files: paths.
        points: in the cloud.
        label_shares: share of the points of each class that is there.
    """

    files: list[Path]
    points: int
    label_shares: dict[str, float]


@dataclass(frozen=True, eq=False)
class FusedMap:
    """A dense map whose keyframes are fused.

    Attributes:
        run: what of. labels: of its instances. folder: where it is. options: as made.
    """

    run: SavedMap
    labels: LabelSet
    folder: DenseFolder
    options: MapOptions

    @classmethod
    def of(cls, opened: OpenMap) -> FusedMap:
        """The same of a map that was being made."""
        return cls(opened.run, opened.segmenter.labels, opened.folder, opened.options)


def finished(run: SavedMap, folder: DenseFolder) -> list[Keyframe]:
    """The keyframes that have a submap."""
    return [k for k in run.keyframes if folder.is_done(k.id)]


def write_clouds(opened: FusedMap) -> Products:
    """Write the coloured and the semantic cloud and what is drawn of them, in one pass a cloud."""
    run, folder, voxel_m = opened.run, opened.folder, opened.options.voxel_m
    names, keyframes = opened.labels.names, finished(run, folder)
    with tempfile.TemporaryDirectory(dir=folder.path, prefix=".blocks-") as temporary:
        table = label_table(opened, keyframes)
        rows = zip(keyframes, table.first.tolist(), strict=True)
        submaps = ((folder.submap(k.id), k.T_world_camera, row) for k, row in rows)
        files = spill(submaps, voxel_m, Path(temporary))
        floor = None
        if opened.options.plan:
            floor = _floor_plan(merged(files, voxel_m, table), keyframes, len(names))
        gallery = _Gallery(_viewpoints(run, keyframes), voxel_m, names)
        written = _write_blocks(opened, merged(files, voxel_m, table), gallery, floor)
        written += gallery.write(folder)
        written += _write_moving(opened, keyframes, table, Path(temporary))
    if floor is not None:
        path = np.stack([k.T_world_camera[:3, 3] for k in keyframes])
        written.append(_write(folder, "plan.png", floor.picture(names, path)))
    legend = dict(zip(names, palette(len(names)).tolist(), strict=True))
    folder.write_text("legend.json", json.dumps(legend, indent=1) + "\n")
    total = max(int(gallery.counts.sum()), 1)
    shares = {names[k]: float(gallery.counts[k] / total) for k in gallery.present}
    return Products(written, int(gallery.counts.sum()), shares)


def _write_blocks(
    opened: FusedMap, blocks: Iterable[Cloud], gallery: _Gallery, floor: FloorPlan | None
) -> list[Path]:
    """Give each block to all that want it."""
    path = opened.folder.path
    with (
        CloudWriter(path / "cloud") as cloud_file,
        CloudWriter(path / "semantic", gallery.colours) as semantic_file,
        ObjectClouds(path / "objects", _regions(opened)) as objects,
    ):
        for block in blocks:
            cloud_file.write(block)
            semantic_file.write(block)
            objects.write(block)
            gallery.draw(block)
            if floor is not None:
                floor.add(block)
    written = [path / f"{n}{s}" for n in ("cloud", "semantic") for s in (".ply", ".pcd")]
    return written + objects.files


def _write_moving(
    opened: FusedMap,
    keyframes: list[Keyframe],
    table: LabelTable,
    temporary: Path,
) -> list[Path]:
    """The cloud of what moves, where it was kept: of every keyframe, in no order of time."""
    kept = [(opened.folder.moving(k.id), k, f) for k, f in zip(keyframes, table.first, strict=True)]
    submaps = [(s, k.T_world_camera, int(f)) for s, k, f in kept if s is not None]
    path = opened.folder.path / "moving"
    path.with_suffix(".ply").unlink(missing_ok=True)
    if not submaps:
        return []
    temporary = temporary / "moving"
    temporary.mkdir()
    voxel_m = opened.options.voxel_m
    with CloudWriter(path) as file:
        for block in merged(spill(submaps, voxel_m, temporary), voxel_m, table):
            file.write(block)
    return [path.with_suffix(".ply")]


class _Gallery:
    """Pictures of the cloud, by its colours and by its labels, and how many points have each."""

    def __init__(
        self, views: dict[str, tuple[Camera, Array]], voxel_m: float, names: tuple[str, ...]
    ) -> None:
        self.names, self.colours = names, palette(len(names))
        self.counts = np.zeros(len(names), np.int64)
        self._plain = {n: Picture(*view, voxel_m) for n, view in views.items()}
        self._semantic = {n: Picture(*view, voxel_m) for n, view in views.items()}

    @property
    def present(self) -> list[int]:
        """Labels that some point has."""
        return [int(k) for k in np.flatnonzero(self.counts)]

    def draw(self, block: Cloud) -> None:
        """Take a block in."""
        self.counts += np.bincount(block.labels, minlength=len(self.names))
        for picture in self._plain.values():
            picture.draw(block.points, block.colours)
        for picture in self._semantic.values():
            picture.draw(block.points, self.colours[block.labels])

    def write(self, folder: DenseFolder) -> list[Path]:
        """Save the pictures; those of labels only if there are several."""
        plain = [_write(folder, f"view_{n}.png", p.image()) for n, p in self._plain.items()]
        if len(self.present) < 2:
            return plain
        return plain + [
            _write(
                folder,
                f"view_{n}_semantic.png",
                with_legend(p.image(), self.names, self.present),
            )
            for n, p in self._semantic.items()
        ]


def label_table(opened: FusedMap, keyframes: list[Keyframe]) -> LabelTable:
    """What all keyframes' instances say.

    They hold what the run's label store believes at this moment, so that a label that changes
    there changes in the map.
    """
    fusion = run_semantics(opened.run.path).labels
    prior = fusion.prior(len(opened.labels))
    rows = []
    for keyframe in keyframes:
        evidence = opened.folder.evidence(keyframe.id)
        told = opened.run.believed(evidence.landmark_ids, opened.labels)
        rows.append(evidence.with_landmarks(*told, prior))
    return LabelTable.of(rows, fusion)


def _regions(opened: FusedMap) -> list[ObjectRegion]:
    """The objects that the run found, if it had a segmenter with the same labels."""
    if not (opened.run.path / OBJECTS).is_file():
        return []
    number = opened.labels.number
    return [
        ObjectRegion(f"{o.id:04d}-{o.label.replace(' ', '_')}", number(o.label), o.box)
        for o in read_objects(opened.run.path)[1]
        if number(o.label)
    ]


def _floor_plan(blocks: Iterator[Cloud], keyframes: list[Keyframe], classes: int) -> FloorPlan:
    """An empty plan whose frame is that of a sample of the cloud."""
    guess = -np.mean([k.T_world_camera[:3, 1] for k in keyframes], axis=0)
    names = Cloud.__dataclass_fields__
    sample = [Cloud(**{n: getattr(b, n)[::PLAN_SAMPLE] for n in names}) for b in blocks]
    whole = Cloud(**{n: np.concatenate([getattr(s, n) for s in sample]) for n in names})
    return FloorPlan(plan_frame(whole, guess, PLAN_CELL_M), classes)


def _viewpoints(run: SavedMap, keyframes: list[Keyframe]) -> dict[str, tuple[Camera, Array]]:
    """Two keyframes' views, and one from behind and above the path."""
    camera = run.camera
    chosen = {
        "first": keyframes[0].T_world_camera,
        "middle": keyframes[len(keyframes) // 2].T_world_camera,
    }
    lifted = make_pose(np.eye(3), np.array([0.0, -0.6 * OUTSIDE_M, -OUTSIDE_M]))
    tilt = np.deg2rad(-20)
    lifted[1:3, 1:3] = [[np.cos(tilt), -np.sin(tilt)], [np.sin(tilt), np.cos(tilt)]]
    chosen["overview"] = chosen["middle"] @ lifted
    return {name: (camera, T) for name, T in chosen.items()}


def write_dense_mesh(run: MappedRun, folder: DenseFolder, voxel_m: float) -> list[Path]:
    """Integrate the fused depth of every keyframe; write the mesh and a picture of its shape."""
    keyframes = finished(run, folder)
    first = folder.fused(keyframes[len(keyframes) // 2].id)
    truncation = truncation_voxels(first.depth_sigma_m(), voxel_m)
    path = folder.path / "mesh.ply"
    mesh = tsdf_mesh(_views(run, keyframes, folder), run.camera, voxel_m, truncation)
    write_mesh(path, mesh)
    T = keyframes[len(keyframes) // 2].T_world_camera
    picture = Picture(run.camera, T, 0.6 * voxel_m)
    points, normals = sampled(mesh)
    shade = np.abs(normals @ T[:3, 2])[:, None] * np.full(3, 255)
    picture.draw(points, shade.astype(np.uint8))
    return [path, _write(folder, "view_mesh.png", picture.image())]


def _views(run: MappedRun, keyframes: list[Keyframe], folder: DenseFolder) -> Iterator[View]:
    for keyframe in keyframes:
        dense, _ = load(run, keyframe, "motion")  # its colours only
        yield folder.fused(keyframe.id).depth_m(), dense.rgb, keyframe.T_world_camera


def _write(folder: DenseFolder, name: str, image: Image) -> Path:
    path = folder.path / name
    with whole_file(path) as temporary:
        if not cv2.imwrite(str(temporary), cv2.cvtColor(image, cv2.COLOR_RGB2BGR)):
            raise InputError(f"{path}: cannot be written; free some space")
    return path
