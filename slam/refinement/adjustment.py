"""Full bundle adjustment of a run folder into a new one, with every frame carried along."""

from __future__ import annotations

import logging
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from bmask_slam.evaluation import (
    EvaluationResult,
    Row,
    evaluate_trajectory,
    format_json,
    frame_stamps,
    read_reference,
)
from bmask_slam.evaluation.plot import plot_trajectory
from bmask_slam.graph.arrays import Array, Arrays, Ints
from bmask_slam.graph.batch.bundle_adjustment import Adjustment, AdjustmentConfig, adjust
from bmask_slam.graph.batch.iteration import Progress
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.files.ply import write_ply
from bmask_slam.graph.geometry import inverse, se3_exp, se3_log
from bmask_slam.graph.smoother.storage import write_graph
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.refinement.adjustment_plot import check_picture
from bmask_slam.refinement.adjustment_report import Placed, draw_adjustment, format_adjustment
from bmask_slam.refinement.optimised_map import optimised_map
from bmask_slam.run_folder.folder import RunFolder
from bmask_slam.run_folder.landmark_file import LANDMARKS_COMMENT
from bmask_slam.run_folder.map_file import MAP, SavedRun, read_map, read_run, write_map
from bmask_slam.run_folder.metrics import EVALUATION_ROWS

logger = logging.getLogger(__name__)

PICTURE = "before_after.png"


@dataclass(frozen=True, eq=False)
class RunAdjustment:
    """How the adjustment of a run ended.

    Attributes:
        folder: the new run folder.
        adjustment: what was done.
        placed: the graph's keyframes and landmarks after it.
        errors: before and after, against the reference, if there is one.
        picture: before and after.
    """

    folder: Path
    adjustment: Adjustment
    placed: Placed
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
    truth = None
    if options.reference is not None:
        truth = read_reference(options.reference, frame_stamps(path / "trajectory.txt"))
    before = Placed.of(run.tables)
    with RunFolder(out, options.overwrite) as folder:
        logger.info("bundle adjustment of %s", path)
        try:
            adjustment = adjust(run.tables, run.camera, run.config, config, progress)
        except InputError as error:
            raise InputError(f"{path / 'graph'}: {error}") from error
        return _write(run, before, adjustment, folder, truth, plot)


def _write(
    run: SavedRun,
    before: Placed,
    adjustment: Adjustment,
    folder: RunFolder,
    truth: Trajectory | None,
    plot: Path | None,
) -> RunAdjustment:
    """Fill the new run folder."""
    after = Placed.of(run.tables)
    moved = run.tables.keyframes.get(before.keyframe_ids)
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
    columns = moved_landmarks(run.landmarks, before, run.tables, adjustment)
    write_ply(folder.path / "landmarks.ply", columns, LANDMARKS_COMMENT)
    with folder.replacing("graph") as graph:
        write_graph(graph, run.tables, run.camera)
    if (run.path / MAP).is_file():
        state, camera = read_map(run.path)
        state = optimised_map(state, run.tables, adjustment, camera, run.path / MAP)
        with folder.replacing(MAP) as file:
            write_map(file, state, camera)
    result = RunAdjustment(
        folder.path,
        adjustment,
        after,
        errors,
        plot or folder.path / PICTURE,
    )
    folder.write_text("metrics.json", format_json(result_rows(result)))
    plot_trajectory(folder.path / "trajectory.png", trajectory, truth, folder.path.name)
    draw_adjustment(result.picture, before, after, adjustment)
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


def _microseconds(stamps_s: Array) -> Ints:
    """Stamps as the files hold them; -1 for NaN."""
    return np.where(np.isfinite(stamps_s), np.rint(stamps_s * 1e6), -1.0).astype(np.int64)


def moved_landmarks(
    columns: Arrays, before: Placed, tables: FactorTables, adjustment: Adjustment
) -> Arrays:
    """Columns of landmarks.ply after the adjustment; landmarks that were dropped are left out.

    A landmark outside the graph moves rigidly with the first keyframe that sees its nearest
    neighbour inside, since the run folder does not say which keyframe made it.
    """
    columns = {name: column.copy() for name, column in columns.items()}
    ids = columns["id"].astype(np.int64)
    points = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(float)
    inside = tables.landmarks.contains(ids)
    dropped = np.isin(ids, adjustment.dropped_landmarks)
    outside = np.flatnonzero(~inside & ~dropped)
    if inside.any() and len(outside):
        points[outside] = _moved_with_neighbours(points[outside], before, tables)
    points[inside] = tables.landmarks.get(ids[inside])
    for axis, values in zip("xyz", points.T, strict=True):
        columns[axis] = values.astype(columns[axis].dtype)
    left, views = np.unique(adjustment.wrong_observations[:, 1], return_counts=True)
    _, at, which = np.intersect1d(ids, left, return_indices=True)
    columns["observations"][at] -= views[which].astype(columns["observations"].dtype)
    return {name: column[~dropped] for name, column in columns.items()}


def _moved_with_neighbours(points: Array, before: Placed, tables: FactorTables) -> Array:
    """Points (N, 3) moved with the first observer of the nearest landmark of the graph."""
    seen = tables.observations.select(tables.observations.all_rows())  # by keyframe
    landmark_ids, first = np.unique(seen.landmark_ids, return_index=True)
    observer = seen.keyframe_ids[first]
    where = before.points_world[np.searchsorted(before.landmark_ids, landmark_ids)]
    _, nearest = KDTree(where).query(points)
    keyframes = observer[nearest]
    T_old = before.poses_world_camera[np.searchsorted(before.keyframe_ids, keyframes)]
    T_new_old = tables.keyframes.get(keyframes) @ inverse(T_old)
    return (T_new_old[:, :3, :3] @ points[..., None])[..., 0] + T_new_old[:, :3, 3]


def result_rows(result: RunAdjustment) -> list[Row]:
    """Rows for metrics.json: errors after, then what the adjustment did."""
    done, errors = result.adjustment, []
    if result.errors is not None:
        errors = [row for row in result.errors[1].rows if row["name"] in EVALUATION_ROWS]
    names: tuple[tuple[str, float, str], ...] = (
        ("keyframes", len(result.placed.keyframe_ids), "keyframes"),
        ("landmarks", len(result.placed.landmark_ids), "landmarks"),
        ("cost_initial", done.initial_cost, "1/2 chi2"),
        ("cost_final", done.final_cost, "1/2 chi2"),
        ("iterations", done.iterations, "steps"),
        ("loops", done.loops, "edges"),
        ("wrong_loops", len(done.wrong_loops), "edges"),
        ("wrong_observations", len(done.wrong_observations), "observations"),
        ("adjustment_ms", done.duration_ms, "ms"),
    )
    return errors + [{"name": name, "value": value, "unit": unit} for name, value, unit in names]


def format_run_adjustment(result: RunAdjustment) -> str:
    """What was done, and the errors before and after."""
    lines = [format_adjustment(result.adjustment, result.placed)]
    for before, after in zip(*(errors.rows for errors in result.errors or ()), strict=True):
        if after["name"] in EVALUATION_ROWS:
            lines.append(
                f"{after['name']:24}{before['value']:.5f} -> {after['value']:.5f} {after['unit']}"
            )
    return "\n".join(lines)
