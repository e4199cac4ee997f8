"""Offline optimisation of the public pose graphs, and of two with wrong loops put in.

    python benchmarks/pose_graphs.py [--graphs FOLDER] [--wrong 0.2] [--seeds 0 1 2]

First table: final cost and time of each graph with each method, against GTSAM's own
Levenberg-Marquardt run from the file's poses (or the odometry) and from the chordal solution,
the better of the two. Second: a share of the loop edges is replaced by random ones, and GNC's poses
are compared with the optimum of the undisturbed graph (positions after alignment; RMSE), beside the
optimum of the right edges alone: what was replaced is lost, and no method can know it.
"""

from __future__ import annotations

import argparse
import itertools
import time
from pathlib import Path

import gtsam
import numpy as np

from graph.g2o import read_g2o
from graph.geometry import Array, make_pose, so3_exp
from graph.metrics import align
from graph.pose_graph import PoseGraph, planar_poses, spanning_tree_poses
from graph.pose_graph_factors import chordal_poses, pose_graph_cost
from graph.pose_graph_optimisation import PoseGraphConfig, optimise_pose_graph

FOLDER = Path(__file__).resolve().parents[1] / "../shared/data/posegraphs"
WITH_WRONG_LOOPS = ("sphere2500", "torus3D", "parking-garage")


def plain_cost(graph: PoseGraph) -> float:
    """Final cost of GTSAM's optimiser with its default parameters from the best of two starts."""
    given = graph.poses if graph.has_poses else spanning_tree_poses(graph)
    return min(_plain_cost_from(graph.with_poses(poses)) for poses in (given, chordal_poses(graph)))


def _plain_cost_from(graph: PoseGraph) -> float:
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    between, pose = (
        (gtsam.BetweenFactorPose2, _pose2)
        if graph.is_planar
        else (gtsam.BetweenFactorPose3, gtsam.Pose3)
    )
    for k, T in enumerate(graph.poses):
        values.insert(k, pose(T))
    for (i, j), T, omega in zip(
        graph.edges.tolist(), graph.measurements, graph.information, strict=True
    ):
        factors.add(between(i, j, pose(T), gtsam.noiseModel.Gaussian.Information(omega)))
    prior = gtsam.PriorFactorPose2 if graph.is_planar else gtsam.PriorFactorPose3
    unit = gtsam.noiseModel.Unit.Create(3 if graph.is_planar else 6)
    factors.add(prior(0, pose(graph.poses[0]), unit))
    return float(factors.error(gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()))


def _pose2(T: Array) -> gtsam.Pose2:
    return gtsam.Pose2(T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0]))


def with_wrong_loops(graph: PoseGraph, share: float, rng: np.random.Generator) -> tuple:
    """The graph with this share of its loop edges replaced by random ones, and their mask (M,).

    A wrong edge joins two random vertices by a random rotation, and a translation as long as the
    graph is wide: nothing in it gives it away.
    """
    loops = np.flatnonzero(~graph.is_odometry)
    wrong = rng.choice(loops, round(share * len(loops)), replace=False)
    edges, measurements = graph.edges.copy(), graph.measurements.copy()
    first = rng.integers(0, len(graph.ids), len(wrong))
    step = rng.integers(2, len(graph.ids) - 2, len(wrong))
    edges[wrong] = np.stack([first, (first + step) % len(graph.ids)], axis=1)
    width_m = np.ptp(graph.poses[:, :3, 3], axis=0)
    t = rng.uniform(-0.5, 0.5, (len(wrong), 3)) * width_m
    angle_rad = rng.uniform(-np.pi, np.pi, len(wrong))
    if graph.is_planar:
        measurements[wrong] = planar_poses(np.column_stack([t[:, :2], angle_rad]))
    else:
        axis = rng.normal(size=(len(wrong), 3))
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        measurements[wrong] = make_pose(so3_exp(axis * angle_rad[:, None]), t)
    mask = np.zeros(len(graph.edges), bool)
    mask[wrong] = True
    return (
        PoseGraph(
            graph.ids,
            graph.poses,
            edges,
            measurements,
            graph.information,
            graph.fixed,
            graph.has_poses,
        ),
        mask,
    )


def position_rmse_m(poses: Array, reference: Array) -> float:
    """Positions against positions, after alignment by a rigid transform."""
    points, target = poses[:, :3, 3], reference[:, :3, 3]
    T = align(points, target).T_reference_estimate
    moved = points @ T[:3, :3].T + T[:3, 3]
    return float(np.sqrt(np.mean(np.sum((moved - target) ** 2, axis=1))))


def sphere_truth(file: Path) -> Array:
    """Poses (N, 4, 4) that GTSAM's noise-free EDGE3 lines (x y z roll pitch yaw) chain up to."""
    rows = [line.split()[1:9] for line in file.read_text().splitlines() if line.startswith("EDGE3")]
    values = np.array(rows, float)
    axes = np.eye(3)
    roll, pitch, yaw = (so3_exp(values[:, 5 + k, None] * axes[k]) for k in range(3))
    steps = make_pose(yaw @ pitch @ roll, values[:, 2:5])
    i, j = values[:, :2].astype(int).T
    poses = np.tile(np.eye(4), (j.max() + 1, 1, 1))
    for k in np.flatnonzero(j == i + 1):
        poses[j[k]] = poses[i[k]] @ steps[k]
    return poses


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--graphs", type=Path, default=FOLDER)
    parser.add_argument("--wrong", type=float, default=0.2, help="share of the loop edges")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument(
        "--gnc-alone", action="store_true", help="leave out plain LM, which is slow"
    )
    arguments = parser.parse_args()
    files = sorted(arguments.graphs.glob("*.g2o"))
    graphs = {file.stem: read_g2o(file) for file in files}
    print(
        f"{'graph':16}{'vertices':>9}{'edges':>7}  {'method':8}{'start':9}{'iterations':>10}",
        end="",
    )
    print(f"{'ms':>9}{'initial cost':>15}{'final cost':>14}{'plain GTSAM':>14}{'outliers':>10}")
    for name, graph in graphs.items():
        plain = plain_cost(graph)
        for method in ("lm", "dogleg", "gnc"):
            r = optimise_pose_graph(graph, PoseGraphConfig(method=method))
            print(
                f"{name:16}{len(graph.ids):9}{len(graph.edges):7}  {method:8}{r.start:9}"
                f"{r.iterations:10}{r.duration_ms:9.0f}{r.initial_cost:15.6g}"
                f"{r.final_cost:14.7g}{plain:14.7g}{r.is_outlier.sum():10}",
                flush=True,
            )
    print(f"\nGNC, {100 * arguments.wrong:g} % of the loop edges wrong")
    for name, seed in itertools.product(WITH_WRONG_LOOPS, arguments.seeds):
        print(f"{name:12}seed {seed}")
        wrong_loops(name, graphs[name], arguments, seed)


def wrong_loops(name: str, graph: PoseGraph, arguments: argparse.Namespace, seed: int) -> None:
    """Print how near GNC and plain LM come to the optimum of the undisturbed graph."""
    clean = optimise_pose_graph(graph).graph.poses
    disturbed, wrong = with_wrong_loops(
        graph.with_poses(clean), arguments.wrong, np.random.default_rng(seed)
    )
    disturbed = disturbed.with_poses(graph.poses)
    right = disturbed.with_edges(~wrong)
    reference = optimise_pose_graph(right).graph.poses
    truth_file = arguments.graphs / "gtsam_sphere2500_groundtruth.txt"
    truth = sphere_truth(truth_file) if name == "sphere2500" and truth_file.is_file() else None
    if truth is not None:
        for text, poses in (("clean", clean), ("right edges alone", reference)):
            print(f"{name:12}ATE against the truth, {text}: {position_rmse_m(poses, truth):.4f} m")
    for method in ("gnc",) if arguments.gnc_alone else ("gnc", "lm"):
        begin_s = time.perf_counter()
        r = optimise_pose_graph(disturbed, PoseGraphConfig(method=method))
        print(
            f"{name:12}{method:5}{time.perf_counter() - begin_s:7.1f} s{r.iterations:6} iterations"
            f"  to the clean optimum {position_rmse_m(r.graph.poses, clean):8.4f} m"
            f"  (right edges alone {position_rmse_m(reference, clean):8.4f} m)"
            f"  wrong found {(r.is_outlier & wrong).sum()} of {wrong.sum()}"
            f", right ones taken for wrong {(r.is_outlier & ~wrong).sum()}"
            f"  cost of right edges {pose_graph_cost(right.with_poses(r.graph.poses)):.6g}",
            flush=True,
        )
        if truth is not None:
            ate_m = position_rmse_m(r.graph.poses, truth)
            print(f"{name:12}ATE against the truth, {method}: {ate_m:.4f} m", flush=True)


if __name__ == "__main__":
    main()
