"""Real recordings by default options, beside ORB-SLAM3, OpenCV and Open3D on the same frames.

    python -m benchmarks.cameras.real_sequences [NAME ...] [--work runs/bench] [--readme README.md]

A run gets the sequence as it is published and no option but those named in its row; the truth is
used only afterwards. One sequence is also given without the name by which its camera is known.
Rendered rooms with exact truth stand beside them: as they are, and with rows exposed one after the
other and depth that is late, which their camera.yaml does not say. Errors are RMSE after SE(3)
alignment. The red kitchen's reference is of its depth camera, so the place of that is found too
(``evaluate --hand-eye``). The others get the published camera and keep their own defaults; of
ORB-SLAM3, whose runs differ, the median one of three is taken.
Rows stay in WORK/real/results.json: what is measured once is printed again with ``--report-only``,
and the others, which do not change with a commit, are measured only where they are missing.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.cameras import orb_slam3
from benchmarks.cameras.frame_to_frame import in_its_own_process
from benchmarks.cameras.pictures import Pictured, draw_sequence
from benchmarks.cameras.tables import (
    DELAY_MS,
    LIBRARIES,
    ORB_SLAM3,
    OURS,
    READOUT_MS,
    RECORDINGS,
    SHORT,
    Figures,
    Rows,
    said_by_runs,
    short_table,
    targets_table,
    whole_table,
)
from benchmarks.machine import describe_commit, now
from benchmarks.pages import WRITTEN, fill_block
from benchmarks.paths import KITCHEN, ROOT, SHARED
from benchmarks.suite.measure import call, render
from bmask_slam.evaluation import evaluate
from bmask_slam.run_folder.reader import Run

FOLDERS = {
    "rpy": SHARED / "tum_fr1_rpy", "rpy-none": SHARED / "tum_fr1_rpy",
    "bonn": SHARED / "bonn_crowd", "kitchen": KITCHEN,
}  # fmt: skip
SAID = re.compile(
    r"(?:runner|events): (?:frame \d+, [\d.]+ s: )?"
    r"(?:camera from [^,\n]+, ([^:\n]+): Camera|calibration: ([^\n]+))"
)
"""What a run's log says of a preset, and of what it found of the camera."""
ORB_SLAM3_RUNS = 3
NOT_DRAWN = ("rpy-unknown", "rpy-none")


def folder_of(name: str, work: Path) -> Path:
    """The folder of a sequence; made where it is missing."""
    if name in FOLDERS:
        return FOLDERS[name]
    if name == "rpy-unknown":
        return _unnamed(FOLDERS["rpy"], work / "recording")
    late = ("--rolling-shutter-ms", f"{READOUT_MS}", "--depth-delay-ms", f"{DELAY_MS}")
    options = ("--true-depth",) if name == "office" else late
    office = work / ("office-300" if name == "office" else name)
    render(office, "office", ("--frames", "300", *options))
    return office


def _unnamed(source: Path, folder: Path) -> Path:
    """A folder of links to a sequence, without its name and its truth."""
    folder.mkdir(parents=True, exist_ok=True)
    for part in ("rgb", "depth", "rgb.txt", "depth.txt", "camera.yaml"):
        if not (folder / part).exists():
            (folder / part).symlink_to(source.resolve() / part)
    return folder


def measured(name: str, work: Path) -> Figures:
    """Run the system on a sequence."""
    recording, folder = RECORDINGS[name], folder_of(name, work)
    out, start_s = work / "real" / name, time.perf_counter()
    where = [str(folder), "--out", str(out), "--overwrite", "--quiet"]
    call(["-m", "bmask_slam", "run", *where, *recording.options])
    whole_s = time.perf_counter() - start_s
    run = Run(out)
    metrics = {name: metric.value for name, metric in run.metrics.items()}
    status = run.frames.status
    said = "; ".join(preset or found for preset, found in SAID.findall("\n".join(run.log)))
    return Figures(
        name, OURS, len(status), metrics["tracked_share"], status.count("WEAK") / len(status),
        **_errors(name, out, work), median_ms=metrics["tracking_ms_median"],
        high_ms=metrics["tracking_ms_p95"], whole_s=whole_s, said=said,
        stamp=_stamp(),
    )  # fmt: skip


def compared(name: str, library: str, work: Path) -> Figures:
    """A library's odometry on the same frames."""
    out, start_s = work / "real" / f"{name}-{library}", time.perf_counter()
    runs = ""
    if library == ORB_SLAM3:
        runs = orb_slam3_median(name, out, work)
    else:
        in_its_own_process(library, folder_of(name, work), out, work / "wheels")
    whole_s = time.perf_counter() - start_s
    said = json.loads((out / "odometry.json").read_text(encoding="utf-8"))
    median_ms, high_ms = np.percentile(said["times_ms"], (50, 95))
    return Figures(
        name, library, said["frames"], said["tracked"], None, **_errors(name, out, work),
        median_ms=float(median_ms), high_ms=float(high_ms), whole_s=whole_s, said=runs,
        stamp=_stamp(),
    )  # fmt: skip


def orb_slam3_median(name: str, out: Path, work: Path) -> str:
    """Run ORB-SLAM3 three times; the median run comes to ``out``, and what all have is told."""
    found = []
    for number in range(ORB_SLAM3_RUNS):
        run = out.with_name(f"{out.name}-{number}")
        orb_slam3.in_its_own_process(folder_of(name, work), run, work)
        found.append((_errors(name, run, work)["ate_m"], run))
    found.sort()
    shutil.copytree(found[len(found) // 2][1], out, dirs_exist_ok=True)
    return f"median of {', '.join(f'{1e3 * ate_m:.1f}' for ate_m, _ in found)}"


def _errors(name: str, out: Path, work: Path) -> dict[str, Any]:
    """ATE and RPE a second in metres; where the reference needs that, also the ATE by hand-eye.

    The RPE is by hand-eye then, too.
    """
    reference = FOLDERS["rpy"] if name == "rpy-unknown" else folder_of(name, work)
    path = out / "trajectory.txt"
    errors = evaluate(path, reference)
    other = evaluate(path, reference, with_body=True) if RECORDINGS[name].hand_eye else None
    return {
        "ate_m": errors.value("ate_rmse"),
        "hand_eye_m": other and other.value("ate_rmse"),
        "rpe_m": (other or errors).value("rpe_trans_rmse_second"),
    }


def _stamp() -> str:
    commit, *changes = describe_commit(WRITTEN).split(" with ")
    return f"{commit}{' and uncommitted changes' if changes else ''}; {now()}"


def measure_all(names: list[str], work: Path, again: bool) -> None:
    """Measure what is asked for; every row is kept as soon as it is there."""
    rows = read_rows(work)
    for name in names:
        rows[name, OURS] = measured(name, work)
        write_rows(rows, work)
    firsts = {RECORDINGS[name].title: name for name in reversed(RECORDINGS)}
    for name in firsts.values():
        for library in LIBRARIES:
            if name in names and (again or (name, library) not in rows):
                rows[name, library] = compared(name, library, work)
                write_rows(rows, work)


def read_rows(work: Path) -> Rows:
    """What was measured so far, by sequence and system."""
    path = work / "real" / "results.json"
    if not path.is_file():
        return {}
    rows = [Figures(**row) for row in json.loads(path.read_text(encoding="utf-8"))]
    return {(row.name, row.system): row for row in rows}


def write_rows(rows: Rows, work: Path) -> None:
    """Keep all rows."""
    text = json.dumps([asdict(row) for row in rows.values()], indent=1)
    (work / "real" / "results.json").write_text(text, encoding="utf-8")


def draw(rows: Rows, work: Path, images: Path) -> Iterator[tuple[str, str]]:
    """Draw the sequences that were measured; the name of each picture and its caption."""
    for name, recording in RECORDINGS.items():
        if (name, OURS) not in rows or name in NOT_DRAWN:
            continue
        others = {
            short: work / "real" / f"{name}-{library}" / "trajectory.txt"
            for library, short in SHORT.items()
            if (name, library) in rows
        }
        file = images / f"real_{name.replace('-', '_')}.png"
        parts = work / "real" / name, folder_of(name, work), others, recording.hand_eye
        draw_sequence(Pictured(recording.title, *parts), file)
        yield file.name, recording.title


def main() -> None:
    """Measure, draw, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", choices=[*RECORDINGS, []], metavar="NAME")
    parser.add_argument("--work", type=Path, default=ROOT / "runs" / "bench", help="for runs")
    parser.add_argument("--images", type=Path, default=ROOT / "docs" / "images")
    parser.add_argument("--report-only", action="store_true", help="print what was measured")
    parser.add_argument("--again", action="store_true", help="the other systems too")
    parser.add_argument("--readme", type=Path, help="put the short table into this file")
    given = parser.parse_args()
    (given.work / "real").mkdir(parents=True, exist_ok=True)
    if not given.report_only:
        measure_all(given.names or list(RECORDINGS), given.work, given.again)
    rows = read_rows(given.work)
    print(whole_table(rows), targets_table(rows), said_by_runs(rows), sep="\n\n")
    for file, title in draw(rows, given.work, given.images):
        print(f"\n![{title}: path, error and status over time](../images/{file})")
    if given.readme:
        fill_block(given.readme, short_table(rows))


if __name__ == "__main__":
    main()
