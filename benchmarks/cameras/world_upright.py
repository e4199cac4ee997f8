"""How upright the world is by the accelerometer of TUM freiburg1_rpy, beside what is horizontal.

    python -m benchmarks.cameras.world_upright [SEQUENCE] [--grids 32 36 40 44]

One `run --segmenter none --set sensors.accelerometer.enabled=true` for each spread of keypoints.
Degrees between three directions: up as the map has it by the accelerometer; z of the reference,
whose world is turned onto the run's by the rotations of all frames; and the normal of what is
horizontal: planes fitted to blocks of every sixth depth image, seen from the run's poses, the
median of those within 8 degrees of up, of all of them and of the lowest, the floor.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.paths import SHARED
from benchmarks.suite.measure import call
from bmask_slam.dense.saved_map import read_saved_map
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.trajectory import Trajectory, associate
from bmask_slam.run_folder.reader import Run
from bmask_slam.sequences.sequence import open_sequence

BLOCK_PX, STEP, NEAR_M, FAR_M = 24, 6, 0.5, 3.0
CONE_DEG, FLOOR_M = 8.0, 0.1


def planes(depth_m: Array, camera: Camera) -> tuple[Array, Array]:
    """Centres and normals (B, 3), toward the camera, of the blocks that are planes."""
    rows, columns = (size // BLOCK_PX for size in depth_m.shape)
    v, u = np.mgrid[: rows * BLOCK_PX, : columns * BLOCK_PX].astype(float)
    z = depth_m[: rows * BLOCK_PX, : columns * BLOCK_PX]
    points = camera.backproject(np.stack([u, v], axis=-1).reshape(-1, 2), z.ravel())
    blocks = points.reshape(rows, BLOCK_PX, columns, BLOCK_PX, 3).swapaxes(1, 2)
    blocks = blocks.reshape(-1, BLOCK_PX**2, 3)
    near = (blocks[..., 2] > NEAR_M) & (blocks[..., 2] < FAR_M)
    blocks = blocks[near.all(axis=1)]
    centres = blocks.mean(axis=1)
    off = blocks - centres[:, None]
    spreads, axes = np.linalg.eigh(np.swapaxes(off, 1, 2) @ off / BLOCK_PX**2)
    normals = axes[:, :, 0] * -np.sign(np.sum(axes[:, :, 0] * centres, axis=1))[:, None]
    flat = np.sqrt(spreads[:, 0]) < 0.003 + 0.002 * centres[:, 2] ** 2
    return centres[flat], normals[flat]


def horizontal(run: Run, up: Array, sequence: Path) -> tuple[Array, Array]:
    """The median normals (3,) of what is horizontal, and of the floor, in the run's world."""
    images, path = open_sequence(sequence, camera=run.camera), run.trajectory
    found = []
    for k in range(0, len(images), STEP):
        T = path.poses_world_camera[np.abs(path.timestamps_s - images.timestamps_s[k]).argmin()]
        centres, normals = planes(np.asarray(images.depth(k)[0], float), run.camera)
        found.append(np.hstack([normals @ T[:3, :3].T, centres @ T[:3, :3].T + T[:3, 3]]))
    normals, centres = np.split(np.concatenate(found), 2, axis=1)
    level = normals @ up > np.cos(np.deg2rad(CONE_DEG))
    normals, heights = normals[level], centres[level] @ up
    floor = normals[heights < np.quantile(heights, 0.01) + FLOOR_M]
    return np.median(normals, axis=0), np.median(floor, axis=0)


def between_deg(a: Array, b: Array) -> float:
    """The angle between two directions (3,)."""
    return float(np.rad2deg(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b))))


def up_of_reference(path: Trajectory, reference: Trajectory) -> Array:
    """The reference's z (3,) in a run's world, by the rotations of all frames."""
    own, true = associate(path, reference)
    R = own.poses_world_camera[:, :3, :3], true.poses_world_camera[:, :3, :3]
    U, _, Vt = np.linalg.svd((R[0] @ np.swapaxes(R[1], 1, 2)).sum(axis=0))
    return np.asarray((U @ Vt)[:, 2])


def main() -> None:
    """Print a line for each spread of keypoints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sequence", type=Path, nargs="?", default=SHARED / "tum_fr1_rpy")
    parser.add_argument("--grids", type=int, nargs="+", default=[32, 36, 40, 44], metavar="PX")
    given = parser.parse_args()
    reference = open_sequence(given.sequence).groundtruth
    assert reference is not None, "the sequence has no groundtruth.txt"
    pairs = ("acc, z", "acc, level", "acc, floor", "z, level", "z, floor")
    print(f"{'grid px':>8}" + "".join(f"{pair:>12}" for pair in pairs))
    with TemporaryDirectory() as folder:
        for grid in given.grids:
            out = Path(folder) / str(grid)
            command = ["-m", "bmask_slam", "run", str(given.sequence), "--out", str(out), "--quiet"]
            command += ["--segmenter", "none", "--set", "sensors.accelerometer.enabled=true"]
            call([*command, "--set", f"features.bucket_px={grid}"])
            up = read_saved_map(out).up_world
            assert up is not None, "no gravity was measured"
            z = up_of_reference(Run(out).trajectory, reference)
            level, floor = horizontal(Run(out), up, given.sequence)
            compared = (up, z), (up, level), (up, floor), (z, level), (z, floor)
            angles = [between_deg(a, b) for a, b in compared]
            print(f"{grid:8}" + "".join(f"{angle:12.1f}" for angle in angles), flush=True)


if __name__ == "__main__":
    main()
