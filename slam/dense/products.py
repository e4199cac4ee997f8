"""The products of a dense map: clouds, mesh, floor plan and pictures, all of one surface."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.sparse import csr_matrix

from bmask_slam.dense.surface import FusedMap, frames_a_keyframe, lost_before, make_surface
from bmask_slam.dense.views import VIEWS, write_mesh_view, write_views
from bmask_slam.graph.arrays import Floats, Ints
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.array_file import fitting
from bmask_slam.graph.files.file_names import file_stem
from bmask_slam.graph.files.whole_file import remove
from bmask_slam.mapping.products.cloud import Cloud
from bmask_slam.mapping.products.cloud_files import CloudWriter
from bmask_slam.mapping.products.floor_plan import FloorPlan, plan_frame, up_direction
from bmask_slam.mapping.products.mesh_files import write_glb, write_mesh
from bmask_slam.mapping.products.object_clouds import ObjectClouds, ObjectRegion
from bmask_slam.mapping.products.pictures import palette, write_picture
from bmask_slam.mapping.products.surface_labels import LabelledView, LabelTable, rows_seen, views_of
from bmask_slam.mapping.products.surface_regions import StuffFusion
from bmask_slam.mapping.surface.extraction import Surface
from bmask_slam.mapping.surface.holes import close_holes
from bmask_slam.run_folder.map_file import run_semantics
from bmask_slam.run_folder.semantic_files import OBJECTS, read_objects
from bmask_slam.semantics.beliefs.surface_geometry import FLOORS, Ground, find_ground

PLAN_CELL_M, SAMPLE_STEP = 0.03, 20
AT_ONCE = 50_000
NO_PIXELS = np.zeros((0, 0), np.uint16)
CLOUDS = ("semantic.ply", "semantic.pcd", "moving.ply", "moving.pcd")
OF_SURFACE = (
    *("mesh.ply", "mesh.glb", "view_mesh.png", "plan.png"),
    *(f"view_{name}_semantic.png" for name in VIEWS),
)
"""What is not made of every map; an old mesh or plan of the same surface may stay."""


@dataclass(frozen=True, eq=False)
class GrownSurface:
    """A surface.

    Attributes:
        frames: in it, besides keyframes.
        alike: so many frames, one after the other, have the same errors; at least 1.
    """

    surface: Surface
    frames: int
    alike: float


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


def write_products(
    fused: FusedMap,
    progress: Callable[[int, int], None] = lambda done, total: None,
    grown: GrownSurface | None = None,
) -> Products:
    """Write the clouds, mesh, plan and pictures of the surface, which is made if it is not given.

    Raises:
        InputError: nothing can be seen of it, or the disk is full.
    """
    grown = grown or GrownSurface(make_surface(fused, progress), 0, frames_a_keyframe(fused))
    surface, evidence = close_holes(grown.surface), KeyframeEvidence(fused)
    if not len(surface.vertices):
        raise InputError(f"{fused.run.path}: no surface: too few keyframes have depth")
    views = evidence.views(surface.vertices)
    table = evidence.table(evidence.ground(surface, views))
    cloud = _labelled(surface, views, table, grown.alike)
    kept = ~np.isin(cloud.labels, [fused.labels.number(n) for n in fused.options.excluded or ()])
    surface, cloud = surface.select(kept), cloud.select(kept)
    if not len(cloud):
        raise InputError(f"{fused.run.path}: no surface: all of it is of excluded classes")
    names, folder = table.stuff_fusion.names, fused.folder
    written, changed = _write_clouds(fused, cloud, names)
    if fused.options.mesh:
        written += _write_mesh(fused, cloud, surface.triangles)
    if fused.options.plan:
        points, normals = (a.astype(float) for a in (cloud.points, cloud.normals))
        plan = FloorPlan(plan_frame(points, normals, fused.run.up_guess(), PLAN_CELL_M), names)
        plan.add(cloud)
        path_world = np.stack([k.T_world_camera[:3, 3] for k in evidence.keyframes])
        begins = lost_before(fused.run.path, [k.timestamp_s for k in evidence.keyframes])
        written.append(write_picture(folder.path / "plan.png", plan.picture(path_world, begins)))
    written += write_views(fused, cloud, names)
    written += _write_excluded(fused, evidence, table)
    for name in {*CLOUDS, *OF_SURFACE * changed} - {path.name for path in written}:
        remove(folder.path / name)
    counts = np.bincount(cloud.labels, minlength=len(names))
    shares = {names[k]: float(counts[k] / len(cloud)) for k in np.flatnonzero(counts).tolist()}
    return Products(written, len(cloud), shares)


class KeyframeEvidence:
    """What the keyframes tell about classes.

    Attributes:
        keyframes: those that are fused.
    """

    def __init__(self, fused: FusedMap) -> None:
        self.keyframes = fused.keyframes()
        self._fused = fused
        read = fused.folder.evidence
        self._all = [replace(read(k.id), pixels=NO_PIXELS) for k in self.keyframes]
        sizes = [len(e.log_likelihoods) + len(e.stuff) for e in self._all]
        self.first: Ints = np.cumsum([0, *sizes])

    def views(self, points_world: Floats) -> csr_matrix:
        """The instances and regions (N, I) of all keyframes on which points (N, 3) lie."""
        camera, pairs = self._fused.run.camera, []
        for keyframe, first in zip(self.keyframes, self.first.tolist(), strict=False):
            depth_m = self._fused.folder.fused(keyframe.id).depth_m()
            pixels = self._fused.folder.evidence(keyframe.id).pixels
            view = LabelledView(depth_m, pixels, keyframe.T_world_camera, first)
            pairs.append(rows_seen(points_world, view, camera))
        return views_of(pairs, len(points_world), int(self.first[-1]))

    def ground(self, surface: Surface, views: csr_matrix) -> Ground | None:
        """Up and the floor, from some points of the surface that look like floor in a keyframe."""
        best = [(e, [e.stuff_names[row.argmax()] for row in e.stuff]) for e in self._all]
        parts = [np.r_[np.zeros(len(e.log_likelihoods)), np.isin(n, FLOORS)] for e, n in best]
        is_floor = views @ np.concatenate(parts) > 0
        some = slice(None, None, SAMPLE_STEP)
        points = surface.vertices[some].astype(float)
        cameras = np.stack([k.T_world_camera[:3, 3] for k in self.keyframes])
        up_world = up_direction(surface.normals[some].astype(float), self._fused.run.up_guess())
        return find_ground(points[is_floor[some]], cameras, up_world)

    def table(self, ground: Ground | None) -> LabelTable:
        """The evidence of all instances and regions.

        It includes the current beliefs of the run's label store about the landmarks on the
        instances, so that a label that changes there changes in the dense map.
        """
        fused = self._fused
        store_config = run_semantics(fused.run.path).labels
        prior, rows = store_config.prior(len(fused.labels)), []
        for one, keyframe in zip(self._all, self.keyframes, strict=True):
            with fitting(fused.folder.path / "labels" / f"{keyframe.id:06d}"):
                distributions, known = fused.run.label_distributions(one.landmark_ids, fused.labels)
                rows.append(one.with_landmarks(distributions, known, prior))
        names: tuple[str, ...] = next(filter(None, (e.stuff_names for e in self._all)), ())
        stuff = StuffFusion.of(fused.labels.names, names, ground)
        return LabelTable.of(rows, store_config, [e.stuff_of(names) for e in self._all], stuff)


def _labelled(surface: Surface, views: csr_matrix, table: LabelTable, alike: float) -> Cloud:
    """The vertices of a surface with their labels.

    So many frames that follow each other look ``alike``: their errors are the same, and count once.
    """
    labels = np.zeros(len(surface.vertices), np.uint16)
    probabilities = np.ones(len(labels), np.float32)
    if table.log_likelihoods.shape[1] > 1 or len(table.stuff_fusion.stuff):
        for some in _pieces(len(labels)):
            points, normals = surface.vertices[some], surface.normals[some]
            labels[some], probabilities[some] = table.labels(views[some], points, normals)
    sigmas_m = np.sqrt(1e-4 * alike / surface.weights).astype(np.float32)
    frames = np.clip(surface.views, 0, 65535).astype(np.uint16)
    return Cloud(
        surface.vertices, surface.normals, surface.colours, sigmas_m, labels, probabilities, frames
    )


def _pieces(count: int) -> Iterator[slice]:
    """Slices of some rows of ``count``."""
    return (slice(k, min(k + AT_ONCE, count)) for k in range(0, count, AT_ONCE))


def _write_clouds(fused: FusedMap, cloud: Cloud, names: tuple[str, ...]) -> tuple[list[Path], bool]:
    """Write the cloud, that in the labels' colours, the objects'; whether it is another cloud."""
    path, colours, pcd = fused.folder.path, palette(names), fused.options.pcd
    legend = dict(zip(names, colours.tolist(), strict=True))
    fused.folder.write_text("legend.json", json.dumps(legend, indent=1) + "\n")
    written, changed = [], False
    for name, palette_of in (("cloud", None), ("semantic", colours))[
        : 1 + bool(cloud.labels.any())
    ]:
        with CloudWriter(path / name, palette_of, pcd) as file:
            for some in _pieces(len(cloud)):
                file.write(cloud.select(some))
        changed |= file.changed
        written += [path / f"{name}{suffix}" for suffix in (".ply", ".pcd")[: 1 + pcd]]
    with ObjectClouds(path / "objects", _regions(fused), pcd) as objects:
        objects.write(cloud)
    return written + objects.files, changed


def _write_excluded(fused: FusedMap, evidence: KeyframeEvidence, table: LabelTable) -> list[Path]:
    """Write the cloud of all keyframes' excluded points, if they were saved."""
    path = fused.folder.path / "moving"
    saved = [(k, fused.folder.excluded(k.id)) for k in evidence.keyframes]
    if not any(submap for _, submap in saved):
        return []
    with CloudWriter(path, pcd=fused.options.pcd) as file:
        for (keyframe, submap), first in zip(saved, evidence.first, strict=False):
            if submap is None:
                continue
            points, normals = submap.placed(keyframe.T_world_camera)
            rows = np.arange(len(points)), submap.instances.astype(np.int64) + first
            with fitting(path / f"{keyframe.id:06d}"):
                on = csr_matrix(
                    (np.ones(len(points), np.float32), rows), (len(points), len(table.submaps))
                )
            labels = table.labels(on, points, normals)
            sigmas_m = np.sqrt(submap.variances)
            one = np.ones(len(points), np.uint16)
            file.write(Cloud(points, normals, submap.colours, sigmas_m, *labels, one))
    return [path.with_suffix(suffix) for suffix in (".ply", ".pcd")[: 1 + fused.options.pcd]]


def _regions(fused: FusedMap) -> list[ObjectRegion]:
    """The objects that the run found, those whose labels the dense map has too."""
    if not (fused.run.path / OBJECTS).is_file():
        return []
    number, excluded = fused.labels.number, fused.options.excluded or ()
    return [
        ObjectRegion(f"{o.id:04d}-{file_stem(o.label)}", number(o.label), o.box)
        for o in read_objects(fused.run.path)[1]
        if number(o.label) and o.label not in excluded
    ]


def _write_mesh(fused: FusedMap, cloud: Cloud, triangles: Ints) -> list[Path]:
    """Write the mesh, for viewers too, and a picture of it."""
    up_world = up_direction(cloud.normals[::SAMPLE_STEP].astype(float), fused.run.up_guess())
    path = fused.folder.path
    return [
        write_mesh(path / "mesh.ply", cloud, triangles),
        write_glb(path / "mesh.glb", cloud, triangles, up_world),
        write_mesh_view(fused, cloud),
    ]
