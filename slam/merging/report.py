"""What a merge has found, in words and figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bmask_slam.evaluation import Row
from bmask_slam.loops.verification import NoLoop, NoLoopReason
from bmask_slam.merging.common_places import CommonPlaces, MergeConfig
from bmask_slam.merging.joining import Joined
from bmask_slam.merging.sources import Source
from bmask_slam.run_folder.metrics import row
from bmask_slam.runtime.memory import peak_rss_mb
from bmask_slam.system import SlamSystem


@dataclass(frozen=True, eq=False)
class MergeSummary:
    """The result of merging.

    Attributes:
        folder: the run folder.
        rows: what metrics.json holds.
        lines: what was found between the runs, and which of them had their stamps moved, a line
            each.
    """

    folder: Path
    rows: list[Row]
    lines: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class PairSearch:
    """The common places of two runs, by their numbers, and why other candidates were refused."""

    runs: tuple[int, int]
    places: list[CommonPlaces]
    reasons: list[NoLoop]

    @property
    def best(self) -> CommonPlaces | None:
        """The place with most loops."""
        return max(self.places, key=lambda p: len(p.loops), default=None)

    @property
    def nearness(self) -> tuple[int, tuple[int, float]]:
        """How near they came to a common place."""
        loops = 0 if self.best is None else len(self.best.loops)
        return loops, max(map(_stage, self.reasons), default=(-1, 0.0))


def no_place(
    number: int, sources: Sequence[Source], found: Sequence[PairSearch], config: MergeConfig
) -> str:
    """One line: which run has no place in common with the others, and how near it came."""
    pair = max((pair for pair in found if number in pair.runs), key=lambda pair: pair.nearness)
    path, other = sources[number].path, sources[sum(pair.runs) - number].path
    text = f"{path}: has no place in common with the other runs; "
    if pair.best is not None:
        fault = pair.best.fault(config) or "that run has none with the others"
        return f"{text}nearest was {other}: {fault}"
    if not pair.reasons:
        return f"{text}no view in it is like one of theirs"
    reason = max(pair.reasons, key=_stage)
    return f"{text}nearest was {other}, the best of {len(pair.reasons)} views: {reason}"


def _stage(refused: NoLoop) -> tuple[int, float]:
    """How far a candidate came, and how near it was there."""
    return list(NoLoopReason).index(refused.reason), refused.value / refused.limit


def line_of(pair: PairSearch, sources: Sequence[Source], config: MergeConfig) -> str:
    """What two runs have in common."""
    a, b = (sources[n].path.name for n in pair.runs)
    best = pair.best
    if best is None:
        return f"{a} and {b}: no common place, {len(pair.reasons)} candidates refused"
    text = (
        f"{a} and {b}: {len(best.loops)} loops from {best.keyframes} keyframes agree, "
        f"{len(best.wrong)} do not, {len(pair.reasons)} candidates refused"
    )
    if best.tested:
        text += f"; {best.confirmed} of {best.tested} views that both should have are the same"
    return text + (f"; not used: {fault}" if (fault := best.fault(config)) else "")


def moved_lines(sources: Sequence[Source]) -> Iterator[str]:
    """A line for each run whose stamps were moved."""
    for source in sources:
        if source.shift.stamp_s:
            yield (
                f"{source.path.name}: {source.shift.stamp_s:+g} s to its stamps in trajectory.txt, "
                "since it does not begin after the run before it"
            )


def rows_of(
    system: SlamSystem, sources: Sequence[Source], found: Sequence[PairSearch], joined: Joined
) -> list[Row]:
    """The rows of metrics.json."""
    frames = sum(len(source.frames) for source in sources)
    statistics = system.statistics()
    wrong = sum(len(places.wrong) for pair in found for places in pair.places)
    r = joined.residuals.reshape(-1, 2, 3)
    rms_rad, rms_m = np.sqrt((r**2).sum(axis=2).mean(axis=0)) if len(r) else np.zeros(2)
    return [
        row("tracked_share", len(system.trajectory()) / frames, "1"),
        row("merged_runs", len(sources), "runs"),
        row("merge_loops", len(joined.closed), "loops"),
        row("merge_loops_wrong", wrong + joined.refused, "loops"),
        row("merge_candidates_refused", sum(len(pair.reasons) for pair in found), "candidates"),
        row("merge_loop_rms_m", float(rms_m), "m"),
        row("merge_loop_rms_deg", float(np.rad2deg(rms_rad)), "deg"),
        row("merge_landmarks_fused", joined.landmarks_fused, "landmarks"),
        row("keyframes", int(statistics["keyframes"]), "keyframes"),
        row("landmarks", int(statistics["landmarks"]), "landmarks"),
        row("loops_closed", int(statistics["loops_closed"]), "loops"),
        row("peak_rss_mb", peak_rss_mb(), "MB"),
    ]


def format_merge(summary: MergeSummary) -> str:
    """A few lines for the command line."""
    values = {row["name"]: row["value"] for row in summary.rows}
    lines = [
        *summary.lines,
        f"loops       {values['merge_loops']} between runs, {values['merge_loops_wrong']} refused; "
        f"they fit to {1e3 * values['merge_loop_rms_m']:.1f} mm and "
        f"{values['merge_loop_rms_deg']:.2f} deg (rms)",
        f"map         {values['keyframes']} keyframes, {values['landmarks']} landmarks; "
        f"{values['merge_landmarks_fused']} were there twice",
        f"Folder      {summary.folder}",
    ]
    return "\n".join(lines)
