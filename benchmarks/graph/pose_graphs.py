"""Offline optimisation of the public pose graphs, and of two with wrong loops put in.

    python -m benchmarks.graph.pose_graphs [--graphs FOLDER] [--wrong 0.2] [--seeds 5]
        [--methods lm dogleg gnc]

First table: final cost and processor time of each graph with each method, against GTSAM's own
Levenberg-Marquardt run from the file's poses (or the odometry) and from the chordal solution (3-D:
GTSAM's), the time of which counts: the faster of those that reach the lower cost. Times of lm and
of GTSAM are the best of three. For 3-D graphs also what ``--certify`` says. Second: a share of the
loop edges is replaced by random ones. GNC's poses are compared with the optimum of the right edges
alone (RMSE of positions after alignment), and both with the optimum of the undisturbed graph. The
information of the replaced edges is lost: the increase of the expected ATE follows from the
covariances of the two optima, and for sphere2500 from GTSAM's ground truth. In the last column the
random edges are added and none is replaced.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np

from benchmarks.paths import SHARED
from bmask_slam.graph.arrays import Array, Mask
from bmask_slam.graph.g2o.pose_graphs import read_g2o
from bmask_slam.graph.geometry import make_pose, so3_exp, transform
from bmask_slam.graph.metrics import align
from bmask_slam.graph.pose_graph.certificate import certify
from bmask_slam.graph.pose_graph.chordal import chordal_poses
from bmask_slam.graph.pose_graph.factors import make_factors, make_gauge, make_values
from bmask_slam.graph.pose_graph.loop_prediction import pose_draws
from bmask_slam.graph.pose_graph.optimisation import Method, PoseGraphConfig, optimise_pose_graph
from bmask_slam.graph.pose_graph.pose_graph import PoseGraph, planar_poses, spanning_tree_poses

FOLDER = SHARED / "posegraphs"
REPEATS = 3
METHODS: tuple[Method, ...] = ("lm", "dogleg", "gnc")


def plain(graph: PoseGraph) -> tuple[float, float]:
    """Final cost and seconds of GTSAM's optimiser with its default parameters from the best start.

    Not counted: making factors and values in Python.
    """
    given = graph.poses if graph.has_poses else spanning_tree_poses(graph)
    found = [_plain_from(graph.with_poses(given), start) for start in ("given", "chordal")]
    lowest = min(cost for cost, _ in found)
    return min((entry for entry in found if entry[0] <= lowest * (1 + 1e-5)), key=lambda e: e[1])


def _plain_from(graph: PoseGraph, start: str) -> tuple[float, float]:
    factors, values = make_factors(graph), make_values(graph, graph.poses)
    factors.push_back(make_gauge(graph))
    times_s = []
    for _ in range(REPEATS):
        begin_s = time.process_time()
        initial = values
        if start == "chordal" and graph.is_planar:
            initial = make_values(graph, chordal_poses(graph))
        elif start == "chordal":
            initial = gtsam.InitializePose3.initialize(factors)
        optimum = gtsam.LevenbergMarquardtOptimizer(factors, initial).optimize()
        times_s.append(time.process_time() - begin_s)
    return float(factors.error(optimum)), min(times_s)


def with_wrong_loops(
    graph: PoseGraph, share: float, rng: np.random.Generator
) -> tuple[PoseGraph, Mask]:
    """The graph with this share of its loop edges replaced by random ones, and their mask (M,).

    A wrong edge joins two random vertices by a random rotation, and a translation as long as the
    graph is wide, so that it cannot be recognised by itself.
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
    return replace(graph, edges=edges, measurements=measurements), mask


def with_added(graph: PoseGraph, other: PoseGraph, mask: Mask) -> PoseGraph:
    """The graph with the edges of another under a mask (M,) beside its own."""
    more = other.with_edges(mask)
    return replace(
        graph,
        edges=np.concatenate([graph.edges, more.edges]),
        measurements=np.concatenate([graph.measurements, more.measurements]),
        information=np.concatenate([graph.information, more.information]),
    )


def aligned_errors_m(poses: Array, reference: Array) -> Array:
    """Errors (K, 3) of positions after alignment by a rigid transform."""
    points, target = poses[:, :3, 3], reference[:, :3, 3]
    return transform(align(points, target).T_reference_estimate, points) - target


def position_rmse_m(poses: Array, reference: Array) -> float:
    """RMSE of positions after alignment by a rigid transform."""
    return float(np.sqrt(np.mean(np.sum(aligned_errors_m(poses, reference) ** 2, axis=1))))


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


def expected_ate_m(graph: PoseGraph, used: Mask) -> float:
    """ATE by the covariance of an optimum of the ``used`` edges, from draws."""
    columns = slice(0, 2) if graph.is_planar else slice(3, 6)
    squares = []
    for tangents in pose_draws(graph, used)[:, :, columns]:
        moved = graph.poses.copy()
        R = moved[:, :3, : tangents.shape[1]]
        moved[:, :3, 3] += (R @ tangents[..., None])[..., 0]
        squares.append(position_rmse_m(moved, graph.poses) ** 2)
    return float(np.sqrt(np.mean(squares)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--graphs", type=Path, default=FOLDER)
    parser.add_argument("--wrong", type=float, default=0.2, help="share of the loop edges")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS)
    arguments = parser.parse_args()
    files = sorted(arguments.graphs.glob("*.g2o"))
    graphs = {file.stem: read_g2o(file) for file in files}
    compare_methods(graphs, arguments.methods)
    if not arguments.seeds:
        return
    print(f"\nGNC, {100 * arguments.wrong:g} % of the loop edges wrong; distances in mm")
    print(f"{'graph':16}{'seed':>4}{'wrong':>7}{'found':>7}{'right, out':>12}{'ms':>8}", end="")
    print(f"{'to right alone':>16}{'to clean':>10}{'right alone to clean':>22}", end="")
    print(f"{'expected ATE':>14}{'added: to clean':>17}")
    for (name, graph), seed in itertools.product(graphs.items(), range(arguments.seeds)):
        if (~graph.is_odometry).sum() * arguments.wrong >= 1:
            wrong_loops(name, graph, arguments, seed)


def compare_methods(graphs: dict[str, PoseGraph], methods: Sequence[Method]) -> None:
    """Print the first table."""
    print(f"{'graph':16}{'vertices':>9}{'edges':>7}  {'method':8}{'start':9}{'steps':>6}", end="")
    print(f"{'ms':>7}{'plain ms':>9}{'ratio':>7}{'initial cost':>15}{'final cost':>14}", end="")
    print(f"{'plain GTSAM':>14}{'outliers':>10}  certificate")
    for name, graph in graphs.items():
        plain_cost, plain_s = plain(graph)
        for method in methods:
            times_s = []
            for _ in range(REPEATS if method == "lm" else 1):
                begin_s = time.process_time()
                r = optimise_pose_graph(graph, PoseGraphConfig(method=method))
                times_s.append(time.process_time() - begin_s)
            certified = "" if method != "lm" or graph.is_planar else certify(r).status
            print(
                f"{name:16}{len(graph.ids):9}{len(graph.edges):7}  {method:8}{r.start:9}"
                f"{r.iterations:6}{1e3 * min(times_s):7.0f}{1e3 * plain_s:9.0f}"
                f"{min(times_s) / plain_s:7.2f}{r.initial_cost:15.6g}{r.final_cost:14.7g}"
                f"{plain_cost:14.7g}{r.is_outlier.sum():10}  {certified}",
                flush=True,
            )


def wrong_loops(name: str, graph: PoseGraph, arguments: argparse.Namespace, seed: int) -> None:
    """Print distances between the optima of GNC, the right edges and the clean graph."""
    clean = optimise_pose_graph(graph).graph
    disturbed, wrong = with_wrong_loops(clean, arguments.wrong, np.random.default_rng(seed))
    disturbed = replace(disturbed, poses=graph.poses, has_poses=graph.has_poses)
    right = optimise_pose_graph(disturbed.with_edges(~wrong)).graph
    r = optimise_pose_graph(disturbed, PoseGraphConfig(method="gnc"))
    added = optimise_pose_graph(with_added(graph, disturbed, wrong), PoseGraphConfig(method="gnc"))
    rise = expected_ate_m(clean, ~wrong) / expected_ate_m(clean, np.ones(len(wrong), bool)) - 1
    print(
        f"{name:16}{seed:4}{wrong.sum():7}{(r.is_outlier & wrong).sum():7}"
        f"{(r.is_outlier & ~wrong).sum():12}{r.duration_ms:8.0f}"
        f"{1e3 * position_rmse_m(r.graph.poses, right.poses):16.3f}"
        f"{1e3 * position_rmse_m(r.graph.poses, clean.poses):10.1f}"
        f"{1e3 * position_rmse_m(right.poses, clean.poses):22.1f}{100 * rise:+13.1f}%"
        f"{1e3 * position_rmse_m(added.graph.poses, clean.poses):17.3f}",
        flush=True,
    )
    truth_file = arguments.graphs / "gtsam_sphere2500_groundtruth.txt"
    if name == "sphere2500" and truth_file.is_file():
        truth = sphere_truth(truth_file)
        of = {"clean": clean, "right edges alone": right, "GNC": r.graph}
        ate = {text: 1e3 * position_rmse_m(g.poses, truth) for text, g in of.items()}
        texts = (f"{text} {mm:.1f} ({mm / ate['clean'] - 1:+.1%})" for text, mm in ate.items())
        print(f"{'':20}ATE against the truth: {', '.join(texts)}", flush=True)


if __name__ == "__main__":
    main()
