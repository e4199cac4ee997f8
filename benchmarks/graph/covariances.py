"""Consistency of covariances: NEES over many synthetic rooms and on a rendered sequence; times.

    python -m benchmarks.graph.covariances [--runs 200] [--sequence runs/bench/living_room]

NEES is the squared error in units of the stated covariance, divided by its degrees of freedom
here: 1 on average if the covariance is right; its square root is the factor by which the sigmas
are too small. The first pose of a room is exact although its prior allows 0.1 mm, so that a NEES of
absolute poses a little below 1 is right. On rendered images it also includes errors without a
factor: of registration, of wrong matches, of noise that is not Gaussian.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from benchmarks.graph.graph_growth import Feeder, run
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.factors.graph_update import GraphUpdate
from bmask_slam.graph.geometry import adjoint, inverse, se3_log
from bmask_slam.graph.smoother.smoother import Smoother, SmootherConfig
from bmask_slam.graph.trajectory import associate_stamps
from bmask_slam.sequences.sequence import open_sequence
from bmask_slam.system import SlamSystem


def nees(errors: Array, covariances: Array) -> Array:
    """Squared errors (N,) in units of covariances (N, D, D), a degree of freedom."""
    solved = np.linalg.solve(covariances, errors[..., None])[..., 0]
    return np.einsum("ni,ni->n", errors, solved) / errors.shape[1]


def session(
    keyframes: int, seed: int, config: SmootherConfig, cull: int = 0
) -> tuple[Feeder, Smoother]:
    """The feeder and smoother of a room after the first of 150 keyframes."""
    arguments = argparse.Namespace(
        keyframes=150, observations=150, landmarks=3000, cull=cull, seed=seed
    )
    feeder = Feeder(arguments)
    return feeder, run(feeder, keyframes, config)[0]


def one_room(seed: int) -> dict[str, float]:
    """NEES of a pose, a landmark, two poses together and the step between them."""
    keyframes = 10
    config = SmootherConfig(robust=False, gate_sigmas=1e3)
    feeder, smoother = session(keyframes, seed, config)
    estimate = smoother.optimise_batch()
    T, T_true = estimate.poses_world_camera, feeder.poses[estimate.keyframe_ids]
    xi = se3_log(inverse(T) @ T_true)
    row = seed % len(estimate.landmark_ids)
    chosen = estimate.landmark_ids[[row]]
    marginals = smoother.marginals(chosen)
    a, b = 1 + seed % (keyframes - 2), keyframes - 1
    joint = smoother.joint_covariance(np.array([a, b]))
    T_a_b = inverse(T[a]) @ T[b]
    J = np.hstack([-adjoint(inverse(T_a_b)), np.eye(6)])
    step = se3_log(inverse(T_a_b) @ inverse(T_true[a]) @ T_true[b])
    off = feeder.points[chosen] - estimate.points_world[[row]]
    return {
        "pose": float(nees(xi[[b]], marginals.keyframes[[b]])[0]),
        "landmark": float(nees(off, marginals.landmarks)[0]),
        "two poses": float(nees(xi[[a, b]].reshape(1, 12), joint[None])[0]),
        "step a-b": float(nees(step[None], (J @ joint @ J.T)[None])[0]),
    }


def monte_carlo(runs: int) -> None:
    """Print the mean of each NEES with the 95 % bounds of that mean."""
    rows = [one_room(seed) for seed in range(runs)]
    print(f"synthetic rooms, {runs} runs: NEES a degree of freedom, its 95 % bounds")
    for name, dof in (("pose", 6), ("landmark", 3), ("two poses", 12), ("step a-b", 6)):
        low, high = chi2.ppf([0.025, 0.975], dof * runs) / (dof * runs)
        print(f"  {name:10s} {np.mean([row[name] for row in rows]):.3f}  [{low:.3f}, {high:.3f}]")


def rendered(folder: Path) -> None:
    """Print the NEES of the keyframes of a run over a rendered sequence, against its truth."""
    sequence = open_sequence(folder)
    system = SlamSystem(sequence.camera)
    for frame in sequence.frames():
        system.process(frame)
    system.finish()
    started_s = time.process_time()
    found = system.keyframe_covariances()
    elapsed_ms = 1e3 * (time.process_time() - started_s)
    keyframes, truth = system.keyframe_trajectory(), sequence.groundtruth
    assert truth is not None
    i, j = associate_stamps(keyframes.timestamps_s, truth.timestamps_s)
    T, T_true = keyframes.poses_world_camera[i], truth.poses_world_camera[j]
    xi = se3_log(inverse(inverse(T[0]) @ T) @ inverse(T_true[0]) @ T_true)[1:]
    covariances = found.covariances[i][1:]
    for name, part in (("pose", slice(0, 6)), ("turn", slice(0, 3)), ("place", slice(3, 6))):
        values = nees(xi[:, part], covariances[:, part, part])
        print(
            f"  {name:10s} mean {values.mean():6.2f}  median {np.median(values):6.2f}  "
            f"sigmas too small by {np.sqrt(values.mean()):.2f}"
        )
    sigma_mm = 1e3 * np.sqrt(np.trace(covariances[-1][3:, 3:]))
    error_mm = 1e3 * np.linalg.norm(xi[-1, 3:])
    print(f"  last keyframe: sigma {sigma_mm:.2f} mm, error {error_mm:.2f} mm")
    print(f"  all {len(found.keyframe_ids)} covariances in {elapsed_ms:.0f} ms of processor time")


def times() -> None:
    """Print the time of a removal and of all covariances in a graph of 150 keyframes."""
    _, smoother = session(150, 0, SmootherConfig(), cull=5)
    rng = np.random.default_rng(0)
    for _ in range(3):
        removed_ids = rng.choice(smoother.estimate().landmark_ids, 100, replace=False)
        started_s = time.process_time()
        estimate = smoother.update(GraphUpdate(remove_landmarks=removed_ids))
        cpu_ms = 1e3 * (time.process_time() - started_s)
        own_ms = estimate.update_ms - estimate.solver_ms
        print(
            f"  100 landmarks out of {estimate.factors} factors: {cpu_ms:.0f} ms, {own_ms:.1f} own"
        )
    started_s = time.process_time()
    count = len(smoother.marginals().keyframe_ids)
    print(f"  covariances of {count} keyframes: {1e3 * (time.process_time() - started_s):.0f} ms")


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--sequence", type=Path, help="rendered, with its truth")
    arguments = parser.parse_args()
    monte_carlo(arguments.runs)
    print("150 keyframes:")
    times()
    if arguments.sequence:
        print(f"{arguments.sequence.name}:")
        rendered(arguments.sequence)


if __name__ == "__main__":
    main()
