"""Is the red kitchen's reference right? Poses judged by the images alone, without any depth.

    python -m benchmarks.calibration.kitchen_reference RUN [--sequence FOLDER]

Between keyframes that are 0.3 to 1.6 s apart, the keypoints that a run matched must lie on each
other's epipolar lines. Their Sampson distances (Hartley and Zisserman, eq. 11.9) are computed with
the run's poses and with the reference's, each with the camera and with the point beside the camera
that fit these poses best. Then ATE and RPE against the reference, taken for the camera's poses and
for those of a point beside it (``bmask-slam evaluate --hand-eye``), of the run and of an estimate
that shares nothing with it: Open3D's odometry from frame to frame. Were the point an error of the
run, another system would not find the same.
"""

from __future__ import annotations

import argparse
import itertools
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from scipy.optimize import least_squares

from benchmarks.pages import table
from benchmarks.paths import KITCHEN
from bmask_slam.calibration.calibrate import CalibrateOptions, make_problem
from bmask_slam.evaluation import evaluate
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.calibration.model import CalibrationViews
from bmask_slam.graph.geometry import inverse, se3_exp, skew
from bmask_slam.graph.trajectory import Trajectory, associate, nearest_indices, read_tum, write_tum
from bmask_slam.mapping.open3d_loader import load_open3d
from bmask_slam.run_folder.map_file import read_run
from bmask_slam.sequences.sequence import Sequence, open_sequence

MAX_DEPTH_M = 8.0
APART_S, MIN_MATCHES = (0.3, 1.6), 15
CAMERA_STEPS = np.array([5.0, 5, 5, 5, 0.05, 0.05, 0.002, 0.002])
PLACE_STEPS = np.array([0.02] * 3 + [0.05] * 3)
"""Of fx, fy, cx, cy [px], k1, k2, p1, p2, and of the place's tangent [rad, m]."""
NAMES = ("ate_rmse", "rpe_trans_rmse_second", "rpe_rot_rmse_second")


@dataclass(frozen=True)
class Matches:
    """M matched keypoints: keyframes (M,) and raw pixels (M, 2) of either side."""

    first: Array
    second: Array
    pixels_first: Array
    pixels_second: Array


def matches_of(views: CalibrationViews, stamps_s: Array) -> Matches:
    """All matches between keyframes that are far enough apart and share enough landmarks."""
    rows = [np.flatnonzero(views.keyframes == k) for k in range(len(stamps_s))]
    pairs = []
    for a, b in itertools.combinations(range(len(rows)), 2):
        if APART_S[0] < abs(stamps_s[b] - stamps_s[a]) < APART_S[1]:
            _, i, j = np.intersect1d(
                views.landmarks[rows[a]], views.landmarks[rows[b]], return_indices=True
            )
            if len(i) >= MIN_MATCHES:
                pairs.append(np.column_stack([rows[a][i], rows[b][j]]))
    i, j = np.concatenate(pairs).T
    return Matches(views.keyframes[i], views.keyframes[j], views.pixels[i], views.pixels[j])


def sampson_px(matches: Matches, poses: Array, camera: Array) -> Array:
    """Distances (M,) in pixels of the first focal length; camera (8,) as in CAMERA_STEPS."""
    K = np.array([[camera[0], 0, camera[2]], [0, camera[1], camera[3]], [0, 0, 1]])
    x, y = (
        np.column_stack([cv2.undistortPoints(p[:, None], K, camera[4:])[:, 0], np.ones(len(p))])
        for p in (matches.pixels_first, matches.pixels_second)
    )
    T = inverse(poses[matches.second]) @ poses[matches.first]
    t = T[:, :3, 3] / np.linalg.norm(T[:, :3, 3], axis=1, keepdims=True)
    E = skew(t) @ T[:, :3, :3]
    line, back = np.einsum("mij,mj->mi", E, x), np.einsum("mji,mj->mi", E, y)
    gradient = np.sqrt((line[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1))
    return camera[0] * (y * line).sum(axis=1) / gradient


def best(matches: Matches, poses: Array, camera: Array, with_place: bool) -> tuple[Array, Array]:
    """The camera (8,) and the place, a tangent (6,), that fit the poses best."""

    def unpacked(x: Array) -> tuple[Array, Array]:
        place = x[8:] * PLACE_STEPS if with_place else np.zeros(6)
        return camera + x[:8] * CAMERA_STEPS, place

    def residuals(x: Array) -> Array:
        fitted, place = unpacked(x)
        return np.r_[sampson_px(matches, poses @ se3_exp(place), fitted), x / 4]

    start = np.zeros(14 if with_place else 8)
    return unpacked(least_squares(residuals, start, loss="soft_l1", max_nfev=40).x)


def main() -> None:
    """Print both tables in Markdown."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--sequence", type=Path, default=KITCHEN)
    arguments = parser.parse_args()
    run = read_run(arguments.run)
    sequence = open_sequence(arguments.sequence, camera=run.camera)
    options = CalibrateOptions(arguments.run, sequence=arguments.sequence)
    problem, ids = make_problem(options, run, sequence)
    stamps_s = run.keyframe_stamps_s[np.searchsorted(run.tables.keyframes.ids, ids)]
    matches = matches_of(problem.views, stamps_s)
    estimate, reference = associate(
        run.trajectories["trajectory.txt"], read_tum(arguments.sequence / "groundtruth.txt")
    )
    at = nearest_indices(estimate.timestamps_s, stamps_s)
    camera = problem.calibration[:8]
    print(f"{len(matches.first)} matches; Sampson distance, median [px]\n")
    rows = []
    for name, trajectory in (("run", estimate), ("reference", reference)):
        poses = trajectory.poses_world_camera[at]
        tried = [(camera, np.zeros(6))]
        tried += [best(matches, poses, camera, with_place) for with_place in (False, True)]
        medians = (
            np.median(np.abs(sampson_px(matches, poses @ se3_exp(place), fitted)))
            for fitted, place in tried
        )
        rows.append((name, *(f"{median:.2f}" for median in medians)))
    header = ("poses", "with the run's camera", "the best camera", "and the best point beside it")
    print(table(header, rows))
    print(f"\n{errors_by_reference(arguments.run, arguments.sequence, sequence)}")


def errors_by_reference(run: Path, folder: Path, sequence: Sequence) -> str:
    """ATE and RPE of the run and of Open3D's odometry, as a table in Markdown."""
    header = ("estimate", "reference of", "ATE [m]", "RPE a second [m]", "[deg]", "point [m]")
    rows = []
    with TemporaryDirectory() as scratch:
        other = Path(scratch) / "open3d.txt"
        write_tum(other, open3d_odometry(sequence))
        for title, path in (("run", run), ("Open3D hybrid odometry", other)):
            for name, with_body in (("the camera", False), ("a point beside it", True)):
                result = evaluate(path, folder, with_body=with_body)
                place = [f"{result.value(f'body_{axis}'):.3f}" for axis in "xyz" * with_body]
                cells = (f"{result.value(n):.4f}" for n in NAMES)
                rows.append((title, name, *cells, ", ".join(place)))
    return table(header, rows)


def open3d_odometry(sequence: Sequence) -> Trajectory:
    """Every frame registered to the one before by colour and depth up to MAX_DEPTH_M."""
    o3d = load_open3d()
    odometry, camera = o3d.t.pipelines.odometry, sequence.camera
    K, start = o3d.core.Tensor(camera.K), o3d.core.Tensor(np.eye(4))
    criteria = [odometry.OdometryConvergenceCriteria(steps) for steps in (10, 5, 3)]
    poses, before = [np.eye(4)], None
    for index in range(len(sequence)):
        frame = sequence.load(index)
        pair = (frame.rgb, np.nan_to_num(frame.depth_m))
        images = (o3d.t.geometry.Image(o3d.core.Tensor(a)) for a in pair)
        rgbd = o3d.t.geometry.RGBDImage(*images)
        if before is not None:
            found = odometry.rgbd_odometry_multi_scale(
                rgbd, before, K, start, 1.0, MAX_DEPTH_M, criteria, odometry.Method.Hybrid
            )
            poses.append(poses[-1] @ found.transformation.numpy())
        before = rgbd
    return Trajectory(sequence.timestamps_s, np.array(poses))


if __name__ == "__main__":
    main()
