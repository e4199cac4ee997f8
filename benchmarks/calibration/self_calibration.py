"""Self-calibration from a wrong camera with known truth: parameters found, and errors of runs.

    python -m benchmarks.calibration.self_calibration --out DIR [--kitchen FOLDER]

Renders an office with a sweeping camera and late depth, runs on it with focal lengths and depth
scale 3 % off, the principal point 6 px off and the delay unknown, calibrates (reference: the exact
trajectory), runs again with the camera that was found, calibrates and runs once more. Then the red
kitchen, whose camera is an estimate. Its reference is of a program that tracked depth images only,
and is the path of a point beside the camera (see kitchen_reference.py): it is calibrated twice in
turn and evaluated with that lever arm estimated too (``--hand-eye``), in runs with different
numbers of keypoints. Tables in Markdown.
"""

from __future__ import annotations

import argparse
import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.pages import table
from benchmarks.paths import KITCHEN
from bmask_slam.calibration.calibrate import CalibrateOptions, calibrate_run
from bmask_slam.calibration.report import Calibrated, format_calibration
from bmask_slam.config.configuration import resolve
from bmask_slam.evaluation import evaluate
from bmask_slam.graph.calibration.model import NORMAL_95, PARAMETERS, parameters_of
from bmask_slam.graph.camera import Camera
from bmask_slam.offline.runner import RunOptions, run
from bmask_slam.rendering.config import RenderConfig
from bmask_slam.rendering.sequence import render_sequence
from bmask_slam.sequences.cameras import read_camera, write_camera
from bmask_slam.system_config import SystemConfig

KEYPOINTS = (800, 825, 850, 875, 900)
DELAY_S = 0.010
FOCAL_SHARE, CENTRE_PX, DEPTH_SHARE = 0.03, 6.0, 0.03
ERRORS = {
    "ate_rmse": "ATE [m]",
    "rpe_trans_rmse_frame": "RPE a frame [m]",
    "rpe_trans_rmse_second": "a second [m]",
    "rpe_trans_rmse_metre": "a metre [m]",
    "rpe_rot_rmse_frame": "a frame [deg]",
    "rpe_rot_rmse_second": "a second [deg]",
    "rpe_rot_rmse_metre": "a metre [deg]",
}


def main() -> None:
    """Render, run, calibrate, run again, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("runs/bench/calibration"))
    parser.add_argument("--scene", default="office")
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--steady", action="store_true", help="without the sweeping motion")
    parser.add_argument("--kitchen", type=Path, default=KITCHEN)
    arguments = parser.parse_args()
    out = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    sequence = out / ("steady" if arguments.steady else "sweeping")
    if not sequence.is_dir():
        config = RenderConfig(
            arguments.scene,
            arguments.frames,
            depth_delay_ms=1e3 * DELAY_S,
            sweeping=not arguments.steady,
        )
        render_sequence(config, sequence)
    truth = replace(read_camera(sequence / "camera.yaml"), depth_time_offset_s=DELAY_S)
    write_camera(out / "true.yaml", truth)
    write_camera(out / "wrong.yaml", wrong_camera(truth))
    cameras = ("true", "wrong", "found", "found again")
    errors = {name: errors_of(sequence, out, name) for name in cameras[:2]}
    for before, after in itertools.pairwise(cameras[1:]):
        path = out / f"{after}.yaml"
        done = calibrate_run(
            CalibrateOptions(out / before, path, reference=sequence, overwrite=True)
        )
        errors[after] = errors_of(sequence, out, after)
        print(f"From a run with the {before} camera:\n\n{table_of_parameters(done, truth)}\n")
    print(table_of_errors(errors))
    if arguments.kitchen.is_dir():
        kitchen(arguments.kitchen, out)


def kitchen(sequence: Path, out: Path) -> None:
    """Print the calibration of a real camera, and the errors before and after."""
    write_camera(out / "given.yaml", read_camera(sequence / "camera.yaml"))
    cameras = ("given", "calibrated", "calibrated again")
    for before, after in itertools.pairwise(cameras):
        errors_of(sequence, out, before)
        path = out / f"{after}.yaml"
        done = calibrate_run(
            CalibrateOptions(out / before, path, reference=sequence, on_body=True, overwrite=True)
        )
        print(f"\nRed kitchen, run with the {before} camera:\n\n{format_calibration(done)}\n")
    print("Mean of the runs and its standard error:\n")
    lines = []
    for camera in cameras:
        runs = [repeated(sequence, out, camera, keypoints) for keypoints in KEYPOINTS]
        for title, with_body in (("the camera", False), ("a point beside it", True)):
            rows = [evaluate(path, sequence, with_body=with_body) for path in runs]
            values = np.array([[row.value(name) for name in ERRORS] for row in rows])
            spread = values.std(axis=0, ddof=1) / np.sqrt(len(runs))
            pairs = zip(values.mean(axis=0), spread, strict=True)
            lines.append((f"{camera}, {title}", *(f"{m:.4f} ± {sigma:.4f}" for m, sigma in pairs)))
    print(table(("camera, reference of", *ERRORS.values()), lines))


def repeated(sequence: Path, out: Path, camera: str, keypoints: int) -> Path:
    """A run with that camera and at most ``keypoints`` keypoints a frame."""
    config = resolve(SystemConfig, None, (f"features.max_keypoints={keypoints}",))
    path = out / f"{camera}-{keypoints}"
    run_with(sequence, config, out / f"{camera}.yaml", path)
    return path


def run_with(sequence: Path, config: SystemConfig, camera: Path, out: Path) -> None:
    """A run with a camera file and without self-calibration."""
    options = RunOptions(sequence, config, camera=camera, out=out)
    run(replace(options, calibrate="off", overwrite=True, quiet=True))


def wrong_camera(truth: Camera) -> Camera:
    """The camera from which the calibration starts."""
    return replace(
        truth,
        fx=truth.fx * (1 + FOCAL_SHARE),
        fy=truth.fy * (1 + FOCAL_SHARE),
        cx=truth.cx + CENTRE_PX,
        cy=truth.cy - CENTRE_PX,
        depth_scale=truth.depth_scale * (1 + DEPTH_SHARE),
        depth_time_offset_s=0.0,
    )


def errors_of(sequence: Path, out: Path, name: str) -> dict[str, float]:
    """ERRORS of a run with the camera ``name``.yaml."""
    run_with(sequence, SystemConfig(), out / f"{name}.yaml", out / name)
    rows = evaluate(out / name, sequence).rows
    return {row["name"]: float(row["value"]) for row in rows if row["name"] in ERRORS}


def table_of_parameters(done: Calibrated, truth: Camera) -> str:
    """Truth, start, result, error and 95 % bound of each parameter, in its own unit."""
    true = parameters_of(truth, done.before.depth_scale)
    start = parameters_of(done.before, done.before.depth_scale)
    found = done.result.calibration
    rows = []
    for i in np.flatnonzero(done.prior_sigmas > 0):
        error, bound = found[i] - true[i], NORMAL_95 * done.sigmas[i]
        numbers = (f"{x:.5g}" for x in (true[i], start[i], found[i], error, bound))
        rows.append((PARAMETERS[i], *numbers, "yes" if abs(error) <= bound else "no"))
    header = ("parameter", "truth", "start", "found", "error", "95 % bound", "inside")
    return table(header, rows)


def table_of_errors(errors: dict[str, dict[str, float]]) -> str:
    """ATE and RPE of the runs with each camera; none per metre for shorter paths."""
    rows = (
        (name, *(f"{values[e]:.4f}" if e in values else "" for e in ERRORS))
        for name, values in errors.items()
    )
    return table(("camera", *ERRORS.values()), rows)


if __name__ == "__main__":
    main()
