"""Full bundle adjustment of a run folder; the result is a new run folder."""

from __future__ import annotations

import logging
import shutil
from dataclasses import dataclass
from pathlib import Path

from bmask_slam.back_end.frame_adjustment import frames_in
from bmask_slam.evaluation import (
    EvaluationResult,
    Row,
    evaluate_trajectory,
    format_json,
    frame_stamps,
    read_reference,
)
from bmask_slam.evaluation.ate_rpe import clock_of
from bmask_slam.evaluation.plot import plot_trajectory
from bmask_slam.evaluation.recordings import JOINED
from bmask_slam.events import EVENTS, read_events
from bmask_slam.graph.arrays import Arrays
from bmask_slam.graph.batch.bundle_adjustment import Adjustment, AdjustmentConfig, Stage, adjust
from bmask_slam.graph.batch.iteration import Progress
from bmask_slam.graph.batch.joint_adjustment import adjust_jointly
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.array_file import fitting, part
from bmask_slam.graph.files.ply import write_ply
from bmask_slam.graph.files.whole_file import whole_file
from bmask_slam.graph.smoother.isam2 import SolverError
from bmask_slam.graph.smoother.storage import write_graph
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.refinement.adjustment_plot import GraphSnapshot, check_picture, draw_adjustment
from bmask_slam.refinement.carried_along import adjusted_map, move_frames, move_landmarks
from bmask_slam.run_folder.folder import RunFolder
from bmask_slam.run_folder.frame_file import FRAMES
from bmask_slam.run_folder.landmark_file import LANDMARKS_COMMENT
from bmask_slam.run_folder.map_file import MAP, SavedRun, read_map, read_run, write_map
from bmask_slam.run_folder.metrics import EVALUATION_ROWS
from bmask_slam.world.frame_observations import FrameObservations
from bmask_slam.world.map_state import world_of

logger = logging.getLogger(__name__)

PICTURE = "before_after.png"


@dataclass(frozen=True, eq=False)
class RunAdjustment:
    """The result of adjusting a run.

    Attributes:
        folder: the new run folder.
        adjustment: the result of the solver.
        frames: what followed it with the frames that are no keyframes, if anything.
        graph: the keyframes and landmarks after it.
        errors: before and after, against the reference, if there is one.
        picture: the file of the picture before/after.
    """

    folder: Path
    adjustment: Adjustment
    frames: Stage | None
    graph: GraphSnapshot
    errors: tuple[EvaluationResult, EvaluationResult] | None
    picture: Path


@dataclass(frozen=True)
class AdjustOptions:
    """What to adjust, and where to write it.

    Attributes:
        run: the run folder.
        out: the run folder to make.
        overwrite: replace the run in ``out``.
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
    saved = read_map(path) if (path / MAP).is_file() else None  # before ``out`` is replaced
    truth = None
    if options.reference is not None:
        truth = read_reference(options.reference, frame_stamps(path / "trajectory.txt"))
    before = GraphSnapshot.of(run.tables)
    with RunFolder(out, options.overwrite) as folder:
        logger.info("bundle adjustment of %s", path)
        try:
            adjustment = adjust(run.tables, run.camera, run.config, config, progress)
        except InputError as error:
            raise InputError(f"{path / 'graph'}: {error}") from error
        frames = _with_frames(run, saved[0]) if saved else None
        trajectory = _write_run(run, before, adjustment, folder, saved)
        pair = run.trajectories["trajectory.txt"], trajectory
        errors = None if truth is None else _errors(path, pair, truth)
        done = adjustment, frames, GraphSnapshot.of(run.tables), errors
        result = RunAdjustment(folder.path, *done, plot or out / PICTURE)
        folder.write_text("metrics.json", format_json(result_rows(result)))
        picture = folder.path / "trajectory.png"
        plot_trajectory(picture, trajectory, truth, folder.path.name, read_events(path))
        draw_adjustment(result.picture, before, result.graph, adjustment)
        return result


def _errors(
    path: Path, pair: tuple[Trajectory, Trajectory], truth: Trajectory
) -> tuple[EvaluationResult, EvaluationResult]:
    """The errors of a run's trajectory before and after, by the stamps of its recordings."""
    clock = clock_of(path / "trajectory.txt")
    before, after = (evaluate_trajectory(clock.own_trajectory(t), truth) for t in pair)
    return before, after


def _with_frames(run: SavedRun, state: Arrays) -> Stage | None:
    """Adjust the graph with what frames observe that are no keyframes; None if that is not known.

    As at the end of a run (`slam.back_end.frame_adjustment`).
    """
    saved, frames = part(state, "frames"), FrameObservations()
    if not saved:  # of a version that did not keep them
        return None
    with fitting(run.path / MAP):
        frames.restore(saved)
        world = world_of(part(part(state, "mapper"), "world"))
        paths = run.trajectories.values()
        stamps_s, given = frames_in(frames.views, world, run.tables, paths, run.camera)
    if not len(stamps_s):
        return None
    factors = len(run.tables) + len(given.observations)
    try:
        found = adjust_jointly(run.tables, given, run.camera, run.config)
    except SolverError as error:
        logger.warning("frames are left out: %s", error)
        return None
    return Stage("all frames", factors, found.cost_before, found.cost_after, found.steps)


def _write_run(
    run: SavedRun,
    before: GraphSnapshot,
    adjustment: Adjustment,
    folder: RunFolder,
    saved: tuple[Arrays, Camera] | None,
) -> Trajectory:
    """Write the adjusted run, but for figures and pictures; returns its trajectory.

    ``saved`` are state and camera of its map, if it has one.
    """
    stamps_s, poses_before = run.keyframe_stamps_s, before.poses_world_camera
    poses_after = run.tables.keyframes.get(before.keyframe_ids)
    moved = {
        name: move_frames(frames, stamps_s, poses_before, poses_after)
        for name, frames in {**run.trajectories, "keyframes.txt": run.keyframes}.items()
    }
    for name, trajectory in moved.items():
        folder.write_trajectory(trajectory, name)
    for name in (FRAMES, EVENTS, "config.yaml", JOINED):
        if (run.path / name).is_file():
            with whole_file(folder.path / name) as temporary:
                shutil.copyfile(run.path / name, temporary)
    columns = move_landmarks(run.landmarks, before, run.tables, adjustment)
    write_ply(folder.path / "landmarks.ply", columns, LANDMARKS_COMMENT)
    with whole_file(folder.path / "graph") as graph:
        write_graph(graph, run.tables, run.camera)
    if saved:
        state, camera = saved
        state = adjusted_map(state, run.tables, adjustment, camera, run.path / MAP)
        with whole_file(folder.path / MAP) as file:
            write_map(file, state, camera)
    return moved["trajectory.txt"]


def result_rows(result: RunAdjustment) -> list[Row]:
    """Rows for metrics.json: errors after the adjustment, then figures of the solver."""
    done, errors = result.adjustment, []
    if result.errors is not None:
        errors = [row for row in result.errors[1].rows if row["name"] in EVALUATION_ROWS]
    names: tuple[tuple[str, float, str], ...] = (
        ("keyframes", len(result.graph.keyframe_ids), "keyframes"),
        ("landmarks", len(result.graph.landmark_ids), "landmarks"),
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
    """The adjustment as text, with the errors before and after."""
    lines = [format_adjustment(result.adjustment, result.graph, result.frames)]
    for before, after in zip(*(errors.rows for errors in result.errors or ()), strict=True):
        if after["name"] in EVALUATION_ROWS:
            lines.append(
                f"{after['name']:24}{before['value']:.5f} -> {after['value']:.5f} {after['unit']}"
            )
    return "\n".join(lines)


def format_adjustment(done: Adjustment, graph: GraphSnapshot, frames: Stage | None = None) -> str:
    """A few lines: the graph, the costs of each stage, and the outliers."""
    share, last = 0.0, () if frames is None else (frames,)
    if done.observations:
        share = 100 * len(done.wrong_observations) / done.observations
    rows = [
        ("graph", f"{len(graph.keyframe_ids)} keyframes, {len(graph.landmark_ids)} landmarks"),
        *((f"stage {stage.name}", _stage_text(stage)) for stage in (*done.stages, *last)),
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
