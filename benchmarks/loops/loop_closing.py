"""What closed loops bring on a sequence that comes back, and what wrong ones cost.

    python -m benchmarks.loops.loop_closing CORRIDOR [--focal-error 0.01] [--seeds 3]

Up to the first loop all variants are the same, so the sequence is run to there once, and each goes
on from that state. In "wrong beside right" as many wrong loops as right ones are proposed; in
"wrong ones let in" each also passes the check of pairwise consistency, and the graph alone is left
to refute it. A wrong focal length makes the trajectory drift as a badly calibrated camera does.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from bmask_slam.config.configuration import resolve
from bmask_slam.evaluation import evaluate_trajectory
from bmask_slam.graph.arrays import Arrays
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.loops.closing import LoopCloser
from bmask_slam.loops.verification import LoopConstraint
from bmask_slam.sequences.sequence import Sequence, open_sequence
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.world.covisibility import CovisiblePaths
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.world_map import WorldMap

SNAPSHOT_FRAMES = 50
TURN_RAD, SHIFT_M = 0.5, 2.0  # sigmas of a wrong loop, an axis


class WrongLoops:
    """Proposes a random loop beside every right one; ``let_in`` passes it as confirmed."""

    def __init__(self, closer: LoopCloser, seed: int, let_in: bool):
        self._rng = np.random.default_rng(seed)
        self._propose, self._confirm = closer.propose, closer.confirm
        self._wrong: list[LoopConstraint] = []
        self.let_in, self.count = let_in, 0
        closer.propose, closer.confirm = self.propose, self.confirm  # type: ignore[method-assign]

    def propose(
        self, keyframe: Keyframe, world: WorldMap, paths: CovisiblePaths | None = None
    ) -> list[LoopConstraint]:
        right = self._propose(keyframe, world, paths)
        old = [k for k in world.keyframes if k < keyframe.id - 10]
        noise = np.repeat([TURN_RAD, SHIFT_M], 3)
        self._wrong = [
            replace(
                loop,
                keyframe_a=int(self._rng.choice(old)),
                T_a_b=se3_exp(self._rng.normal(size=6) * noise),
                landmark_pairs=np.zeros((0, 2), np.int64),
            )
            for loop in right
        ]
        self.count += len(self._wrong)
        return right if self.let_in else [*right, *self._wrong]

    def confirm(
        self, proposed: list[LoopConstraint], world: WorldMap, paths: CovisiblePaths | None = None
    ) -> list[LoopConstraint]:
        confirmed = self._confirm(proposed, world, paths)
        return [*confirmed, *self._wrong] if self.let_in else confirmed


def state_before_loops(system: SlamSystem, sequence: Sequence) -> tuple[Arrays, int]:
    """The system's state some frames before its first proposal, and the next frame's index."""
    proposed: list[LoopConstraint] = []
    closer = system.mapper.loops
    propose = closer.propose

    def spy(
        keyframe: Keyframe, world: WorldMap, paths: CovisiblePaths | None = None
    ) -> list[LoopConstraint]:
        proposed.extend(propose(keyframe, world, paths))
        return proposed

    closer.propose = spy  # type: ignore[method-assign]
    state, begin = system.state(), 0
    for frame in sequence.frames(0, len(sequence), 1):
        if frame.index % SNAPSHOT_FRAMES == 0:
            state, begin = system.state(), frame.index
        system.process(frame)
        if proposed:
            return state, begin
    return state, begin


def go_on(
    system: SlamSystem, sequence: Sequence, start: tuple[Arrays, int], title: str
) -> dict[str, float]:
    """Run the rest of the sequence from a state, finish, print and return a line of figures."""
    state, begin = start
    system.restore(state, Path(title))
    for frame in sequence.frames(begin, len(sequence), 1):
        system.process(frame)
    system.finish()
    trajectory, truth = system.trajectory(), sequence.groundtruth
    assert truth is not None
    rows = {r["name"]: float(r["value"]) for r in evaluate_trajectory(trajectory, truth).rows}
    loops = system.mapper.smoother.relative_pose_errors("loop")
    rows["loops"] = len(loops.chi2)
    print(
        f"{title:45} ATE {1e3 * rows['ate_rmse']:7.2f} mm  RPE/s "
        f"{1e3 * rows['rpe_trans_rmse_second']:6.2f} mm  loops in the graph {rows['loops']:2.0f}",
        flush=True,
    )
    return rows


def compare(sequence: Sequence, focal_error: float, seeds: int) -> None:
    """All variants with one camera."""
    camera = sequence.camera
    camera = replace(camera, fx=camera.fx * (1 + focal_error), fy=camera.fy * (1 + focal_error))
    config = resolve(SystemConfig, None, ())
    start = state_before_loops(SlamSystem(camera, config), sequence)
    print(f"focal length {100 * focal_error:+.1f} %; first loop after frame {start[1]}")
    off = SlamSystem(camera, resolve(SystemConfig, None, ("loops.enabled=false",)))
    without = go_on(off, sequence, start, "no loops")
    closed = go_on(SlamSystem(camera, config), sequence, start, "loops closed")
    print(f"  ratio of ATE: {closed['ate_rmse'] / without['ate_rmse']:.2f}")
    for let_in in (False, True):
        for seed in range(seeds):
            system = SlamSystem(camera, config)
            wrong = WrongLoops(system.mapper.loops, seed, let_in)
            name = "wrong ones let in" if let_in else "wrong beside right"
            with_wrong_loops = go_on(system, sequence, start, f"{name}, seed {seed}")
            change = with_wrong_loops["ate_rmse"] / closed["ate_rmse"] - 1
            print(f"  {wrong.count} wrong loops; change of ATE {100 * change:+.1f} %", flush=True)


def main() -> None:
    """Compare with the right focal length and with a wrong one."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--focal-error", type=float, default=0.01)
    parser.add_argument("--seeds", type=int, default=3)
    arguments = parser.parse_args()
    sequence = open_sequence(arguments.folder)
    compare(sequence, 0.0, arguments.seeds)
    compare(sequence, arguments.focal_error, 1)


if __name__ == "__main__":
    main()
