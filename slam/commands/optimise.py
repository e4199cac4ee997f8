"""``bmask-slam optimise``: a run folder or a pose graph, offline."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from bmask_slam.commands.arguments import Commands, add_output_arguments, print_result
from bmask_slam.graph.errors import InputError

if TYPE_CHECKING:
    from bmask_slam.graph.batch.bundle_adjustment import Adjustment
    from bmask_slam.graph.batch.iteration import Progress
    from bmask_slam.graph.pose_graph.optimisation import Method

_Told: TypeAlias = tuple[str, dict[str, Any]]
"""The result as text, and by name for --json."""
TEXT = "optimise a run folder or a graph in g2o format, offline"
MORE = """\
A run folder gets a full bundle adjustment of poses and landmarks, wrong loops and wrong
observations are found and left out, and --out becomes a new run folder with every frame carried
along. So does a g2o file with observations of landmarks, as `bmask-slam export` writes it; it and a
pose graph, 2-D or 3-D, in g2o's or TORO's format, are written to the file --out. Of a folder with
such files (*.g2o, *.graph) and run folders each becomes one in the folder --out; what is done
already with the same input and options is not done again."""


def add_optimise(commands: Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser("optimise", help=TEXT, description=f"{TEXT}. {MORE}")
    parser.set_defaults(handler=_optimise)
    parser.add_argument(
        "input", type=Path, metavar="INPUT", help="run folder, g2o file, or a folder of such"
    )
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="F",
        help="run folder or g2o file to write; of a folder: one for all",
    )
    add_output_arguments(parser, "the output's path")
    _add_graph_options(parser)
    _add_run_options(parser)
    parser.add_argument(
        "--jobs", type=int, metavar="N", help="of a folder: at a time (default: one a core)"
    )
    parser.add_argument(
        "--ray", metavar="ADDRESS", help="of a folder: run on a Ray cluster: address, auto or local"
    )


def _add_graph_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--method",
        choices=("lm", "dogleg", "gnc"),
        help="of a pose graph: lm (default), dogleg, or gnc, which finds wrong loops; odometry is "
        "taken for right",
    )
    parser.add_argument(
        "--repair",
        action="store_true",
        help="of a file: take the nearest positive definite matrix for each information matrix "
        "that is none, and say so",
    )
    parser.add_argument(
        "--certify",
        action="store_true",
        help="of a 3-D pose graph: say whether the optimum is the global one, by GTSAM's Shonan "
        "averaging",
    )


def _add_run_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--reference", type=Path, metavar="GT", help="of a run: print errors before and after"
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="replace the run that --out holds; never the input"
    )
    parser.add_argument(
        "--plot",
        type=Path,
        metavar="F",
        help="picture before/after: png, pdf, svg (a run's default: before_after.png in --out)",
    )


def _optimise(arguments: argparse.Namespace) -> int:
    from bmask_slam.comparison.optimise_folder import is_run_folder
    from bmask_slam.runtime.progress import iteration_bar

    if arguments.input.is_dir() and not is_run_folder(arguments.input):
        return _folder(arguments)
    if arguments.ray or arguments.jobs is not None:
        raise InputError(
            f"--ray, --jobs: are for a folder of graphs or runs; leave them out for "
            f"{arguments.input}"
        )
    work = _run_folder if arguments.input.is_dir() else _file
    with iteration_bar(arguments.quiet) as progress:
        text, told = work(arguments, progress)
    print_result(arguments, arguments.out, lambda: text, {"out": arguments.out} | told)
    return 0


def _folder(arguments: argparse.Namespace) -> int:
    from bmask_slam.comparison.experiment.result import CellStatus
    from bmask_slam.comparison.optimise_folder import (
        FolderOptions,
        format_folder,
        optimise_folder,
    )

    for option in ("reference", "overwrite", "plot"):
        if getattr(arguments, option):
            raise InputError(f"--{option}: is of one run or graph; leave it out for a folder")
    more: tuple[str, ...] = ("--method", arguments.method) if arguments.method else ()
    more += tuple(f"--{name}" for name in ("repair", "certify") if getattr(arguments, name))
    quiet = arguments.quiet
    names = (arguments.input, arguments.out, more, arguments.jobs, arguments.ray, quiet)
    done = optimise_folder(FolderOptions(*names))
    told = {"out": arguments.out, "inputs": {job.name: outcome for job, outcome in done}}
    print_result(arguments, arguments.out, lambda: format_folder(done), told)
    return 0 if all(outcome.status is CellStatus.DONE for _, outcome in done) else 1


def _run_folder(arguments: argparse.Namespace, progress: Progress) -> _Told:
    from bmask_slam.refinement.adjustment import AdjustOptions, adjust_run, format_run_adjustment

    _refuse_method(arguments, "a run folder")
    if arguments.repair:
        raise InputError("--repair: is of graph files; leave it out for a run folder")
    names = ("out", "overwrite", "reference", "plot")
    given = {name: getattr(arguments, name) for name in names}
    result = adjust_run(AdjustOptions(arguments.input, **given), progress=progress)
    text = (
        f"{format_run_adjustment(result)}\n\nRun folder              {result.folder}\n"
        f"Picture                 {result.picture}"
    )
    before, after = ([] if e is None else e.rows for e in result.errors or (None, None))
    errors = {"metrics_before": before, "metrics_after": after}
    return text, _plain_adjustment(result.adjustment) | errors | {"picture": result.picture}


def _file(arguments: argparse.Namespace, progress: Progress) -> _Told:
    from bmask_slam.graph.g2o.landmark_graphs import has_landmarks
    from bmask_slam.refinement.adjustment import format_adjustment
    from bmask_slam.refinement.optimise import (
        GraphOptions,
        adjust_file,
        format_result,
        optimise_file,
    )

    for option in ("reference", "overwrite"):
        if getattr(arguments, option):
            raise InputError(f"--{option}: is of run folders; leave it out for {arguments.input}")
    paths = arguments.input, arguments.out
    if has_landmarks(arguments.input):
        _refuse_method(arguments, "a graph with landmarks")
        adjusted = adjust_file(*paths, arguments.plot, arguments.repair, progress)
        text, told = format_adjustment(*adjusted), _plain_adjustment(adjusted[0])
    else:
        method: Method = arguments.method or "lm"
        options = GraphOptions(method, arguments.repair, arguments.certify, arguments.plot)
        result, certificate = optimise_file(*paths, options, progress)
        text = format_result(result, certificate)
        names = ("method", "start", "initial_cost", "final_cost", "iterations", "duration_ms")
        told = {name: getattr(result, name) for name in names}
        told |= {"outliers": int(result.is_outlier.sum()), "certificate": certificate}
    picture = f"\nPicture        {arguments.plot}" if arguments.plot else ""
    return f"{text}\n\nGraph          {arguments.out}{picture}", told


def _plain_adjustment(done: Adjustment) -> dict[str, Any]:
    """What --json prints of a bundle adjustment."""
    numbers = {"wrong_loops": len(done.wrong_loops), "loops": done.loops}
    numbers |= {"wrong_observations": len(done.wrong_observations)}
    numbers |= {"observations": done.observations}
    return {"stages": done.stages, **numbers, "duration_ms": done.duration_ms}


def _refuse_method(arguments: argparse.Namespace, what: str) -> None:
    if arguments.certify:
        raise InputError(f"--certify: is of pose graphs; leave it out for {what}")
    if arguments.method:
        raise InputError(
            f"--method {arguments.method}: is of pose graphs; {what} is adjusted by lm, its loops "
            "by gnc; leave it out"
        )
