"""Time of a graph update as a session grows: a synthetic room, walked round one and a half times.

    python -m benchmarks.graph.graph_growth [--keyframes 150] [--observations 150] [--cull 5]

Prints the median and 95th percentile of an update, and the part of it that is spent outside
GTSAM's own update and read-back (checks, ids, making factors).
"""

from __future__ import annotations

import argparse
import dataclasses

import numpy as np

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.graph_estimate import GraphEstimate
from bmask_slam.graph.factors.graph_update import GraphUpdate, Observations
from bmask_slam.graph.geometry import inverse, make_pose, se3_exp, se3_log, transform
from bmask_slam.graph.smoother.smoother import Smoother, SmootherConfig

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
NOISE_PX = 0.7
TURNS = 1.5


def walk(count: int) -> Array:
    """Poses (K, 4, 4) on a circle of 1 m, looking outwards, y down."""
    angle = 2 * np.pi * TURNS * np.arange(count) / count
    z = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    y = np.broadcast_to([0.0, 1.0, 0.0], z.shape)
    return make_pose(np.stack([np.cross(y, z), y, z], axis=2), z)


def walls(count: int, rng: np.random.Generator) -> Array:
    """Points (N, 3) on and before the walls of a room about 6 m wide."""
    angle, radius_m = rng.uniform(0, 2 * np.pi, count), rng.uniform(2.2, 4.0, count)
    height_m = rng.uniform(-1.2, 1.2, count)
    return np.stack([radius_m * np.sin(angle), height_m, radius_m * np.cos(angle)], axis=1)


class Feeder:
    """Makes one update per keyframe like a front end: old landmarks first, then new ones."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.rng = np.random.default_rng(args.seed)
        self.poses = walk(args.keyframes)
        self.points = walls(args.landmarks, self.rng)
        self.per_keyframe, self.cull = args.observations, args.cull
        self.known: Ints = np.zeros(0, np.int64)

    def update(self, k: int, estimate: GraphEstimate | None) -> GraphUpdate:
        """The update of keyframe k; its initial pose carries the last one's error and more."""
        T = self._initial_pose(k, estimate)
        points_camera = transform(inverse(self.poses[k]), self.points)
        z = CAMERA.project_stereo(points_camera)
        visible = (points_camera[:, 2] > 0.4) & (z[:, 0] > 0) & (z[:, 0] < 640)
        visible &= (z[:, 1] > 0) & (z[:, 1] < 480)
        ids = np.flatnonzero(visible)
        is_old = np.isin(ids, self.known)
        chosen = np.concatenate([self.rng.permutation(ids[is_old]), ids[~is_old]])
        chosen = np.sort(chosen[: self.per_keyframe])
        z = self._noisy(z[chosen])
        new = ~np.isin(chosen, self.known)
        depth_m = CAMERA.stereo_bf_px_m / np.maximum(z[new, 0] - z[new, 2], 4.0)
        points_world = transform(T, CAMERA.backproject(z[new, :2], depth_m))
        culled = self._culled(estimate)
        chosen_new = chosen[new]
        self.known = np.setdiff1d(np.union1d(self.known, chosen_new), culled)
        keep = ~np.isin(chosen, culled)
        observations = Observations(
            np.full(len(chosen), k), chosen, z, np.full((len(chosen), 3), NOISE_PX)
        )
        return GraphUpdate(
            np.array([k]),
            T[None],
            chosen_new,
            points_world,
            observations.select(keep),
            remove_landmarks=culled,
        )

    def _noisy(self, z: Array) -> Array:
        """Noise of u, v and disparity; u_right = u_left - disparity carries two of them."""
        noise = self.rng.normal(0, NOISE_PX, z.shape)
        noise[:, 2] = noise[:, 0] - noise[:, 2]
        return z + noise

    def _initial_pose(self, k: int, estimate: GraphEstimate | None) -> Array:
        if estimate is None:
            return self.poses[k]
        step = inverse(self.poses[k - 1]) @ self.poses[k]
        noise = se3_exp(self.rng.normal(0, [0.001] * 3 + [0.003] * 3))
        return estimate.poses_world_camera[-1] @ step @ noise

    def _culled(self, estimate: GraphEstimate | None) -> Ints:
        if estimate is None or not self.cull:
            return np.zeros(0, np.int64)
        return self.rng.choice(estimate.landmark_ids, self.cull, replace=False)


def run(
    feeder: Feeder, keyframes: int, config: SmootherConfig
) -> tuple[Smoother, list[GraphEstimate]]:
    """The smoother after the first keyframes of a feeder, and every update's estimate."""
    smoother, estimates = Smoother(CAMERA, config), list[GraphEstimate]()
    for k in range(keyframes):
        last = estimates[-1] if estimates else None
        estimates.append(smoother.update(feeder.update(k, last)))
    return smoother, estimates


def report(smoother: Smoother, estimates: list[GraphEstimate], poses: Array) -> None:
    """Print times, sizes and errors."""
    total = np.array([e.update_ms for e in estimates])
    own = total - np.array([e.solver_ms for e in estimates])
    half = len(total) // 2
    last = estimates[-1]
    print(
        f"keyframes {len(last.keyframe_ids)}  landmarks {len(last.landmark_ids)}  "
        f"factors {last.factors}  rebuilt {sum(e.rebuilt for e in estimates)}  "
        f"refused {sum(len(e.refused) for e in estimates)}"
    )
    for name, ms in (("update", total), ("second half", total[half:]), ("outside GTSAM", own)):
        low, high = np.percentile(ms, [50, 95])
        print(f"{name:14s} median {low:7.2f} ms   p95 {high:7.2f} ms   max {ms.max():7.2f} ms")
    print(f"share outside GTSAM {own.sum() / total.sum():.1%}")
    batch = smoother.optimise_batch()
    for name, estimate in (("incremental", last), ("batch", batch)):
        xi = se3_log(inverse(poses[estimate.keyframe_ids]) @ estimate.poses_world_camera)
        rms_mm = 1e3 * np.sqrt(np.mean(np.sum(xi[:, 3:] ** 2, axis=1)))
        print(f"{name:14s} error {rms_mm:.2f} mm")
    print(f"batch {batch.update_ms:.0f} ms, cost {batch.cost_before:.1f} -> {batch.cost_after:.1f}")


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--keyframes", type=int, default=150)
    parser.add_argument("--observations", type=int, default=150, help="at most, a keyframe")
    parser.add_argument("--landmarks", type=int, default=3000, help="in the room")
    parser.add_argument("--cull", type=int, default=5, help="landmarks removed a keyframe")
    parser.add_argument("--relinearize-threshold", type=float, default=None)
    parser.add_argument("--relinearize-skip", type=int, default=None)
    parser.add_argument("--extra-iterations", type=int, default=None)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    names = ("relinearize_threshold", "relinearize_skip", "extra_iterations")
    given = {n: getattr(args, n) for n in names if getattr(args, n) is not None}
    config = dataclasses.replace(SmootherConfig(), **given)
    smoother, estimates = run(Feeder(args), args.keyframes, config)
    report(smoother, estimates, walk(args.keyframes))


if __name__ == "__main__":
    main()
