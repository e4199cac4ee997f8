"""An exact run folder and its depth images, of a camera in an empty box-shaped room."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_update import Observations
from bmask_slam.graph.files.ply import write_ply
from bmask_slam.graph.geometry import inverse, make_pose, se3_exp, so3_exp, transform
from bmask_slam.graph.smoother.storage import write_graph
from bmask_slam.graph.trajectory import Trajectory, write_tum
from bmask_slam.rendering.writer import stored_depth, write_lists, write_png
from bmask_slam.sequences.cameras import write_camera

HALF_ROOM_M = np.array([1.6, 1.3, 1.7])
STEP_S, KEYFRAME_STEP_S = 1 / 30, 0.2
INVERSE_DEPTH_NOISE = 0.0005


def room_depth(T_world_camera: Array, camera: Camera, pixels: Array) -> Array:
    """Depth (N,) in metres of the room's walls at undistorted pixels (N, 2).

    From one pose (4, 4) or from one for each pixel (N, 4, 4).
    """
    rays = camera.backproject(pixels, np.ones(len(pixels)))
    rays = (T_world_camera[..., :3, :3] @ rays[..., None])[..., 0]
    with np.errstate(divide="ignore"):
        to_walls = (np.sign(rays) * HALF_ROOM_M - T_world_camera[..., :3, 3]) / rays
    return to_walls.min(axis=1)


def camera_path(times_s: Array) -> Array:
    """Poses T_world_camera (N, 4, 4): turning, rolling and moving about the room's middle."""
    t = times_s[:, None]
    turn = np.array([0.4, 1.2, 0.6]) * np.sin(t * [2.1, 1.3, 1.7])
    place = np.array([0.5, 0.3, 0.5]) * np.sin(t * [1.9, 2.3, 1.5])
    return make_pose(so3_exp(turn), place)


def make_run(
    folder: Path, truth: Camera, used: Camera, delay_s: float, keyframes: int = 16
) -> tuple[Path, Path]:
    """Sequence and run folder: taken by ``truth``, run with ``used``; depth comes ``delay_s`` late.

    Neither may have distortion. The run's poses and landmarks are the truth, a little disturbed.
    Images roll as the truth's do; a run whose camera does too has its pixels at one moment.
    """
    sequence, run = folder / "sequence", folder / "run"
    rng = np.random.default_rng(3)
    sequence.mkdir()
    run.mkdir()
    middle_s = 0.1 + KEYFRAME_STEP_S * np.arange(keyframes)
    times_s = (middle_s[:, None] + STEP_S * np.array([-1, 0, 1])).ravel()
    poses = camera_path(times_s)
    stamps = [f"{t:.6f}" for t in times_s]
    size = (truth.height, truth.width)
    v, u = np.mgrid[: size[0], : size[1]]
    pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(float)
    rows_s = truth.rolling_shutter_s * truth.share_of_rows(np.arange(size[0]))
    for stamp, time_s in zip(stamps, times_s, strict=True):
        T = camera_path(time_s + delay_s + rows_s).repeat(size[1], axis=0)
        inverse_depth = 1 / (room_depth(T, truth, pixels).reshape(size) - truth.depth_offset_m)
        depth_m = 1 / (inverse_depth + INVERSE_DEPTH_NOISE * rng.standard_normal(size))
        write_png(sequence / "depth" / f"{stamp}.png", stored_depth(depth_m, truth.depth_scale))
        write_png(sequence / "rgb" / f"{stamp}.png", np.zeros((*size, 3), np.uint8))
    write_lists(sequence, stamps, poses)
    write_camera(sequence / "camera.yaml", used)
    tables = _tables(middle_s, truth, used)
    _write_run(run, sequence, used, middle_s, tables)
    T_true_disturbed = inverse(camera_path(middle_s)) @ tables.keyframes.values
    poses = poses @ np.repeat(T_true_disturbed, 3, axis=0)
    write_tum(run / "trajectory.txt", Trajectory(np.array(stamps, float), poses))
    return sequence, run


def _tables(times_s: Array, truth: Camera, used: Camera) -> FactorTables:
    poses = camera_path(times_s)
    rng = np.random.default_rng(0)
    walls = rng.uniform(-1, 1, (1500, 3))
    side = rng.integers(0, 3, 1500)
    walls[np.arange(1500), side] = np.sign(walls[np.arange(1500), side])
    points = walls * HALF_ROOM_M
    points_camera = transform(inverse(poses), points)
    in_front = points_camera[..., 2] > 0.3
    pixels = truth.project(np.where(in_front[..., None], points_camera, [0.0, 0.0, 1.0]))
    pixels = pixels if used.rolling_shutter_s else _rolled(pixels, points, times_s, truth)
    limit = np.array([truth.width, truth.height]) - 1.0
    k, landmark = np.nonzero(in_front & ((pixels > 0) & (pixels < limit)).all(axis=2))
    noise = rng.normal(0, 0.02, (len(k), 2))
    tables = FactorTables()
    disturbed = poses @ se3_exp(rng.normal(0, [0.002] * 3 + [0.01] * 3, (len(poses), 6)))
    tables.keyframes.insert(np.arange(len(poses)), disturbed)
    tables.landmarks.insert(np.arange(1500), points + rng.normal(0, 0.02, points.shape))
    measured = np.column_stack([pixels[k, landmark] + noise, np.full(len(k), np.nan)])
    measured[:, 2] = measured[:, 0] - used.stereo_bf_px_m / points_camera[k, landmark, 2]
    sigmas = np.tile([0.2, 0.2, 0.08], (len(k), 1))
    tables.observations.add(Observations(k, landmark, measured, sigmas))
    return tables


def _rolled(pixels: Array, points_world: Array, times_s: Array, truth: Camera) -> Array:
    """Pixels (K, L, 2) of points (L, 3) when the rows on which they lie are exposed."""
    for _ in range(4 if truth.rolling_shutter_s else 0):
        later_s = truth.rolling_shutter_s * truth.share_of_rows(pixels[..., 1])
        T = camera_path((times_s[:, None] + later_s.clip(-0.1, 0.1)).ravel())
        points_camera = transform(inverse(T), np.tile(points_world, (len(times_s), 1))[:, None])
        points_camera = points_camera[:, 0]
        in_front = points_camera[:, 2:] > 0.1
        pixels = truth.project(np.where(in_front, points_camera, [0.0, 0.0, 1.0])).reshape(
            pixels.shape
        )
    return pixels


def _write_run(
    run: Path, sequence: Path, camera: Camera, times_s: Array, tables: FactorTables
) -> None:
    """The files of a run, with keyframes at these times (K,)."""
    write_graph(run / "graph", tables, camera)
    first = f"# bmask-slam 0.1.0, sequence {sequence}, stride 1\n"
    (run / "config.yaml").write_text(first + "{}\n")
    rows = [f"{k},{time_s:.6f},OK,{k}" for k, time_s in enumerate(times_s)]
    (run / "frames.csv").write_text("\n".join(["index,timestamp,status,keyframe", *rows]) + "\n")
    keyframes = Trajectory(np.round(times_s, 6), tables.keyframes.values)
    write_tum(run / "keyframes.txt", keyframes)
    x, y, z = tables.landmarks.values.T.astype(np.float32)
    colours = dict.fromkeys(("red", "green", "blue"), np.zeros(len(x), np.uint8))
    numbers = {"observations": np.ones(len(x), np.int32), "id": np.arange(len(x), dtype=np.int32)}
    write_ply(run / "landmarks.ply", {"x": x, "y": y, "z": z, **colours, **numbers})
