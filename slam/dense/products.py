"""The products of a dense map: clouds, mesh, floor plan and pictures."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bmask_slam.dense.folder import DenseFolder
from bmask_slam.dense.keyframe_input import load_keyframe
from bmask_slam.dense.options import MapOptions
from bmask_slam.dense.saved_map import MappedRun, SavedMap
from bmask_slam.graph.arrays import Array, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.files.file_names import file_stem
from bmask_slam.graph.geometry import make_pose
from bmask_slam.mapping.products.cloud import Cloud, PlacedSubmap, merge_blocks, sort_into_blocks
from bmask_slam.mapping.products.cloud_files import CloudWriter
from bmask_slam.mapping.products.floor_plan import FloorPlan, plan_frame, up_direction
from bmask_slam.mapping.products.mesh import (
    DepthView,
    sampled,
    truncation_voxels,
    tsdf_mesh,
    write_mesh,
)
from bmask_slam.mapping.products.object_clouds import ObjectClouds, ObjectRegion
from bmask_slam.mapping.products.pictures import CloudPictures, Picture, palette, write_picture
from bmask_slam.mapping.products.surface_labels import LabelTable
from bmask_slam.mapping.products.surface_regions import StuffFusion
from bmask_slam.run_folder.map_file import run_semantics
from bmask_slam.run_folder.semantic_files import OBJECTS, read_objects
from bmask_slam.semantics.beliefs.surface_geometry import FLOORS, find_ground
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.world.world_map import Keyframe

PLAN_CELL_M, SAMPLE_STEP = 0.03, 20
OVERVIEW_OFFSET_M = np.array([0.0, -0.6, -1.0])
OVERVIEW_TILT_DEG = -20.0
"""The overview is taken from behind and above a keyframe, tilted down."""


@dataclass(frozen=True)
class Products:
    """What was written.

    Attributes:
        files: paths.
        points: number of points of the cloud.
        label_shares: share of the points with each label that occurs.
    """

    files: list[Path]
    points: int
    label_shares: dict[str, float]


@dataclass(frozen=True, eq=False)
class FusedMap:
    """A dense map whose keyframes are fused.

    Attributes:
        run: the map of the run. labels: of its instances. folder: RUN/dense. options: resolved.
    """

    run: SavedMap
    labels: LabelSet
    folder: DenseFolder
    options: MapOptions

    def keyframes(self) -> list[Keyframe]:
        """The keyframes that have a submap, oldest first."""
        return [k for k in self.run.keyframes if self.folder.is_done(k.id)]


def write_clouds(fused: FusedMap) -> Products:
    """Write the coloured and the semantic cloud, and the plan and pictures, in one pass a cloud."""
    folder, voxel_m = fused.folder, fused.options.voxel_m
    keyframes = fused.keyframes()
    sample = sample_points(fused, keyframes)
    with tempfile.TemporaryDirectory(dir=folder.path, prefix=".blocks-") as temporary:
        table = label_table(fused, keyframes, sample)
        names = table.stuff_fusion.names
        rows = zip(keyframes, table.first.tolist(), strict=True)
        submaps = (PlacedSubmap(folder.submap(k.id), k.T_world_camera, row) for k, row in rows)
        files = sort_into_blocks(submaps, voxel_m, Path(temporary))
        plan = None
        if fused.options.plan:
            frame = plan_frame(sample.points, sample.normals, sample.up_guess, PLAN_CELL_M)
            plan = FloorPlan(frame, names)
        pictures = CloudPictures(_viewpoints(fused.run.camera, keyframes), voxel_m, names)
        written = _write_blocks(fused, merge_blocks(files, voxel_m, table), pictures, plan)
        written += pictures.write(folder.path)
        written += _write_excluded(fused, keyframes, table, Path(temporary))
    if plan is not None:
        path_world = np.stack([k.T_world_camera[:3, 3] for k in keyframes])
        written.append(write_picture(folder.path / "plan.png", plan.picture(path_world)))
    legend = dict(zip(names, palette(names).tolist(), strict=True))
    folder.write_text("legend.json", json.dumps(legend, indent=1) + "\n")
    points = int(pictures.counts.sum())
    shares = {names[k]: float(pictures.counts[k] / max(points, 1)) for k in pictures.present}
    return Products(written, points, shares)


def label_table(fused: FusedMap, keyframes: list[Keyframe], sample: Sample) -> LabelTable:
    """The label evidence of all keyframes' instances and regions.

    It includes the current beliefs of the run's label store about the landmarks on the instances,
    so that a label that changes there changes in the dense map.
    """
    store_config = run_semantics(fused.run.path).labels
    prior = store_config.prior(len(fused.labels))
    evidence = [fused.folder.evidence(k.id) for k in keyframes]
    rows = []
    for one in evidence:
        distributions, known = fused.run.label_distributions(one.landmark_ids, fused.labels)
        rows.append(one.with_landmarks(distributions, known, prior))
    names: tuple[str, ...] = next(filter(None, (e.stuff_names for e in evidence)), ())
    cameras = np.stack([k.T_world_camera[:3, 3] for k in keyframes])
    up_world = up_direction(sample.normals, sample.up_guess)
    ground = find_ground(sample.points[sample.floor], cameras, up_world)
    stuff = StuffFusion.of(fused.labels.names, names, ground)
    return LabelTable.of(rows, store_config, [e.stuff_of(names) for e in evidence], stuff)


@dataclass(frozen=True, eq=False)
class Sample:
    """Some points of all submaps in the world.

    Attributes:
        points, normals: (N, 3).
        floor: (N,) whether each looks like floor in its keyframe.
        up_guess: (3,) the cameras' mean upward axis.
    """

    points: Array
    normals: Array
    floor: Mask
    up_guess: Array


def sample_points(fused: FusedMap, keyframes: list[Keyframe]) -> Sample:
    """Every SAMPLE_STEP-th point of the submaps."""
    some = slice(None, None, SAMPLE_STEP)
    parts = []
    for keyframe in keyframes:
        submap, evidence = fused.folder.submap(keyframe.id), fused.folder.evidence(keyframe.id)
        points, normals = submap.placed(keyframe.T_world_camera)
        best = [evidence.stuff_names[row.argmax()] for row in evidence.stuff]
        numbers = np.flatnonzero(np.isin(best, FLOORS)) + len(evidence.log_likelihoods)
        parts.append((points[some], normals[some], np.isin(submap.instances[some], numbers)))
    points, normals, floor = (np.concatenate(part) for part in zip(*parts, strict=True))
    up_guess = -np.mean([k.T_world_camera[:3, 1] for k in keyframes], axis=0)
    return Sample(points.astype(float), normals.astype(float), floor, up_guess)


def _write_blocks(
    fused: FusedMap, blocks: Iterable[Cloud], pictures: CloudPictures, plan: FloorPlan | None
) -> list[Path]:
    """Write the clouds block by block, and add each block to the pictures and the plan."""
    path = fused.folder.path
    with (
        CloudWriter(path / "cloud") as cloud_file,
        CloudWriter(path / "semantic", pictures.palette) as semantic_file,
        ObjectClouds(path / "objects", _regions(fused)) as objects,
    ):
        for block in blocks:
            cloud_file.write(block)
            semantic_file.write(block)
            objects.write(block)
            pictures.draw(block)
            if plan is not None:
                plan.add(block)
    written = [path / f"{n}{s}" for n in ("cloud", "semantic") for s in (".ply", ".pcd")]
    return written + objects.files


def _write_excluded(
    fused: FusedMap, keyframes: list[Keyframe], table: LabelTable, temporary: Path
) -> list[Path]:
    """Write the cloud of all keyframes' excluded points, if they were saved."""
    path = fused.folder.path / "moving"
    path.with_suffix(".ply").unlink(missing_ok=True)
    submaps = []
    for keyframe, row in zip(keyframes, table.first.tolist(), strict=True):
        submap = fused.folder.excluded(keyframe.id)
        if submap is not None:
            submaps.append(PlacedSubmap(submap, keyframe.T_world_camera, row))
    if not submaps:
        return []
    temporary = temporary / "moving"
    temporary.mkdir()
    voxel_m = fused.options.voxel_m
    with CloudWriter(path) as file:
        for block in merge_blocks(sort_into_blocks(submaps, voxel_m, temporary), voxel_m, table):
            file.write(block)
    return [path.with_suffix(".ply")]


def _regions(fused: FusedMap) -> list[ObjectRegion]:
    """The objects that the run found, those whose labels the dense map has too."""
    if not (fused.run.path / OBJECTS).is_file():
        return []
    number = fused.labels.number
    return [
        ObjectRegion(f"{o.id:04d}-{file_stem(o.label)}", number(o.label), o.box)
        for o in read_objects(fused.run.path)[1]
        if number(o.label)
    ]


def _viewpoints(camera: Camera, keyframes: list[Keyframe]) -> dict[str, tuple[Camera, Array]]:
    """Camera and T_world_camera (4, 4) of two keyframes, and of an overview, by name."""
    first, middle = (keyframes[k].T_world_camera for k in (0, len(keyframes) // 2))
    tilt = np.deg2rad(OVERVIEW_TILT_DEG)
    T_middle_overview = make_pose(np.eye(3), OVERVIEW_OFFSET_M)
    T_middle_overview[1:3, 1:3] = [[np.cos(tilt), -np.sin(tilt)], [np.sin(tilt), np.cos(tilt)]]
    overview = middle @ T_middle_overview
    views = (("first", first), ("middle", middle), ("overview", overview))
    return {name: (camera, T) for name, T in views}


def write_dense_mesh(run: MappedRun, fused: FusedMap) -> list[Path]:
    """Integrate the fused depth of every keyframe; write the mesh and a picture of its shape."""
    keyframes, folder, voxel_m = fused.keyframes(), fused.folder, fused.options.voxel_m
    middle = keyframes[len(keyframes) // 2]
    truncation = truncation_voxels(folder.fused(middle.id).depth_sigma_m(), voxel_m)
    path = folder.path / "mesh.ply"
    mesh = tsdf_mesh(_views(run, keyframes, folder), run.camera, voxel_m, truncation)
    write_mesh(path, mesh)
    picture = Picture(run.camera, middle.T_world_camera, 0.6 * voxel_m)
    points, normals = sampled(mesh)
    shade = np.abs(normals @ middle.T_world_camera[:3, 2])[:, None] * np.full(3, 255)
    picture.draw(points, shade.astype(np.uint8))
    return [path, write_picture(folder.path / "view_mesh.png", picture.image())]


def _views(run: MappedRun, keyframes: list[Keyframe], folder: DenseFolder) -> Iterator[DepthView]:
    for keyframe in keyframes:
        dense, _ = load_keyframe(run, keyframe, "motion")  # for its colours: no depth is needed
        yield DepthView(folder.fused(keyframe.id).depth_m(), dense.rgb, keyframe.T_world_camera)
