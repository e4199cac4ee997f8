"""Merged maps against exact truth: three walks through a rendered room; rooms that look alike.

``python -m benchmarks.loops.merged_maps FOLDER`` renders, runs and merges in FOLDER, where what is
there already is used again, and prints a line for each merge.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

import bmask_slam
from bmask_slam.evaluation import evaluate_trajectory
from bmask_slam.evaluation.recordings import read_parts
from bmask_slam.graph.trajectory import Trajectory, read_tum
from bmask_slam.rendering import sequence
from bmask_slam.rendering.engine.builder import SceneBuilder
from bmask_slam.rendering.engine.meshes import pose
from bmask_slam.rendering.engine.path import CameraPath
from bmask_slam.rendering.rooms import office
from bmask_slam.rendering.rooms.room import Room, ceiling_lamps, shell

FPS = 15.0
EYES, TARGETS = office.PATH.eyes_world, office.PATH.targets_world
WALKS = {
    "walk1": office.PATH,
    "walk2": CameraPath(EYES[::-1] + np.array([0.1, -0.1, -0.15]), TARGETS[::-1] - [0, 0, 0.1]),
    "walk3": CameraPath(
        EYES[5:0:-1] * [0.9, 0.9, 1] + np.array([0.3, 0.25, 0.12]), TARGETS[5:0:-1]
    ),
}
"""There, back at another height, and a part of it; tremor and noise differ."""


def _shell(b: SceneBuilder, cream_north: bool) -> None:
    plain, brick = office.plaster((170, 190, 160)), office.bricks((120, 104, 92))
    walls = {"north": plain, "east": brick, "south": brick, "west": plain}
    if cream_north:
        walls["north"] = office.plaster((196, 190, 172))
    room = Room(office._WIDTH, office._DEPTH, office._HEIGHT)
    shell(b, room, office.carpet((96, 104, 116), (170, 150, 120)), walls)
    ceiling_lamps(b, office.LIGHTING, office._HEIGHT)


def turned(b: SceneBuilder) -> None:
    """What stands along the north and the south wall has changed places; each thing is the same."""
    _shell(b, cream_north=False)
    across = pose(office._WIDTH, office._DEPTH, 0, 180)
    with b.at(across):
        office._north(b)
    office._west(b)
    with b.at(across):
        office._south(b)
    office._east(b)


def one_wall(b: SceneBuilder) -> None:
    """The north wall is the office's; all else has other colours and stands elsewhere a little."""
    _shell(b, cream_north=True)
    office._north(b)
    b.rng.random(1000)
    office._south(b)
    office._west(b)
    office._east(b)


ROOMS: dict[str, Callable[[SceneBuilder], None]] = {"turned": turned, "one_wall": one_wall}


def render(name: str, folder: Path) -> Path:
    """A walk, or the first walk through another room, as a sequence."""
    out = folder / "sequences" / name
    if out.is_dir():
        return out
    out.parent.mkdir(parents=True, exist_ok=True)
    seed = 10 * (1 + [*WALKS, *ROOMS].index(name))
    plan, built = sequence._plan, sequence._built.__wrapped__

    def changed(config: sequence.RenderConfig) -> sequence._Plan:
        found = plan(config)
        path, furnish = WALKS.get(name, office.PATH), ROOMS.get(name, found.furnish)
        return replace(found, path=path, furnish=furnish)

    with ExitStack() as stack:  # one room, whatever the seed of tremor and noise
        stack.enter_context(patch.object(sequence, "_plan", changed))
        stack.enter_context(
            patch.object(sequence, "_built", lambda c, detail: built(replace(c, seed=0), detail))
        )
        sequence.render_sequence(sequence.RenderConfig("office", seed=seed, fps=FPS), out)
    return out


def run_on(name: str, folder: Path) -> Path:
    """The run of a rendered sequence."""
    out = folder / "runs" / name
    if not (out / "metrics.json").is_file():
        bmask_slam.run(render(name, folder), out, segmenter="none", overwrite=True)
    return out


def ate_m(trajectory: Trajectory, truth: Trajectory) -> float:
    """ATE (RMSE) in metres."""
    return evaluate_trajectory(trajectory, truth).value("ate_rmse")


def joint_truth(merged: Path, folder: Path) -> Trajectory:
    """The truth of all walks, which is in one world, with the stamps of the merged run."""
    truths = [read_tum(folder / "sequences" / name / "groundtruth.txt") for name in WALKS]
    shifts = [part.shift_s for part in read_parts(merged / "recordings.json")]
    stamps_s = [t.timestamps_s + s for t, s in zip(truths, shifts, strict=True)]
    poses = np.concatenate([t.poses_world_camera for t in truths])
    return Trajectory(np.concatenate(stamps_s), poses)


def main() -> None:
    """Render, run, merge, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    runs = [run_on(name, folder) for name in WALKS]
    merged = bmask_slam.merge_runs(*runs, out=folder / "merged", overwrite=True)
    print(
        f"all walks: ATE {1e3 * ate_m(merged.trajectory, joint_truth(merged.path, folder)):.2f} mm"
    )
    for number, (name, alone) in enumerate(zip(WALKS, runs, strict=True), 1):
        truth = read_tum(folder / "sequences" / name / "groundtruth.txt")
        together = read_tum(merged.path / f"trajectory_run_{number}.txt")
        before = ate_m(read_tum(alone / "trajectory.txt"), truth)
        print(f"{name}: ATE alone {1e3 * before:.2f} mm, merged {1e3 * ate_m(together, truth):.2f}")
    for name in ("merge_loops", "merge_loops_wrong", "merge_loop_rms_m", "merge_landmarks_fused"):
        print(f"{name}: {merged.metrics[name].value:g} {merged.metrics[name].unit}")
    for name in ROOMS:
        try:
            bmask_slam.merge_runs(
                runs[0], run_on(name, folder), out=folder / "wrong", overwrite=True
            )
            print(f"{name}: merged, which is wrong")
        except bmask_slam.InputError as error:
            print(f"{name}: refused: {error}")


if __name__ == "__main__":
    main()
