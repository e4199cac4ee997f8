"""How much of a path's error closing its loops can take away, from the graphs of two finished runs.

    python -m benchmarks.loops.loop_limits CLOSED OPEN --reference CORRIDOR [--focal-error 0.01]

CLOSED and OPEN are run folders of one sequence, with loops closed and without. Their graphs are
adjusted with the right camera and with a wrong focal length, in which observations then contradict
each other as those of a badly calibrated camera do. Beside the loops that were found stand loops
that are exact: the true relative pose, with a hundredth of the sigmas. What those leave, no loop at
these places can remove. The expected ATE is that of draws from the posterior of the whole graph.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import splu

from benchmarks.graph.pose_graphs import aligned_errors_m
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.batch.bundle_adjustment import AdjustmentConfig, adjust, loop_numbers
from bmask_slam.graph.factors.graph_update import RelativePose
from bmask_slam.graph.factors.gtsam_factors import FactorMaker, make_graph, make_values
from bmask_slam.graph.factors.keys import keyframe_keys, landmark_keys
from bmask_slam.graph.geometry import inverse, se3_log
from bmask_slam.graph.trajectory import nearest_indices, read_tum
from bmask_slam.run_folder.map_file import SavedRun, read_run

EXACT = 1e-4  # of a loop's covariance
DRAWS = 60


def true_poses(run: SavedRun, reference: Path) -> Array:
    """T_world_camera (K, 4, 4) of the keyframes in the reference's world."""
    truth = read_tum(reference / "groundtruth.txt")
    at = nearest_indices(truth.timestamps_s, run.keyframe_stamps_s)
    return truth.poses_world_camera[at]


def make_loops_exact(run: SavedRun, truth: Array) -> None:
    """Put the true relative poses in place of the loops, without a kernel."""
    row = {k: i for i, k in enumerate(run.tables.keyframes.ids.tolist())}
    for number in loop_numbers(run.tables):
        entry = run.tables.pose_factors[number]
        assert isinstance(entry.factor, RelativePose)
        a, b = (truth[row[k]] for k in (entry.factor.keyframe_a, entry.factor.keyframe_b))
        exact = replace(
            entry.factor,
            T_a_b=inverse(a) @ b,
            covariance=EXACT * entry.factor.covariance,
            robust=None,
        )
        run.tables.pose_factors[number] = replace(entry, factor=exact)


def rmse_mm(errors_m: Array) -> float:
    return float(1e3 * np.sqrt(np.mean(np.sum(errors_m**2, axis=-1))))


def without_deformation(errors_m: Array, truth: Array) -> Array:
    """What an affine map of the plane of the path leaves of the errors (K, 3).

    Scale and shear keep a closed path closed, whatever the loops say.
    """
    place = truth[:, :3, 3] - truth[:, :3, 3].mean(axis=0)
    plane = np.linalg.svd(place, full_matrices=False)[2][:2]
    columns = np.column_stack([place @ plane.T, np.ones(len(place))])
    return errors_m - columns @ np.linalg.lstsq(columns, errors_m, rcond=None)[0]


def expected_ate_mm(run: SavedRun) -> float:
    """ATE that the posterior of the run's graph promises, RMS of draws from it."""
    tables, maker = run.tables, FactorMaker(run.camera, run.config)
    observations = tables.observations.all()
    factors: list[Any] = maker.observations(observations)
    factors += [maker.pose_factor(entry.factor) for entry in tables.pose_factors.values()]
    keyframes, landmarks = tables.keyframes, tables.landmarks
    values = make_values(keyframes.ids, keyframes.values, landmarks.ids, landmarks.values)
    x = _draws(make_graph(factors).linearize(values))
    keys = keyframe_keys(keyframes.ids)
    all_keys = [*keys, *landmark_keys(landmarks.ids)]
    sizes = dict.fromkeys(map(int, all_keys), 3) | dict.fromkeys(map(int, keys), 6)
    ordered = sorted(sizes)
    starts = dict(zip(ordered, np.cumsum([0, *(sizes[key] for key in ordered)]), strict=False))
    rows = np.array([starts[int(key)] for key in keys])[:, None] + np.arange(3, 6)
    moved = np.einsum("kij,kjs->ski", keyframes.values[:, :3, :3], x[rows])
    squares = []
    for shift in moved:
        poses = keyframes.values.copy()
        poses[:, :3, 3] += shift
        squares.append(rmse_mm(aligned_errors_m(poses, keyframes.values)) ** 2)
    return float(np.sqrt(np.mean(squares)))


def _draws(linear: gtsam.GaussianFactorGraph) -> Array:
    """Draws (n, DRAWS) of all tangents, in the order of the keys: see
    graph/pose_graph/loop_prediction.py."""
    i, j, entries = linear.sparseJacobian_()
    i, j = i.astype(np.int64) - 1, j.astype(np.int64) - 1
    left = j < j.max()
    A = csr_array((entries[left], (i[left], j[left])), shape=(i.max() + 1, j.max()))
    symmetric = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
    factor = splu(csc_array(A.T @ A), permc_spec="MMD_AT_PLUS_A", **symmetric)
    noise = np.random.default_rng(0).normal(size=(A.shape[0], DRAWS))
    return np.asarray(factor.solve(A.T @ noise))


def line(title: str, run: SavedRun, truth: Array, focal_error: float) -> None:
    """Adjust a run's graph with a camera, and print what became of its errors."""
    camera = run.camera
    camera = replace(camera, fx=camera.fx * (1 + focal_error), fy=camera.fy * (1 + focal_error))
    adjust(run.tables, camera, run.config, AdjustmentConfig(drop_observations=False))
    poses = run.tables.keyframes.values
    errors_m = aligned_errors_m(poses, truth)
    gap = se3_log(inverse(inverse(truth[0]) @ truth[-1]) @ inverse(poses[0]) @ poses[-1])
    gap_deg, gap_mm = np.degrees(np.linalg.norm(gap[:3])), 1e3 * np.linalg.norm(gap[3:])
    expected = "" if focal_error else f"{expected_ate_mm(run):10.1f}"
    print(
        f"{100 * focal_error:+5.0f} %  {title:14}{rmse_mm(errors_m):10.2f}"
        f"{rmse_mm(without_deformation(errors_m, truth)):22.2f}"
        f"{gap_deg:12.2f}{gap_mm:10.1f}{expected}",
        flush=True,
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("closed", type=Path)
    parser.add_argument("open", type=Path)
    parser.add_argument("--reference", type=Path, required=True, help="sequence folder")
    parser.add_argument("--focal-error", type=float, default=0.01)
    arguments = parser.parse_args()
    print("focal    loops            ATE mm   without scale, shear   gap deg    gap mm  expected")
    for focal_error in (0.0, arguments.focal_error):
        for title in ("none", "as found", "exact"):
            run = read_run(arguments.open if title == "none" else arguments.closed)
            truth = true_poses(run, arguments.reference)
            if title == "exact":
                make_loops_exact(run, truth)
            line(title, run, truth, focal_error)


if __name__ == "__main__":
    main()
