"""What a bundle adjustment did, as text and as a picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bmask_slam.evaluation.plot import view_plane
from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.batch.bundle_adjustment import Adjustment, Stage, loop_edges
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.refinement.adjustment_plot import View, draw_before_after


@dataclass(frozen=True, eq=False)
class Placed:
    """Where a graph's variables are: ids (K,), poses (K, 4, 4), ids (L,), points (L, 3), loops."""

    keyframe_ids: Ints
    poses_world_camera: Array
    landmark_ids: Ints
    points_world: Array
    loops: Ints

    @classmethod
    def of(cls, tables: FactorTables) -> Placed:
        """A copy that stays when the graph changes."""
        keyframes, landmarks = tables.keyframes, tables.landmarks
        return cls(
            keyframes.ids.copy(),
            keyframes.values.copy(),
            landmarks.ids.copy(),
            landmarks.values.copy(),
            loop_edges(tables),
        )


def format_adjustment(done: Adjustment, placed: Placed) -> str:
    """A few lines on what was adjusted, from where, and how it ended."""
    share = 0.0
    if done.observations:
        share = 100 * len(done.wrong_observations) / done.observations
    rows = [
        ("graph", f"{len(placed.keyframe_ids)} keyframes, {len(placed.landmark_ids)} landmarks"),
        *((f"stage {stage.name}", _stage_text(stage)) for stage in done.stages),
        ("wrong loops", f"{len(done.wrong_loops)} of {done.loops}, left out"),
        ("wrong views", f"{len(done.wrong_observations)} of {done.observations} ({share:.2f} %)"),
        ("time", f"{done.duration_ms:.0f} ms"),
    ]
    return "\n".join(f"{name:24}{value}" for name, value in rows)


def _stage_text(stage: Stage) -> str:
    return (
        f"cost {stage.cost_before:.6g} -> {stage.cost_after:.6g}, {stage.iterations} steps, "
        f"{stage.factors} factors"
    )


def draw_adjustment(path: Path, before: Placed, after: Placed, adjustment: Adjustment) -> None:
    """Path, loops (wrong ones red) and landmarks, seen along the axis of least motion."""
    plane = view_plane(after.poses_world_camera[:, :3, 3])
    ends = np.arange(len(before.keyframe_ids))
    path_edges = np.stack([ends[:-1], ends[1:]], axis=1)
    views = []
    for state, cost, title in (
        (before, adjustment.initial_cost, "before"),
        (after, adjustment.final_cost, "after"),
    ):
        loops = np.searchsorted(before.keyframe_ids, state.loops)
        wrong = np.searchsorted(before.keyframe_ids, adjustment.wrong_loops)
        edges = [(path_edges, "tab:blue", 0.9), (loops, "tab:green", 0.6)]
        edges += [(wrong, "tab:red", 0.6)] if state is before else []
        positions = state.poses_world_camera[:, :3, 3][:, plane]
        cloud, axes = state.points_world[:, plane], "".join("xyz"[k] for k in plane)
        views.append(View(f"{title}, cost {cost:.5g}", positions, edges, cloud, axes))
    draw_before_after(path, *views)
