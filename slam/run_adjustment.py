"""Full bundle adjustment of a run folder into a new one, with every frame carried along."""

from __future__ import annotations

import logging
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from graph.bundle_adjustment import Adjustment, AdjustmentConfig, Stage, adjust, loop_edges
from graph.errors import InputError
from graph.geometry import Array, inverse, se3_exp, se3_log
from graph.iteration import Progress
from graph.ply import write_ply
from graph.shadow import Shadow
from graph.storage import write_graph
from graph.trajectory import Trajectory
from graph.updates import IntArray
from slam.before_after import View, check_picture, draw_before_after
from slam.evaluation import EvaluationResult, Row, evaluate_trajectory, format_json, read_reference
from slam.evaluation.plot import plot_trajectory, view_plane
from slam.run_folder import RunFolder
from slam.run_results import EVALUATION_ROWS, LANDMARKS_COMMENT
from slam.saved_run import SavedRun, read_run

logger = logging.getLogger(__name__)

PICTURE = "before_after.png"


@dataclass(frozen=True, eq=False)
class RunAdjustment:
    """How the adjustment of a run ended.

    Attributes:
        folder: the new run folder.
        adjustment: what was done.
        keyframes, landmarks: how many there are in the graph.
        errors: before and after, against the reference, if there is one.
        picture: before and after.
    """

    folder: Path
    adjustment: Adjustment
    keyframes: int
    landmarks: int
    errors: tuple[EvaluationResult, EvaluationResult] | None
    picture: Path


@dataclass(frozen=True)
class AdjustOptions:
    """What to adjust and where to put it.

    Attributes:
        run: the run folder.
        out: the run folder to make.
        overwrite: replace the run that ``out`` holds.
        reference: trajectory, or sequence with one, to measure errors against.
        plot: the picture before/after; None: in ``out``.
    """

    run: Path
    out: Path
    overwrite: bool = False
    reference: Path | None = None
    plot: Path | None = None


def adjust_run(
    options: AdjustOptions,
    config: AdjustmentConfig | None = None,
    progress: Progress = lambda iteration, cost: None,
) -> RunAdjustment:
    """Adjust the graph of a run folder and write a run folder with the result.

    Raises:
        InputError: broken input, a graph that cannot be solved, or ``out`` is the input, or holds
            a run already and ``overwrite`` is not set.
    """
    path, out, plot = options.run, options.out, options.plot
    if out.resolve() == path.resolve():
        raise InputError(f"{out}: is the input, which stays as it is; choose another --out")
    if plot is not None:
        check_picture(plot)
    run = read_run(path)
    truth = None if options.reference is None else read_reference(options.reference)
    before = Placed.of(run.shadow)
    with RunFolder(out, options.overwrite) as folder:
        logger.info("bundle adjustment of %s", path)
        try:
            adjustment = adjust(run.shadow, run.camera, run.config, config, progress)
        except InputError as error:
            raise InputError(f"{path / 'graph'}: {error}") from error
        return _write(run, before, adjustment, folder, truth, plot)


@dataclass(frozen=True, eq=False)
class Placed:
    """Where a graph's variables are: ids (K,), poses (K, 4, 4), ids (L,), points (L, 3), loops."""

    keyframe_ids: IntArray
    poses_world_camera: Array
    landmark_ids: IntArray
    points_world: Array
    loops: IntArray

    @classmethod
    def of(cls, shadow: Shadow) -> Placed:
        """A copy that stays when the graph changes."""
        keyframes, landmarks = shadow.keyframes, shadow.landmarks
        return cls(
            keyframes.ids.copy(),
            keyframes.values.copy(),
            landmarks.ids.copy(),
            landmarks.values.copy(),
            loop_edges(shadow),
        )


def _write(
    run: SavedRun,
    before: Placed,
    adjustment: Adjustment,
    folder: RunFolder,
    truth: Trajectory | None,
    plot: Path | None,
) -> RunAdjustment:
    """Fill the new run folder."""
    after = Placed.of(run.shadow)
    moved = run.shadow.keyframes.get(before.keyframe_ids)
    places = run.keyframe_stamps_s, before.poses_world_camera, moved
    carried = {name: carry_along(old, *places) for name, old in run.trajectories.items()}
    for name, trajectory in carried.items():
        folder.write_trajectory(trajectory, name)
    folder.write_trajectory(carry_along(run.keyframes, *places), "keyframes.txt")
    trajectory, errors = carried["trajectory.txt"], None
    if truth is not None:
        both = (run.trajectories["trajectory.txt"], trajectory)
        errors = (evaluate_trajectory(both[0], truth), evaluate_trajectory(both[1], truth))
    for name in ("frames.csv", "config.yaml"):
        if (run.path / name).is_file():
            with folder.replacing(name) as temporary:
                shutil.copyfile(run.path / name, temporary)
    columns = moved_landmarks(run.landmarks, before, run.shadow, adjustment)
    write_ply(folder.path / "landmarks.ply", columns, LANDMARKS_COMMENT)
    with folder.replacing("graph") as graph:
        write_graph(graph, run.shadow, run.camera)
    result = RunAdjustment(
        folder.path,
        adjustment,
        len(after.keyframe_ids),
        len(after.landmark_ids),
        errors,
        plot or folder.path / PICTURE,
    )
    folder.write_text("metrics.json", format_json(result_rows(result)))
    plot_trajectory(folder.path / "trajectory.png", trajectory, truth, folder.path.name)
    _draw(result.picture, before, after, adjustment)
    return result


def carry_along(
    trajectory: Trajectory, stamps_s: Array, poses_before: Array, poses_after: Array
) -> Trajectory:
    """Frames moved with the keyframes, whose poses (K, 4, 4) were and are given.

    Two predictions, each rigid with one of the two keyframes around a frame, are blended by time
    along the geodesic between them: no step where the reference changes. Before the first and
    after the last keyframe there is one. Keyframes that are no frame of this trajectory (stamps
    (K,), NaN among them) have no say.
    """
    own = np.flatnonzero(np.isin(_microseconds(stamps_s), _microseconds(trajectory.timestamps_s)))
    if not len(own):
        return trajectory
    own = own[np.argsort(stamps_s[own])]
    stamps_s, t_s = stamps_s[own], trajectory.timestamps_s
    T_new_old = poses_after[own] @ inverse(poses_before[own])
    left = np.clip(np.searchsorted(stamps_s, t_s, side="right") - 1, 0, len(own) - 1)
    right = np.minimum(left + 1, len(own) - 1)
    by_left, by_right = (T_new_old[k] @ trajectory.poses_world_camera for k in (left, right))
    step_s = np.maximum(stamps_s[right] - stamps_s[left], 1e-9)
    share = np.clip((t_s - stamps_s[left]) / step_s, 0.0, 1.0)
    blended = by_left @ se3_exp(share[:, None] * se3_log(inverse(by_left) @ by_right))
    return Trajectory(t_s, blended)


def _microseconds(stamps_s: Array) -> IntArray:
    """Stamps as the files hold them; -1 for NaN."""
    return np.where(np.isfinite(stamps_s), np.rint(stamps_s * 1e6), -1.0).astype(np.int64)


def moved_landmarks(
    columns: dict[str, NDArray], before: Placed, shadow: Shadow, adjustment: Adjustment
) -> dict[str, NDArray]:
    """Columns of landmarks.ply after the adjustment; landmarks that were dropped are left out.

    A landmark outside the graph moves rigidly with the first keyframe that sees its nearest
    neighbour inside, since the run folder does not say which keyframe made it.
    """
    columns = {name: column.copy() for name, column in columns.items()}
    ids = columns["id"].astype(np.int64)
    points = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(float)
    inside = shadow.landmarks.contains(ids)
    dropped = np.isin(ids, adjustment.dropped_landmarks)
    outside = np.flatnonzero(~inside & ~dropped)
    if inside.any() and len(outside):
        points[outside] = _moved_with_neighbours(points[outside], before, shadow)
    points[inside] = shadow.landmarks.get(ids[inside])
    for axis, values in zip("xyz", points.T, strict=True):
        columns[axis] = values.astype(columns[axis].dtype)
    left, views = np.unique(adjustment.wrong_observations[:, 1], return_counts=True)
    _, at, which = np.intersect1d(ids, left, return_indices=True)
    columns["observations"][at] -= views[which].astype(columns["observations"].dtype)
    return {name: column[~dropped] for name, column in columns.items()}


def _moved_with_neighbours(points: Array, before: Placed, shadow: Shadow) -> Array:
    """Points (N, 3) moved with the first observer of the nearest landmark of the graph."""
    seen = shadow.observations.select(shadow.observations.all_rows())  # by keyframe
    landmark_ids, first = np.unique(seen.landmark_ids, return_index=True)
    observer = seen.keyframe_ids[first]
    where = before.points_world[np.searchsorted(before.landmark_ids, landmark_ids)]
    _, nearest = KDTree(where).query(points)
    keyframes = observer[nearest]
    T_old = before.poses_world_camera[np.searchsorted(before.keyframe_ids, keyframes)]
    T_new_old = shadow.keyframes.get(keyframes) @ inverse(T_old)
    return (T_new_old[:, :3, :3] @ points[..., None])[..., 0] + T_new_old[:, :3, 3]


def result_rows(result: RunAdjustment) -> list[Row]:
    """Rows for metrics.json: errors after, then what the adjustment did."""
    done, errors = result.adjustment, []
    if result.errors is not None:
        errors = [row for row in result.errors[1].rows if row["name"] in EVALUATION_ROWS]
    names: tuple[tuple[str, float, str], ...] = (
        ("keyframes", result.keyframes, "keyframes"),
        ("landmarks", result.landmarks, "landmarks"),
        ("cost_initial", done.initial_cost, "1/2 chi2"),
        ("cost_final", done.final_cost, "1/2 chi2"),
        ("iterations", done.iterations, "steps"),
        ("loops", done.loops, "edges"),
        ("wrong_loops", len(done.wrong_loops), "edges"),
        ("wrong_observations", len(done.wrong_observations), "observations"),
        ("adjustment_ms", done.duration_ms, "ms"),
    )
    return errors + [{"name": name, "value": value, "unit": unit} for name, value, unit in names]


def format_adjustment(result: RunAdjustment) -> str:
    """A few lines on what was adjusted, from where, and how it ended."""
    done, share = result.adjustment, 0.0
    if done.observations:
        share = 100 * len(done.wrong_observations) / done.observations
    rows = [
        ("graph", f"{result.keyframes} keyframes, {result.landmarks} landmarks"),
        *((f"stage {stage.name}", _stage_text(stage)) for stage in done.stages),
        ("wrong loops", f"{len(done.wrong_loops)} of {done.loops}, left out"),
        ("wrong views", f"{len(done.wrong_observations)} of {done.observations} ({share:.2f} %)"),
        ("time", f"{done.duration_ms:.0f} ms"),
    ]
    if result.errors is not None:
        before, after = result.errors
        rows += [
            (name, f"{before.value(name):.4f} -> {after.value(name):.4f}")
            for name in EVALUATION_ROWS
            if any(row["name"] == name for row in after.rows)
        ]
    return "\n".join(f"{name:24}{value}" for name, value in rows)


def _stage_text(stage: Stage) -> str:
    return (
        f"cost {stage.cost_before:.6g} -> {stage.cost_after:.6g}, {stage.iterations} steps, "
        f"{stage.factors} factors"
    )


def _draw(path: Path, before: Placed, after: Placed, adjustment: Adjustment) -> None:
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
