"""What a user looks at: clouds, mesh, floor plan and pictures of a dense map."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from graph.camera import Camera
from graph.errors import InputError
from graph.geometry import Array, make_pose
from mapping.cloud import Cloud, merged, spill
from mapping.cloud_files import CloudWriter
from mapping.floor_plan import FloorPlan, plan_frame
from mapping.mesh import View, sampled, truncation_voxels, tsdf_mesh, write_mesh
from mapping.pictures import Picture, palette, with_legend
from mapping.submaps import Submap
from slam.dense_folder import DenseFolder
from slam.dense_input import MappedRun, load
from slam.dense_mapping import MapOptions
from slam.world_map import Keyframe

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


def finished(run: MappedRun, folder: DenseFolder) -> list[Keyframe]:
    """The keyframes that have a submap."""
    return [k for k in run.keyframes if folder.is_done(k.id)]


def write_clouds(
    run: MappedRun, folder: DenseFolder, names: tuple[str, ...], options: MapOptions
) -> Products:
    """Write the coloured and the semantic cloud, pictures of them and, if asked, the plan."""
    keyframes, voxel_m = finished(run, folder), options.voxel_m
    colours = palette(len(names))
    counts = np.zeros(len(names), np.int64)
    views = _viewpoints(run, keyframes)
    with tempfile.TemporaryDirectory(dir=folder.path, prefix=".blocks-") as temporary:
        table, submaps = _with_table(keyframes, folder)
        files = spill(submaps, voxel_m, Path(temporary))
        floor = (
            _floor_plan(merged(files, voxel_m, table), keyframes, len(names))
            if options.plan
            else None
        )
        plain = {n: Picture(*view, voxel_m) for n, view in views.items()}
        semantic = {n: Picture(*view, voxel_m) for n, view in views.items()}
        with (
            CloudWriter(folder.path / "cloud") as cloud_file,
            CloudWriter(folder.path / "semantic", colours) as semantic_file,
        ):
            for block in merged(files, voxel_m, table):
                cloud_file.write(block)
                semantic_file.write(block)
                if floor is not None:
                    floor.add(block)
                counts += np.bincount(block.labels, minlength=len(names))
                for name in views:
                    plain[name].draw(block.points, block.colours)
                    semantic[name].draw(block.points, colours[block.labels])
    total = max(int(counts.sum()), 1)
    present = np.flatnonzero(counts).tolist()
    written = [folder.path / f"{n}{s}" for n in ("cloud", "semantic") for s in (".ply", ".pcd")]
    for name in views:
        written.append(_write(folder, f"view_{name}.png", plain[name].image()))
        if len(present) > 1:
            picture = with_legend(semantic[name].image(), names, present)
            written.append(_write(folder, f"view_{name}_semantic.png", picture))
    if floor is not None:
        path = np.stack([k.T_world_camera[:3, 3] for k in keyframes])
        written.append(_write(folder, "plan.png", floor.picture(names, path)))
    legend = {names[k]: colours[k].tolist() for k in range(len(names))}
    folder.write_text("legend.json", json.dumps(legend, indent=1) + "\n")
    shares = {names[k]: float(counts[k] / total) for k in present}
    return Products(written, int(counts.sum()), shares)


def _with_table(
    keyframes: list[Keyframe], folder: DenseFolder
) -> tuple[NDArray[np.float32], Iterator[tuple[Submap, Array, int]]]:
    """All instances' log likelihoods, and every submap with its place in that table."""
    rows = [folder.log_likelihoods(k.id) for k in keyframes]
    first = np.cumsum([0, *(len(r) for r in rows)])
    submaps = (
        (folder.submap(k.id), k.T_world_camera, int(start))
        for k, start in zip(keyframes, first, strict=False)
    )
    return np.concatenate(rows), submaps


def _floor_plan(blocks: Iterator[Cloud], keyframes: list[Keyframe], classes: int) -> FloorPlan:
    """An empty plan whose frame is that of a sample of the cloud."""
    guess = -np.mean([k.T_world_camera[:3, 1] for k in keyframes], axis=0)
    names = Cloud.__dataclass_fields__
    sample = [Cloud(**{n: getattr(b, n)[::PLAN_SAMPLE] for n in names}) for b in blocks]
    whole = Cloud(**{n: np.concatenate([getattr(s, n) for s in sample]) for n in names})
    return FloorPlan(plan_frame(whole, guess, PLAN_CELL_M), classes)


def _viewpoints(run: MappedRun, keyframes: list[Keyframe]) -> dict[str, tuple[Camera, Array]]:
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
        dense, _ = load(run, keyframe)
        yield folder.fused(keyframe.id).depth_m(), dense.rgb, keyframe.T_world_camera


def _write(folder: DenseFolder, name: str, image: NDArray[np.uint8]) -> Path:
    path = folder.path / name
    temporary = folder.path / f".part-{name}"
    if not cv2.imwrite(str(temporary), cv2.cvtColor(image, cv2.COLOR_RGB2BGR)):
        raise InputError(f"{path}: cannot be written; free some space")
    temporary.replace(path)
    return path
