"""The report in Markdown, from the plain data of ``run.measure_all``; nothing is typed by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.pages import table
from benchmarks.suite.anchors import KITCHEN, PUBLISHED_ATE_CM
from benchmarks.suite.targets import target_rows
from bmask_slam.commands.arguments import format_summary

Results = dict[str, Any]
EXAMPLE_BEGIN = "<!-- example: written by benchmarks/run.py -->"
EXAMPLE_END = "<!-- end of example -->"
BUSY_LOAD = 1.0
ESTIMATED_REFERENCE = ("redkitchen",)
TITLES = {
    "redkitchen": "red kitchen (real Kinect)",
    "office": "office (rendered)",
    "living_room": "living room (rendered)",
    "corridor": "corridor loop (rendered)",
}


def title(sequence: str) -> str:
    """How a sequence is called in tables."""
    return TITLES.get(sequence, sequence)


def results_block(results: Results) -> str:
    """The main table, and how it was measured."""
    header = (
        "sequence, run with `--segmenter none`",  # as the systems beside it
        *("frames tracked", "ATE", "RPE a second", "end drift"),
        *("ms a frame: median, 95 %", "frames/s", "keyframes", "memory"),
    )
    rows = [_result_row(run) for run in results["runs"] if run["variant"] == "default"]
    machine, (commit, *changes) = results["machine"], results["commit"].split(" with ")
    where = (
        f"{machine['processor']}, {machine['cores']} cores, no GPU used; "
        f"commit {commit}{' and uncommitted changes' if changes else ''}; "
        f"{results['date']}; by `{results['command']}`."
    )
    return "\n".join([table(header, rows), "", where])


def _result_row(run: dict[str, Any]) -> tuple[str, ...]:
    m = run["metrics"]
    tracked = f"{100 * m['tracked_share']:.1f} % of {run['frames']}"
    errors = ("", "", "")
    if "ate_rmse" in m:
        errors = (
            _length(m["ate_rmse"]),
            f"{_length(m['rpe_trans_rmse_second'])}, {m['rpe_rot_rmse_second']:.2f}°",
            _drift(run),
        )
    return (
        title(run["sequence"]), tracked, *errors,
        f"{m['tracking_ms_median']:.1f}, {m['tracking_ms_p95']:.1f}",
        f"{m['frames_per_second']:.1f}", f"{m['keyframes']:.0f}", f"{m['peak_rss_mb']:.0f} MB",
    )  # fmt: skip


def _length(value_m: float) -> str:
    return f"{1000 * value_m:.2f} mm" if value_m < 0.01 else f"{100 * value_m:.2f} cm"


def _drift(run: dict[str, Any]) -> str:
    """The end's error as a share of the path; none where the reference is itself an estimate."""
    if run["sequence"] in ESTIMATED_REFERENCE:
        return ""
    return f"{100 * run['drift_m'] / max(run['path_m'], 1e-9):.2f} % of {run['path_m']:.1f} m"


def example_block(results: Results) -> str:
    """What the command line prints of the office's run, between its markers."""
    run = next(run for run in results["runs"] if run["sequence"] == "office")
    printed = format_summary(run["printed"])
    return f"{EXAMPLE_BEGIN}\n```\n$ {run['command']}\n{printed}\n```\n{EXAMPLE_END}"


def write_report(results: Results, path: Path) -> None:
    """Write the whole report."""
    sections = (
        _head(results),
        results_block(results),
        _explanations(),
        _targets(results),
        _kitchen(results),
        _stages(results),
        _ablation(results),
        _noise(results),
        _growth(results),
        _trajectories(results),
        _commands(results),
    )
    text = "\n\n".join(section for section in sections if section)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text + "\n", encoding="utf-8")


def _head(results: Results) -> str:
    machine = results["machine"]
    rows = [(key, value) for key, value in machine.items()]
    rows += [("commit", results["commit"]), ("date", results["date"])]
    first, last = results["brisk_ms"]
    rows.append(
        (
            "yardstick",
            f"OpenCV's BRISK at its defaults, detection and description on "
            f"{results['brisk_sequence']}: "
            f"{first:.1f} ms before the runs, {last:.1f} ms after",
        )
    )
    before, after = results["load"]
    load = f"load average {before:.1f} before the runs, {after:.1f} after"
    if before > BUSY_LOAD:
        load += " (the machine was BUSY with other work: times are too long)"
    rows.append(("load", load))
    return (
        f"# Benchmarks\n\nWritten by `{results['command']}` ([benchmarks/](../../benchmarks)); no "
        f"number here is typed by hand, but for the figures of other systems, which are marked.\n\n"
        f"{table(('machine', ''), rows)}\n\n## Results"
    )


def _explanations() -> str:
    return (
        "ATE: RMSE of the position over all frames after SE(3) alignment, no scale. RPE: RMSE "
        "over one second. End drift: error of the last pose with the first one put upon the "
        "reference's, as a share of the path, where the reference is exact. "
        "Times are of features and tracking, for every frame; what keyframes add is in the table "
        "of stages. Images are decoded in a thread that runs ahead. "
        "Memory: peak of the whole process."
    )


def _targets(results: Results) -> str:
    rows = [(title(row[0]), *row[1:]) for row in target_rows(results)]
    header = ("sequence", "asked", "measured", "reached")
    return f"## What is asked\n\n{table(header, rows)}" if rows else ""


def _kitchen(results: Results) -> str:
    whole = [r for r in results["runs"] if "--max-frames" not in r["command"]]
    runs = [r for r in whole if r["sequence"] == "redkitchen" and r["variant"] != "repeated"]
    if not runs:
        return ""
    rows = []
    for run in runs:
        m = run["metrics"]
        name = "**bmask-slam**" if run["variant"] == "default" else f"bmask-slam, {run['variant']}"
        rows.append((name, f"{100 * m['ate_rmse']:.2f}", f"{m['tracking_ms_median']:.1f}",
                     f"{m['tracking_ms_p95']:.1f}", f"{m['peak_rss_mb']:.0f}", "now"))  # fmt: skip
    for a in KITCHEN:
        rows.append((a.system, a.ate_cm, a.frame_ms, a.frame_p95_ms, a.peak_mb, "earlier"))
    header = ("system", "ATE (cm)", "ms a frame", "95 %", "peak MB", "measured")
    return (
        f"## Beside other systems: red kitchen, first 600 frames\n\n{table(header, rows)}\n\n"
        "The others were measured once for this project, on another machine with two cores, with "
        "the same calibration (benchmarks/suite/anchors.py); their time is of a whole frame. "
        "Beside ORB-SLAM3 on one machine: [real cameras](real-cameras.md). The reference is itself "
        "an estimate (KinectFusion), good to 1-2 cm, and so is the calibration: a depth scale 2 % "
        "larger takes ORB-SLAM2 from 4.8 to 4.0 cm. It also moves like a point beside "
        "the camera, which is not taken into account here (see [graph.md](graph.md)). Differences "
        "below a centimetre prove nothing; the rendered sequences, whose truth is exact, decide."
    )


def _stages(results: Results) -> str:
    rows, names = [], tuple(results["runs"][0]["stages"])
    for run in results["runs"]:
        if run["variant"] == "default":
            times = run["stages"]
            cells = [f"{times[s][0]:.1f}, {times[s][1]:.1f}" for s in names]
            share = times["graph"][2] / max(run["frames"], 1)
            m = run["metrics"]
            update = f"{m['isam2_update_ms_median']:.1f}, {m['isam2_update_ms_p95']:.1f}"
            rows.append((title(run["sequence"]), *cells, update, f"{100 * share:.0f} %"))
    header = ("sequence", *names, "iSAM2 alone", "keyframes")
    return (
        "## Time of each stage\n\nMilliseconds, median and 95 %; features, moving and tracking "
        "over all frames, the others over frames that became keyframes, whose share is in the "
        "last column."
        f"\n\n{table(header, rows)}"
    )


def _ablation(results: Results) -> str:
    variants = {
        *("default", "without sub-pixel registration"),
        *("no loop closed", "every 3rd frame"),
    }
    runs = [r for r in results["runs"] if r["variant"] in variants and "ate_rmse" in r["metrics"]]
    if len({r["variant"] for r in runs}) < 2:
        return ""
    rows = []
    for run in sorted(runs, key=lambda r: r["sequence"]):
        m = run["metrics"]
        rows.append(
            (
                title(run["sequence"]),
                run["variant"],
                _length(m["ate_rmse"]),
                f"{_length(m['rpe_trans_rmse_second'])}, {m['rpe_rot_rmse_second']:.2f}°",
                _drift(run),
                f"{100 * m['tracked_share']:.1f} %",
                f"{m['tracking_ms_median']:.1f}",
            )
        )
    header = ("sequence", "variant", "ATE", "RPE a second", "end drift", "tracked", "ms a frame")
    return f"## What registration and the frame rate do\n\n{table(header, rows)}"


def _noise(results: Results) -> str:
    if not results["noise"]:
        return ""
    keypoints = [
        (f"{row['gap']}", f"{row['matches']}", f"{100 * row['registered_share']:.1f} %",
         f"{row['brisk_all_px']:.3f}", f"{row['brisk_px']:.3f}", f"{row['registered_px']:.3f}")
        for row in results["noise"]["keypoints"]
    ]  # fmt: skip
    disparity = [
        (f"{row['from_m']:g} to {row['to_m']:g} m", f"{row['keypoints']}",
         f"{row['sigma_px']:.3f}", f"{row['median_px']:+.3f}")
        for row in results["noise"]["disparity"]
    ]  # fmt: skip
    header = ("frames apart", "matches", "registered", "BRISK, all (px)", "BRISK (px)",
              "registered (px)")  # fmt: skip
    header_disparity = ("depth", "keypoints", "sigma (px)", "median error (px)")
    return (
        "## Noise of keypoints and depth, against exact truth\n\nRendered office with sensor "
        "noise, by `benchmarks/suite/keypoint_noise.py`: error along u and v of a matched keypoint "
        "against the true place of the surface point it was matched to, as a robust sigma; before "
        "and after registration to the landmark's patch (`slam/features/patch_alignment.py`). "
        "Rendered surfaces "
        f"flatter both columns: real images are blurred and shine.\n\n{table(header, keypoints)}"
        "\n\nDisparity bf/z that the front end reads at keypoints, against the true one:\n\n"
        f"{table(header_disparity, disparity)}"
    )


def _growth(results: Results) -> str:
    rows = []
    for sequence, quarters in results["growth"].items():
        for q in quarters:
            rows.append(
                (title(sequence), f"{100 * q['share']:.0f} %", f"{q['keyframes']:.0f}",
                 f"{q['landmarks']:.0f}", f"{q['graph_landmarks']:.0f}", f"{q['factors']:.0f}",
                 f"{q['update_median_ms']:.1f}, {q['update_p95_ms']:.1f}", f"{q['rss_mb']:.0f} MB")
            )  # fmt: skip
    if not rows:
        return ""
    header = ("sequence", "of the run", "keyframes", "landmarks in the map", "in the graph",
              "factors", "update in this quarter (ms: median, 95 %)", "memory then")  # fmt: skip
    return (
        f"## How the graph grows\n\n{table(header, rows)}\n\n"
        "![Factors, landmarks, keyframes and update time over the frames]"
        "(../images/graph_growth.png)"
    )


def _trajectories(results: Results) -> str:
    if not results["trajectories"]:
        return ""
    rows = [
        (row["title"], f"{100 * row['ate_rmse']:.2f} cm",
         f"{1000 * row['rpe_trans_rmse_second']:.1f} mm, {row['rpe_rot_rmse_second']:.2f}°",
         f"{row['associated_poses']:.0f}", PUBLISHED_ATE_CM.get(row["file"], ""))
        for row in results["trajectories"]
    ]  # fmt: skip
    header = ("trajectory", "ATE, our evaluation", "RPE a second", "poses", "published, cm")
    return (
        "## The evaluation itself\n\nPublished trajectories of other systems through our "
        "evaluation (SE(3), all poses); the tests hold it against `evo` to 1e-6 m.\n\n"
        + table(header, rows)
    )


def _commands(results: Results) -> str:
    commands = [results["command"], *results["render_commands"]]
    commands += [run["command"] for run in results["runs"]]
    block = "\n".join(commands)
    return f"## Commands\n\nThe first one does all the others.\n\n```\n{block}\n```"
