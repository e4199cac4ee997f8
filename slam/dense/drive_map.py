"""A map to drive on, of a run with a dense map: as nav2's grid or as an OctoMap."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import Literal

import numpy as np

from bmask_slam.dense.saved_map import SavedMap, read_saved_map
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import make_pose
from bmask_slam.mapping.inverse_depth.depth_map import read_depth_map
from bmask_slam.mapping.products.floor_plan import (
    GUESS_DEG,
    UPRIGHT_COSINE,
    axes_along_walls,
    fit_floor,
    floor_height,
    up_direction,
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
GRAVITY_DEG, LABELLED_DEG = 6.0, 75.0
"""The floor's normal may be so far from gravity, and a labelled floor's from the cameras' up."""
MIN_RESOLUTION_M, MAX_RESOLUTION_M = 0.01, 1.0
CLOUD = "dense/cloud.ply"
MAX_CELLS = 1 << 27
"""Of a grid: 580 m square at 5 cm. With a few points that are wrong by far it would be larger."""
TOO_LARGE = "choose a larger --resolution, or remove points that are far away"


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
    voxels, frame = voxel_map(run, options.resolution_m)
    counts = f"{int(voxels.occupied.sum())} occupied, {int((~voxels.occupied).sum())} free"
    if form == "octomap":
        path = out.with_suffix(".bt")
        nodes = write_octomap(path, voxels)
        size = f"voxels of {options.resolution_m:g} m in {nodes} nodes, z up"
        return (path,), f"{counts} {size}\n{frame}"
    spans = np.ptp(voxels.keys[:, :2], axis=0) + 1
    if spans.prod() > MAX_CELLS:
        size = " x ".join(f"{span * options.resolution_m:.0f}" for span in spans)
        raise InputError(f"{run / CLOUD}: its map is {size} m large; {TOO_LARGE}")
    grid = grid_of(voxels, options.low_m, options.high_m)
    height, width = grid.cells.shape
    shares = [100 * float((grid.cells == kind).mean()) for kind in (OCCUPIED, FREE)]
    text = (
        f"{width} x {height} cells of {options.resolution_m:g} m: {shares[0]:.1f} % occupied from "
        f"{options.low_m:g} to {options.high_m:g} m, {shares[1]:.1f} % free, the rest unknown"
    )
    return write_nav2(out, grid, voxels.T_map_world, frame), f"{text}\n{frame}"


def voxel_map(run: Path, resolution_m: float) -> tuple[VoxelMap, str]:
    """The free and occupied voxels of a run with a dense map, and how its floor was found.

    Raises:
        InputError: no run, no dense map, or a broken one.
    """
    saved, depths = read_saved_map(run), run / "dense" / "depth"
    if not depths.is_dir():
        cure = f"make it with bmask-slam map {quote(str(run))}"
        raise InputError(f"{depths}: no dense map here; {cure}")
    cloud = Run(run).dense_cloud
    T_map_world, frame = map_frame(saved, cloud)
    carver = VoxelCarver(resolution_m, T_map_world)
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
    logger.info("%s: free space by the depth of %d keyframes; %s", run, carved, frame)
    try:
        return carver.voxels(), frame
    except InputError as error:
        raise InputError(f"{run / CLOUD}: {error}") from error


def map_frame(saved: SavedMap, cloud: DenseCloud) -> tuple[Array, str]:
    """T_map_world (4, 4): z up, the floor at 0, x along the walls; and a text on how it was found.

    Up is near gravity's, if an accelerometer or an IMU was in the graph, else near the cameras'.
    The floor is that of the points with a floor's label where there are enough, else the lowest
    level of points that face up, or of all if none does. Its plane says up exactly, unless it is a
    slope by gravity.

    Raises:
        InputError: an empty cloud.
    """
    points, normals, gravity = cloud.points_world, cloud.normals_world, saved.up_world
    if not len(points):
        raise InputError(f"{saved.path}: its dense cloud is empty")
    guess = saved.up_guess()
    limits_deg = (LABELLED_DEG, GUESS_DEG) if gravity is None else (GRAVITY_DEG, GRAVITY_DEG)
    facing = UPRIGHT_COSINE if gravity is None else np.cos(np.deg2rad(2 * GRAVITY_DEG))
    labelled = np.isin(cloud.labels, FLOORS)
    for level, limit_deg in zip((labelled, np.ones_like(labelled)), limits_deg, strict=True):
        up = up_direction(normals[level], guess, limit_deg)
        floor = points[level & (normals @ up > facing)]
        if len(floor) >= MIN_FLOOR_POINTS:
            break
    by_labels = level is labelled
    seen = floor if len(floor) else points  # of walls alone the lowest part
    up, floor_m = fit_floor(floor, up, floor_height(seen @ up))
    if gravity is not None and up @ gravity < np.cos(np.deg2rad(GRAVITY_DEG)):
        up, floor_m = gravity, floor_height(seen @ gravity)
    guessed = (
        "the points labelled floor" if by_labels else "level surfaces and the cameras' attitude"
    )
    text = f"up by {guessed if gravity is None else 'gravity, which was measured'}, the floor by "
    lowest = "the lowest level" if len(floor) else "the lowest points, since none faces up"
    text += "its labels" if by_labels else lowest
    return make_pose(axes_along_walls(up, normals), np.array([0.0, 0.0, -floor_m])), text
