"""A long session, simulated: a path of five rounds in a building, with marginalised landmarks.

    python -m benchmarks.graph.long_session [--keyframes 2000] [--measurements 100] [--out DIR]

Each keyframe measures 100 landmarks with noise as in the red kitchen. At a known place a loop is
added first, then its landmarks are matched again, and keyframes whose landmarks are seen by enough
others are culled, as in a run (``--keep-all``: they are not). All updates go through
``Smoother.update`` as in a run. Afterwards all marginalised landmarks are restored, and the session
is compared with the optimum of that full graph. ``--full N`` also measures the first N keyframes
without marginalisation.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks.graph.building import CAMERA, landmarks, visible, walk
from benchmarks.graph.pose_graphs import position_rmse_m
from bmask_slam.back_end.factor_selection import FactorSelectionConfig
from bmask_slam.back_end.landmark_management import MappingConfig
from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.factors.graph_estimate import GraphEstimate
from bmask_slam.graph.factors.graph_update import GraphUpdate, Observations, RelativePose
from bmask_slam.graph.geometry import inverse, se3_exp, transform
from bmask_slam.graph.smoother.smoother import Smoother
from bmask_slam.runtime.memory import peak_rss_mb

SIGMAS_PX = np.array([1.0, 1.0, 0.2])
"""Of u, v and disparity, as in the red kitchen (docs/architecture.md)."""
STEP_SIGMAS = np.array([0.001] * 3 + [0.003] * 3)
LOOP_SIGMAS = np.array([0.002] * 3 + [0.01] * 3)
FEED, RULES = FactorSelectionConfig(), MappingConfig()
GAP = 40
"""Number of keyframes after which a landmark counts as matched again rather than tracked."""
FOUND = 0.8
"""Share of the visible landmarks that a keyframe detects."""
PER_ROUND, PER_M2 = 400, 14.0
COLUMNS = ("update_ms", "solver_ms", "keyframes", "landmarks", "factors", "ate_m", "rss_mb")


class FrontEnd:
    """Makes one update a keyframe as the real front end would."""

    def __init__(self, args: argparse.Namespace, marginalise: bool) -> None:
        self.rng = np.random.default_rng(args.seed)
        self.poses = walk(-(-max(args.keyframes, args.full) // PER_ROUND), PER_ROUND, self.rng)
        self.points, self.on_wall = landmarks(PER_M2, self.rng)
        self.measurements, self.marginalise = args.measurements, marginalise
        self.culls = not args.keep_all
        self.observed_ids: list[Ints] = []  # none of a keyframe that was culled
        self.observers = np.zeros(len(self.points), np.int64)
        self.last_observed = np.full(len(self.points), -1)
        self.loops: list[tuple[int, int]] = []
        self._in_known_place = False

    def update(self, k: int, estimate: GraphEstimate | None, bases: set[int]) -> GraphUpdate:
        """The update of keyframe k; its initial pose carries the last one's error and more."""
        T = self._initial_pose(k, estimate)
        known = np.zeros(0, np.int64) if estimate is None else estimate.landmark_ids
        ids, z = self._measure(k)
        loops, ids, z = self._recognise(k, ids, z)
        self.observed_ids.append(ids)
        self.observers[ids] += 1
        self.last_observed[ids] = k
        new = ~np.isin(ids, known)
        depth_m = CAMERA.stereo_bf_px_m / np.maximum(z[new, 0] - z[new, 2], 4.0)
        points = transform(T, CAMERA.backproject(z[new, :2], depth_m))
        sigmas = np.tile(SIGMAS_PX, (len(ids), 1))
        return GraphUpdate(
            np.array([k]),
            T[None],
            ids[new],
            points,
            Observations(np.full(len(ids), k), ids, z, sigmas),
            relative_poses=loops,
            marginalise_landmarks=self._outside_window(known) if self.marginalise else known[:0],
            remove_keyframes=self._redundant(k, bases) if self.culls else known[:0],
        )

    def _redundant(self, k: int, bases: set[int]) -> Ints:
        """The youngest keyframe around keyframe k that is redundant, as ``Mapper`` culls it."""
        kept = {0, *(end for loop in self.loops for end in loop), *bases}
        here = np.zeros(len(self.points), bool)
        here[self.observed_ids[k]] = True
        for other in range(k - 3, 0, -1):
            ids = self.observed_ids[other]
            if other in kept or np.count_nonzero(here[ids]) < FEED.window_min_shared:
                continue
            if (self.observers[ids] > RULES.redundant_views).mean() > RULES.redundant_share:
                self.observers[ids] -= 1
                self.observed_ids[other] = ids[:0]
                return np.array([other])
        return np.zeros(0, np.int64)

    def _measure(self, k: int) -> tuple[Ints, Array]:
        """Some visible landmarks, the last observed first, and their noisy measurements."""
        ids, z = visible(self.poses[k], self.points, self.on_wall)
        detected = self.rng.random(len(ids)) < FOUND
        ids, z = ids[detected], z[detected]
        order = np.lexsort((self.rng.random(len(ids)), -self.last_observed[ids]))
        chosen = np.sort(order[: self.measurements])
        noise = self.rng.normal(0, SIGMAS_PX, (len(chosen), 3))
        noise[:, 2] = noise[:, 0] - noise[:, 2]
        return ids[chosen], z[chosen] + noise

    def _recognise(
        self, k: int, ids: Ints, z: Array
    ) -> tuple[tuple[RelativePose, ...], Ints, Array]:
        """A loop at the begin of a known place, whose landmarks are matched from then on."""
        again = (self.last_observed[ids] >= 0) & (self.last_observed[ids] < k - GAP)
        if self._in_known_place or again.mean() < 0.5:
            self._in_known_place &= bool(again.any())
            return (), ids, z
        self._in_known_place = True
        shared = [
            int(np.isin(observed_ids, ids[again]).sum())
            for observed_ids in self.observed_ids[: k - GAP]
        ]
        old = int(np.argmax(shared))
        noise = se3_exp(self.rng.normal(0, LOOP_SIGMAS))
        T_old_new = inverse(self.poses[old]) @ self.poses[k] @ noise
        loop = RelativePose(old, k, T_old_new, np.diag(LOOP_SIGMAS**2), "dcs", "loop")
        self.loops.append((old, k))
        return (loop,), ids[~again], z[~again]

    def _outside_window(self, in_graph: Ints) -> Ints:
        """As ``back_end.factor_selection.FactorSelector`` chooses what marginalise."""
        estimated = np.zeros(len(self.points), bool)
        estimated[self.observed_ids[-1]] = True
        shared = np.array([np.count_nonzero(estimated[ids]) for ids in self.observed_ids])
        near = np.lexsort((-np.arange(len(shared)), -shared))[: FEED.window_keyframes]
        active = [
            self.observed_ids[i] for i in near.tolist() if shared[i] >= FEED.window_min_shared
        ]
        waiting = np.setdiff1d(in_graph, np.concatenate([self.observed_ids[-1], *active]))
        return waiting if len(waiting) >= FEED.marginalise_batch else waiting[:0]

    def _initial_pose(self, k: int, estimate: GraphEstimate | None) -> Array:
        if estimate is None:
            return self.poses[k]
        step = inverse(self.poses[estimate.keyframe_ids[-1]]) @ self.poses[k]
        return estimate.poses_world_camera[-1] @ step @ se3_exp(self.rng.normal(0, STEP_SIGMAS))


def ate_m(estimate: GraphEstimate, poses: Array) -> float:
    """RMSE (m) of the keyframes' positions after alignment by a rigid transform."""
    return position_rmse_m(estimate.poses_world_camera, poses[estimate.keyframe_ids])


def session(
    args: argparse.Namespace, marginalise: bool, count: int
) -> tuple[Smoother, FrontEnd, GraphEstimate, Array]:
    """Run a session of ``count`` keyframes; returns also the rows (K, 7) of COLUMNS."""
    front, smoother = FrontEnd(args, marginalise), Smoother(CAMERA)
    estimate, rows = None, []
    for k in range(count):
        bases = smoother.tables.marginalised.bases
        estimate = smoother.update(front.update(k, estimate, bases))
        error_m = ate_m(estimate, front.poses) if k % 50 == 49 else np.nan
        sizes = len(estimate.keyframe_ids), len(estimate.landmark_ids), estimate.factors
        rows.append((estimate.update_ms, estimate.solver_ms, *sizes, error_m, peak_rss_mb()))
        if k % 50 == 49:
            sys.stderr.write(f"\r{k + 1} of {count} keyframes, {rows[-1][0]:.0f} ms ")
    sys.stderr.write("\n")
    assert estimate is not None
    return smoother, front, estimate, np.array(rows)


def quarters(rows: Array) -> list[dict[str, float]]:
    """Times and sizes of each quarter of the session."""
    size = len(rows) // 4
    return [
        {
            "keyframes": (i + 1) * size,
            "update_median_ms": float(np.median(part[:, 0])),
            "update_p95_ms": float(np.percentile(part[:, 0], 95)),
            "update_max_ms": float(part[:, 0].max()),
            "solver_median_ms": float(np.median(part[:, 1])),
            "kept": float(part[-1, 2]),
            "landmarks": float(part[-1, 3]),
            "factors": float(part[-1, 4]),
            "ate_mm": 1e3 * float(part[np.isfinite(part[:, 5]), 5][-1]),
            "peak_rss_mb": float(part[-1, 6]),
        }
        for i, part in enumerate(rows[k * size : (k + 1) * size] for k in range(4))
    ]


def table(lines: list[dict[str, float]]) -> str:
    """The quarters as text."""
    heads = list(lines[0])
    rows = ["  ".join(f"{head:>16}" for head in heads)]
    rows += ["  ".join(f"{line[head]:16.1f}" for head in heads) for line in lines]
    return "\n".join(rows)


def plot(rows: Array, full: Array, path: Path) -> None:
    """Plot update times over the session, and those without marginalisation if measured."""
    figure = Figure(figsize=(9, 3.6), dpi=120, layout="constrained")
    axis = figure.subplots()
    for data, colour, text in (
        (full, "#d6302a", "full graph"),
        (rows, "#1f5fa8", "marginalisation"),
    ):
        if len(data):
            axis.plot(data[:, 0], ".", color=colour, ms=2, alpha=0.5, label=text)
    axis.set(xlabel="keyframe", ylabel="graph update (ms)", ylim=(0, None))
    axis.grid(alpha=0.25, lw=0.5)
    axis.legend(frameon=False)
    figure.savefig(path)


def main() -> None:
    """Parse, walk, compare, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--keyframes", type=int, default=2000, help="in all five rounds")
    parser.add_argument("--measurements", type=int, default=100, help="new ones a keyframe")
    parser.add_argument("--keep-all", action="store_true", help="cull no redundant keyframe")
    parser.add_argument("--full", type=int, default=0, help="keyframes without marginalisation")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/bench"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    smoother, front, estimate, rows = session(args, True, args.keyframes)
    lines = quarters(rows)
    print(table(lines))
    ratio = lines[3]["update_p95_ms"] / lines[1]["update_p95_ms"]
    print(f"p95 of the last quarter over that of the second: {ratio:.2f}")
    print(f"loops {len(front.loops)}, peak memory {lines[-1]['peak_rss_mb']:.0f} MB")
    started_s = time.perf_counter()
    optimum = smoother.optimise_batch()
    batch_s = time.perf_counter() - started_s
    own_mm, full_mm = (1e3 * ate_m(e, front.poses) for e in (estimate, optimum))
    _, a, b = np.intersect1d(estimate.keyframe_ids, optimum.keyframe_ids, return_indices=True)
    poses = estimate.poses_world_camera[a], optimum.poses_world_camera[b]
    apart_mm = 1e3 * position_rmse_m(*poses)
    print(f"ATE {own_mm:.2f} mm, full graph's optimum {full_mm:.2f} mm, apart {apart_mm:.2f} mm")
    print(f"full graph: {optimum.factors} factors, {batch_s:.0f} s in batch")
    full = session(args, False, args.full)[3] if args.full else np.zeros((0, len(COLUMNS)))
    if len(full):
        same = rows[: len(full)]
        for text, data in (
            ("without marginalisation", full),
            ("with it, the same keyframes", same),
        ):
            last = data[-len(data) // 4 :, 0]
            print(f"{text}: last quarter p95 {np.percentile(last, 95):.1f} ms")
    result = {
        "quarters": lines,
        "p95_ratio": ratio,
        "ate_mm": own_mm,
        "ate_full_graph_mm": full_mm,
        "apart_mm": apart_mm,
        "factors_full_graph": optimum.factors,
        "batch_s": batch_s,
        "update_ms_full_graph": full[:, 0].tolist(),
    }
    (args.out / "long_session.json").write_text(json.dumps(result, indent=1), encoding="utf-8")
    plot(rows, full, args.out / "long_session.png")


if __name__ == "__main__":
    main()
