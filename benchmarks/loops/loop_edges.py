"""Loops against the truth: which candidates are refused, how honest edges are, what loops bring.

    python -m benchmarks.loops.loop_edges [NAME ...] [--work runs/bench] [--report-only]

Every sequence is run twice by default options, with and without loops. Each candidate that place
recognition gives is judged by the truth: a verified loop is right if it is within 0.1 rad and
0.15 m of it, and a candidate was refused wrongly if half of what each keyframe sees is seen by the
other. NEES is the squared error of the verified loops over their covariances, divided by its six
degrees of freedom: 1 is honest, the band is that of 95 % for so many independent loops.

Since few candidates arise where a camera never leaves what it sees, a sequence is also cut in two
halves, each a map of its own, and all pairs of their keyframes are verified. Errors of these edges
are stated against the truth, and against the two maps, which meet in one transformation; the
noise that the system learns from their cycles is in the covariance.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from benchmarks.pages import table
from benchmarks.paths import KITCHEN, ROOT, SHARED
from benchmarks.suite.measure import render
from bmask_slam.config.configuration import resolve
from bmask_slam.datasets.weights import find_weights
from bmask_slam.evaluation import evaluate
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import inverse, se3_exp, se3_log, transform
from bmask_slam.graph.trajectory import Trajectory, associate_stamps
from bmask_slam.loops import closing
from bmask_slam.loops.noise import LoopNoise
from bmask_slam.loops.relative_pose import LoopView
from bmask_slam.loops.verification import LoopConstraint, NoLoop, loop_view, verify_loop
from bmask_slam.offline.options import RunOptions
from bmask_slam.offline.runner import run
from bmask_slam.semantics.segmenters.segmenter_table import make_segmenter
from bmask_slam.sequences.sequence import Sequence, open_sequence
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.world.world_map import WorldMap

RIGHT_RAD, RIGHT_M, SEEN_SHARE = 0.1, 0.15, 0.5
RENDERED = {
    "office": ("office", "office-300", ("--frames", "300", "--true-depth")),
    "living room": ("living_room", "living_room", ()),
    "corridor": ("corridor", "corridor", ()),
    "room 21": ("room", "room-21", ("--seed", "21", "--frames", "400")),
}
REAL = {
    "freiburg1_rpy": (SHARED / "tum_fr1_rpy", "none"),
    "Bonn crowd": (SHARED / "bonn_crowd", "light"),
    "Bonn crowd, no segmenter": (SHARED / "bonn_crowd", "none"),
    "red kitchen": (KITCHEN, "none"),
}
HALVED = ("office", "living room", "room 21", "freiburg1_rpy")
ONLY_BY_HAND_EYE = ("red kitchen",)


@dataclass(frozen=True)
class Row:
    """A sequence's figures; errors in metres, NaN where there is no truth for them.

    Attributes:
        candidates: that were verified. same_place: how many of the refused ones show one place.
        refused: by verification; drift: verified, but refused for drift; drift_right: right ones.
        closed: in the end; wrong: how many of these are.
        nees: mean of the verified loops a degree of freedom; verified: their number.
        ratio: real over stated covariance, as learned at the end.
        ate_m, without_m: with and without loops.
    """

    name: str
    candidates: int
    refused: int
    same_place: int
    drift: int
    drift_right: int
    closed: int
    wrong: int
    nees: float
    verified: int
    ratio: float
    ate_m: float
    without_m: float


@dataclass(frozen=True)
class Halves:
    """Edges between the maps of two halves: NEES a degree of freedom, learned ratio, number."""

    name: str
    edges: int
    ratio: float
    nees_truth: float
    nees_maps: float


@dataclass(frozen=True)
class Judged:
    """A verified candidate with its stamps: the result, and the keyframes as they were seen."""

    result: LoopConstraint | NoLoop
    views: tuple[LoopView, LoopView]
    stamps_s: tuple[float, float]


class Observed(SlamSystem):
    """The system, keeping every candidate that it verifies."""

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        self.judged: list[Judged] = []
        self.drifted: set[tuple[int, int]] = set()
        closer, within = self.mapper.loops, self.mapper.loops._drift_allows

        def spy(loop: LoopConstraint, *given: Any) -> bool:
            fits = within(loop, *given)
            self.drifted |= set() if fits else {loop.ends}
            return fits

        closer._drift_allows = spy  # type: ignore[method-assign, assignment]

    def verify(self, a: LoopView, b: LoopView, camera: Any, config: Any) -> LoopConstraint | NoLoop:
        result = verify_loop(a, b, camera, config)
        keyframes = self.mapper.world.keyframes
        stamps_s = tuple(keyframes[view.keyframe_id].timestamp_s for view in (a, b))
        self.judged.append(Judged(result, (a, b), stamps_s))  # type: ignore[arg-type]
        return result


def true_pose(truth: Trajectory, stamps_s: tuple[float, float]) -> Array | None:
    """T_a_b (4, 4) of the truth at two stamps; None where it has none within 20 ms."""
    rows, found = associate_stamps(np.array(stamps_s), truth.timestamps_s)
    if len(rows) < 2:
        return None
    a, b = truth.poses_world_camera[found]
    return inverse(a) @ b


def sees_the_same(judged: Judged, T_a_b: Array, camera: Any) -> bool:
    """Whether each keyframe has half of the other's points in its image."""
    shares = []
    for view, T in zip(judged.views, (inverse(T_a_b), T_a_b), strict=True):
        points = transform(T, view.points_camera[np.isfinite(view.points_camera[:, 2])])
        points = points[points[:, 2] > 0.1]
        pixels = camera.project(points) if len(points) else np.zeros((0, 2))
        inside = ((pixels > 0) & (pixels < [camera.width - 1, camera.height - 1])).all(axis=1)
        shares.append(inside.sum() / max(np.isfinite(view.points_camera[:, 2]).sum(), 1))
    return bool(min(shares) > SEEN_SHARE)


def nees(errors: list[Array], covariances: list[Array]) -> float:
    """Mean squared error over covariance a degree of freedom; NaN without any."""
    if not errors:
        return float("nan")
    r = np.array(errors)[..., None]
    return float((r * np.linalg.solve(np.array(covariances), r)).sum(axis=(1, 2)).mean() / 6)


def with_and_without(name: str, folder: Path, segmenter: str, work: Path) -> Row:
    """Run a sequence twice and judge its loops."""
    made: list[Observed] = []
    last: list[Observed] = []
    sequence, hand_eye = open_sequence(folder), name in ONLY_BY_HAND_EYE
    errors_m = []
    for k, settings in enumerate(("loops.enabled=true", "loops.enabled=false")):
        given = (settings, f"semantics.segmenter.name={segmenter}")
        config = resolve(SystemConfig, None, given)
        out = work / "loops" / f"{name.replace(' ', '-').replace(',', '')}-{k}"
        chosen = make_segmenter(config.semantics.segmenter, folder, find_weights)

        def make(*parts: Any, made: list[Observed] = made, chosen: Any = chosen) -> Observed:
            made.append(Observed(*parts, segmenter=chosen))
            closing.verify_loop = made[-1].verify  # type: ignore[assignment]
            return made[-1]

        run(RunOptions(folder, config, out=out, overwrite=True, quiet=True), make)
        closing.verify_loop = verify_loop
        last.append(made[-1])  # a run makes others before, to look at its camera
        errors_m.append(evaluate(out, folder, with_body=hand_eye).value("ate_rmse"))
    return judge(name, last[0], sequence, (errors_m[0], errors_m[1]))


def judge(name: str, system: Observed, sequence: Sequence, ate_m: tuple[float, float]) -> Row:
    """Candidates of a run against the truth, which a hand-eye reference is not."""
    truth, closer = sequence.groundtruth, system.mapper.loops
    assert truth is not None
    right: dict[tuple[int, int], bool] = {}
    errors, covariances, refused, same = [], [], 0, 0
    for judged in system.judged:
        T_a_b = true_pose(truth, judged.stamps_s)
        refused += isinstance(judged.result, NoLoop)
        if T_a_b is None:
            continue
        if isinstance(judged.result, NoLoop):
            same += sees_the_same(judged, T_a_b, sequence.camera)
            continue
        e = se3_log(inverse(judged.result.T_a_b) @ T_a_b)
        fine = np.linalg.norm(e[:3]) < RIGHT_RAD and np.linalg.norm(e[3:]) < RIGHT_M
        right[judged.result.ends] = bool(fine)
        errors.append(e)
        covariances.append(closer.noise.covariance(judged.result))
    drifted = system.drifted - set(closer.closed)
    return Row(
        name, len(system.judged), refused, same,
        len(drifted), sum(right.get(ends, False) for ends in drifted),
        len(closer.closed), sum(not right.get(ends, True) for ends in closer.closed),
        float("nan") if name in ONLY_BY_HAND_EYE else nees(errors, covariances),
        len(errors), closer.noise.ratio, *ate_m,
    )  # fmt: skip


def halves(name: str, folder: Path) -> Halves:
    """Edges between the maps of a sequence's halves, as the truth and as the maps judge them."""
    sequence = open_sequence(folder)
    config, truth = resolve(SystemConfig, None, ()), sequence.groundtruth
    assert truth is not None
    world, edges = both_halves(sequence, config)
    noise = LoopNoise(config.loops.noise)
    noise.learn(edges, world)
    covariances = [noise.covariance(edge) for edge in edges]
    ends = [tuple(world.keyframes[k] for k in edge.ends) for edge in edges]
    errors, stated = [], []
    for (a, b), edge, covariance in zip(ends, edges, covariances, strict=True):
        T_a_b = true_pose(truth, (a.timestamp_s, b.timestamp_s))
        if T_a_b is not None:
            errors.append(se3_log(inverse(edge.T_a_b) @ T_a_b))
            stated.append(covariance)
    from_a = [a.T_world_camera @ e.T_a_b for (a, _), e in zip(ends, edges, strict=True)]
    meeting = [A @ inverse(b.T_world_camera) for A, (_, b) in zip(from_a, ends, strict=True)]
    T = meeting[0]  # from the second map into the first, by the median of the edges
    for _ in range(20):
        T = T @ se3_exp(np.median([se3_log(inverse(T) @ M) for M in meeting], axis=0))
    from_b = [T @ b.T_world_camera for _, b in ends]
    apart = [se3_log(inverse(A) @ B) for A, B in zip(from_a, from_b, strict=True)]
    against_truth, against_maps = nees(errors, stated), nees(apart, covariances)
    return Halves(name, len(edges), noise.ratio, against_truth, against_maps)


def both_halves(sequence: Sequence, config: SystemConfig) -> tuple[WorldMap, list[LoopConstraint]]:
    """The maps of both halves in one, the second behind the first, and edges between them."""
    worlds, middle = [], len(sequence) // 2
    for begin, end in ((0, middle), (middle, len(sequence))):
        system = SlamSystem(sequence.camera, config)
        for frame in sequence.frames(begin, end, 1):
            system.process(frame)
        system.finish()
        worlds.append(system.mapper.world)
    first, second = ([loop_view(k, w) for k in w.keyframes.values()] for w in worlds)
    limits = config.loops.verification
    found = [verify_loop(a, b, sequence.camera, limits) for a in first for b in second]
    offset = max(worlds[0].keyframes) + 1
    for keyframe in list(worlds[1].keyframes.values()):
        keyframe.id += offset
        worlds[0].keyframes[keyframe.id] = keyframe
    edges = [e for e in found if isinstance(e, LoopConstraint)]
    return worlds[0], [replace(e, keyframe_b=offset + e.keyframe_b) for e in edges]


def band(count: int) -> str:
    """The 95 % band of the mean of so many independent NEES a degree of freedom."""
    low, high = chi2.ppf([0.025, 0.975], 6 * count) / (6 * count)
    return f"{low:.2f}-{high:.2f}"


def folders(work: Path) -> dict[str, tuple[Path, str]]:
    """Folder and segmenter of each sequence that is there; rendered ones are made."""
    rendered = {name: (work / part, "none") for name, (_, part, _) in RENDERED.items()}
    return rendered | {name: where for name, where in REAL.items() if where[0].is_dir()}


def measure(names: list[str], work: Path) -> None:
    """Measure and keep the rows, each as soon as it is there."""
    path = work / "loops" / "results.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    for name in names:
        folder, segmenter = folders(work)[name]
        if name in RENDERED:
            render(folder, RENDERED[name][0], RENDERED[name][2])
        kept = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
        kept[name] = {"row": asdict(with_and_without(name, folder, segmenter, work))}
        if name in HALVED:
            kept[name]["halves"] = asdict(halves(name, folder))
        path.write_text(json.dumps(kept, indent=1), encoding="utf-8")


def tables(work: Path) -> str:
    """The two tables in Markdown."""
    kept = json.loads((work / "loops" / "results.json").read_text(encoding="utf-8"))
    header = (
        *("", "candidates", "refused by verification (same place)"),
        *("refused for drift (right ones)", "closed (wrong ones)", "NEES (95 % band)"),
        *("noise ratio", "ATE with, without loops (mm)"),
    )
    rows = []
    for name in folders(work):
        if name in kept:
            row = Row(**kept[name]["row"])
            honest = f"{row.nees:.2f} ({band(row.verified)})" if np.isfinite(row.nees) else ""
            by = ", by hand-eye" if name in ONLY_BY_HAND_EYE else ""
            rows.append((
                f"{name}{by}", f"{row.candidates}", f"{row.refused} ({row.same_place})",
                f"{row.drift} ({row.drift_right})", f"{row.closed} ({row.wrong})", honest,
                f"{row.ratio:.1f}", f"{1e3 * row.ate_m:.2f}, {1e3 * row.without_m:.2f}",
            ))  # fmt: skip
    halved = []
    for name in HALVED:
        if "halves" in kept.get(name, {}):
            half = Halves(**kept[name]["halves"])
            numbers = (f"{x:.2f}" for x in (half.nees_truth, half.nees_maps))
            halved.append((name, f"{half.edges}", f"{half.ratio:.1f}", *numbers, band(half.edges)))
    of_halves = (
        *("two halves", "edges", "noise ratio"),
        *("NEES against the truth", "against the maps", "band"),
    )
    return f"{table(header, rows)}\n\n{table(of_halves, halved)}"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--work", type=Path, default=ROOT / "runs" / "bench", help="for runs")
    parser.add_argument("--report-only", action="store_true", help="print what was measured")
    given = parser.parse_args()
    if not given.report_only:
        measure(given.names or list(folders(given.work)), given.work)
    print(tables(given.work))


if __name__ == "__main__":
    main()
