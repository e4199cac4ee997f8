"""A map to drive on, of a run with a dense map: as nav2's grid or as an OctoMap."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from bmask_slam.dense.saved_map import SavedMap, read_saved_map
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import make_pose
from bmask_slam.mapping.inverse_depth.depth_map import read_depth_map
from bmask_slam.mapping.products.floor_plan import (
    UPRIGHT_COSINE,
    PlanFrame,
    fit_floor,
    floor_height,
    plan_frame,
)
from bmask_slam.mapping.products.occupancy import (
    FREE,
    OCCUPIED,
    VoxelCarver,
    VoxelMap,
    grid_of,
)
from bmask_slam.mapping.products.occupancy_files import write_nav2, write_octomap
from bmask_slam.run_folder.landmark_file import DenseCloud
from bmask_slam.run_folder.reader import Run
from bmask_slam.semantics.beliefs.surface_geometry import FLOORS

logger = logging.getLogger(__name__)

DriveFormat = Literal["nav2", "octomap"]
MIN_FLOOR_POINTS = 200
MIN_RESOLUTION_M, MAX_RESOLUTION_M = 0.01, 1.0
MAX_CELLS = 1 << 27
"""Of a grid: 580 m square at 5 cm. With a few points that are wrong by far it would be larger."""


@dataclass(frozen=True)
class DriveMapOptions:
    """Of a map to drive on.

    Attributes:
        resolution_m: edge of a cell or voxel.
        low_m: what is lower above the floor is driven over.
        high_m: what is higher is driven under.
    """

    resolution_m: float = 0.05
    low_m: float = 0.1
    high_m: float = 1.5

    def __post_init__(self) -> None:
        if not MIN_RESOLUTION_M <= self.resolution_m <= MAX_RESOLUTION_M:
            limits = f"{MIN_RESOLUTION_M:g} to {MAX_RESOLUTION_M:g} m"
            raise InputError(f"--resolution {self.resolution_m:g}: must be from {limits}")
        if not 0 <= self.low_m < self.high_m <= 10:
            raise InputError(f"--heights {self.low_m:g} {self.high_m:g}: must rise, from 0 to 10 m")


def export_drive_map(
    run: Path, form: DriveFormat, out: Path, options: DriveMapOptions
) -> tuple[tuple[Path, ...], str]:
    """Write the map; returns its files and a text on them.

    Occupied is the surface of the dense map, which people and what ``map --without`` names are not
    in. Free is what the keyframes' depth looked through. The map's frame has z up, the floor at
    z = 0, x along the walls, and its origin under the run's first camera.

    Raises:
        InputError: no run, no dense map, or an output that cannot be written.
    """
    if not run.is_dir():
        raise InputError(f"{run}: {form} needs the folder of a run with a dense map")
    suffixes = {"nav2": (".yaml", ".yml", ".pgm", ""), "octomap": (".bt", "")}[form]
    if out.suffix.lower() not in suffixes:  # files of these names are written, whatever it says
        raise InputError(f"{out}: {form} is written as {suffixes[0]}; let --out end with it")
    if not out.parent.is_dir():
        raise InputError(f"{out}: the folder {out.parent} does not exist; make it first")
    if out.resolve().parent == run.resolve():
        raise InputError(f"{out}: is in the run, which stays as it is; choose another --out")
    voxels = voxel_map(run, options.resolution_m)
    counts = f"{int(voxels.occupied.sum())} occupied, {int((~voxels.occupied).sum())} free"
    if form == "octomap":
        path = out.with_suffix(".bt")
        nodes = write_octomap(path, voxels)
        return (path,), f"{counts} voxels of {options.resolution_m:g} m in {nodes} nodes, z up"
    spans = np.ptp(voxels.keys[:, :2], axis=0) + 1
    if spans.prod() > MAX_CELLS:
        size = " x ".join(f"{span * options.resolution_m:.0f}" for span in spans)
        raise InputError(f"{run}: its map is {size} m large; choose a larger --resolution")
    grid = grid_of(voxels, options.low_m, options.high_m)
    height, width = grid.cells.shape
    shares = [100 * float((grid.cells == kind).mean()) for kind in (OCCUPIED, FREE)]
    text = (
        f"{width} x {height} cells of {options.resolution_m:g} m: {shares[0]:.1f} % occupied from "
        f"{options.low_m:g} to {options.high_m:g} m, {shares[1]:.1f} % free, the rest unknown"
    )
    return write_nav2(out, grid, voxels.T_map_world), text


def voxel_map(run: Path, resolution_m: float) -> VoxelMap:
    """The free and occupied voxels of a run with a dense map. Raises InputError."""
    depths = run / "dense" / "depth"
    if not depths.is_dir():
        raise InputError(f"{depths}: no dense map here; make it with bmask-slam map {run}")
    saved, cloud = read_saved_map(run), Run(run).dense_cloud
    carver = VoxelCarver(resolution_m, map_frame(saved, cloud))
    carver.add_surface(cloud.points_world)
    carved = 0
    for keyframe in saved.keyframes:
        path = depths / f"{keyframe.id:06d}"
        if path.is_file() and np.isfinite(keyframe.T_world_camera).all():
            depth_m = read_depth_map(path).depth_m()
            if depth_m.shape != (saved.camera.height, saved.camera.width):
                raise InputError(f"{path}: of another size than the camera; make the map again")
            carver.carve(depth_m, saved.camera, keyframe.T_world_camera)
            carved += 1
    logger.info("%s: free space by the depth of %d keyframes", run, carved)
    return carver.voxels()


def map_frame(saved: SavedMap, cloud: DenseCloud) -> Array:
    """T_map_world (4, 4): z up, the floor at 0, x along the walls.

    The floor is that of the points with a floor's label where there are enough, else the lowest
    level of points that face up.

    Raises:
        InputError: an empty cloud.
    """
    points, normals = cloud.points_world, cloud.normals_world
    if not len(points):
        raise InputError(f"{saved.path}: its dense cloud is empty")
    guess = -np.mean([k.T_world_camera[:3, 1] for k in saved.keyframes], axis=0)
    frame = plan_frame(points, normals, guess, 1.0)
    up = frame.axes[2]
    floor = points[np.isin(cloud.labels, FLOORS) & (normals @ up > UPRIGHT_COSINE)]
    if len(floor) >= MIN_FLOOR_POINTS:
        up, floor_m = fit_floor(floor, up, floor_height(floor @ up))
        right = frame.axes[0] - (frame.axes[0] @ up) * up
        right /= np.linalg.norm(right)
        frame = PlanFrame(np.stack([right, np.cross(up, right), up]), floor_m, 1.0)
    return make_pose(frame.axes, np.array([0.0, 0.0, -frame.floor_m]))
