"""Several finished runs made one run folder: common places, one map, one graph, one trajectory."""

from __future__ import annotations

import logging
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path

import numpy as np

from bmask_slam.config.configuration import dump
from bmask_slam.evaluation import Row
from bmask_slam.evaluation.recordings import JOINED, write_parts
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.merging.common_places import CommonPlaces, MergeConfig, PlaceSearch
from bmask_slam.merging.joining import Step, join, join_objects
from bmask_slam.merging.joint_state import joint_state
from bmask_slam.merging.report import (
    MergeSummary,
    PairSearch,
    line_of,
    moved_lines,
    no_place,
    rows_of,
)
from bmask_slam.merging.sources import SLACK_S, Source, read_sources
from bmask_slam.run_folder.folder import DENSE, RunFolder
from bmask_slam.run_folder.frame_file import FRAMES
from bmask_slam.run_folder.map_file import MAP
from bmask_slam.run_folder.metrics import row, save
from bmask_slam.run_folder.origin import Origin
from bmask_slam.system import SlamSystem

logger = logging.getLogger(__name__)

TRAJECTORY_OF_RUN = "trajectory_run_{}.txt"


@dataclass(frozen=True)
class MergeOptions:
    """What to merge, and where to write it.

    Attributes:
        runs: folders of finished runs, two or more; the world frame is the first one's.
        out: the run folder to make.
        overwrite: replace the run in ``out``.
        config: when two runs have a place in common.
    """

    runs: tuple[Path, ...]
    out: Path
    overwrite: bool = False
    config: MergeConfig = field(default_factory=MergeConfig)


def merge_runs(options: MergeOptions) -> MergeSummary:
    """Merge finished runs.

    Raises:
        InputError: runs that are not finished or do not fit together, a run that has no place in
            common with the others, or one that only looks alike.
    """
    if options.out.resolve() in [path.resolve() for path in options.runs]:
        raise InputError(f"{options.out}: is an input, which stays as it is; choose another --out")
    sources = read_sources(options.runs)
    system = _system(sources)
    _report_frame(system, sources)
    found = _common_places(system, sources, options.config)
    lines = *(line_of(pair, sources, options.config) for pair in found), *moved_lines(sources)
    tree, others = _plan(system, sources, found, options.config)  # refused before OUT is touched
    with RunFolder(options.out, options.overwrite) as folder:
        logger.info("merged: %s", shlex.join(sys.argv))
        for line in lines:
            logger.info("%s", line)
        _begin(folder, sources)
        joined = join(system, tree, others)
        folder.write_events(system.events.take())
        twice = join_objects(system, [source.shift.objects for source in sources])
        rows = rows_of(system, sources, found, joined)
        rows.append(row("merge_objects_fused", twice, "objects"))
        _write(folder, system, sources, rows)
        if any((source.path / DENSE).is_dir() for source in sources):
            from bmask_slam.merging.dense_maps import merge_dense_maps  # noqa: PLC0415 - torch

            merge_dense_maps(folder.path, sources, system.map.world.landmarks)
        folder.complete()
        return MergeSummary(folder.path, rows, lines)


def _system(sources: Sequence[Source]) -> SlamSystem:
    """A system with the maps of all runs, with the first one's camera and configuration."""
    first = sources[0]
    system = SlamSystem(first.camera, first.config)
    states, shifts = [s.state for s in sources], [s.shift for s in sources]
    system.restore(joint_state(states, shifts, system.state()), first.path / MAP)
    for source in sources[1:]:
        if source.config != first.config:
            logger.info("%s: its settings differ; those of %s count", source.path, first.path)
        if "mapper.graph.own_factors" in source.state:
            logger.warning("%s: its own factors (add_factor) are left out", source.path)
    return system


def _begin(folder: RunFolder, sources: Sequence[Source]) -> None:
    """Write the configuration, the recordings, and the frames and events of all runs."""
    origin = Origin(None)
    try:
        parts = [part for source in sources for part in source.parts()]
        folder.write_file(JOINED, lambda path: write_parts(path, parts))
        origin = Origin(folder.path / JOINED)
    except InputError as error:
        logger.warning("%s; without it the merged run has no images", error)
    folder.write_text("config.yaml", f"# {origin}\n{dump(sources[0].config)}")
    for source in sources:
        folder.write_rows(FRAMES, source.frame_rows())
        folder.write_events(source.events())
        text = "%s: %d frames, stamps %+g s, keyframes from %d, landmarks from %d"
        ids = source.shift.keyframes, source.shift.landmarks
        logger.info(text, source.path, len(source.frames), source.shift.stamp_s, *ids)


def _report_frame(system: SlamSystem, sources: Sequence[Source]) -> None:
    """Let what happens now be reported after the last frame."""
    last = sources[-1]
    system.events.begin_frame(int(last.frames.index[-1]) + last.shift.frames, last.span_s[1])


def _run_of(sources: Sequence[Source], ids: Sequence[int]) -> list[int]:
    """The numbers of the runs of keyframes."""
    begins = [source.shift.keyframes for source in sources]
    return (np.searchsorted(begins, ids, side="right") - 1).tolist()


def _common_places(
    system: SlamSystem, sources: Sequence[Source], config: MergeConfig
) -> list[PairSearch]:
    world = system.map.world
    numbers = _run_of(sources, list(world.keyframes))
    keyframes = [
        [k for k, number in zip(world.keyframes.values(), numbers, strict=True) if number == n]
        for n in range(len(sources))
    ]
    found = []
    for a, b in combinations(range(len(sources)), 2):
        search = PlaceSearch(world, system.camera, system.config.loops, config)
        places = search.between(keyframes[a], keyframes[b])
        found.append(PairSearch((a, b), places, search.reasons))
    return found


def _plan(
    system: SlamSystem, sources: Sequence[Source], found: Sequence[PairSearch], config: MergeConfig
) -> tuple[list[Step], list[CommonPlaces]]:
    """The common places that join all runs, the surest first, and all others.

    Raises:
        InputError: a run has no place in common with the others, or one that only looks alike.
    """
    good = [places for pair in found for places in pair.places if not places.fault(config)]
    largest = _largest_segments(system, sources)
    known, tree = {largest[0]}, list[Step]()
    while edges := [p for p in good if len(known.intersection(p.segments)) == 1]:
        best = max(edges, key=lambda p: len(p.loops))
        (moving,) = {*best.segments} - known
        tree.append(Step(best, moving))
        known.add(moving)
    for number, segment in enumerate(largest):
        if segment not in known:
            raise InputError(no_place(number, sources, found, config))
    used = [step.places for step in tree]
    return tree, [p for p in good if p not in used and known.issuperset(p.segments)]


def _largest_segments(system: SlamSystem, sources: Sequence[Source]) -> list[int]:
    """The map segment of each run that its trajectory.txt is of."""
    world, counts = system.map.world, system.map.history.frames(system.map.world)
    keyframes, mapped = list(world.keyframes.values()), world.mapped_segments()
    numbers = _run_of(sources, [k.id for k in keyframes])
    runs = {k.segment: number for k, number in zip(keyframes, numbers, strict=True)}
    return [
        max((s for s, run in runs.items() if run == n), key=lambda s: (s in mapped, counts[s], -s))
        for n in range(len(sources))
    ]


def _write(
    folder: RunFolder, system: SlamSystem, sources: Sequence[Source], rows: list[Row]
) -> None:
    """Write the result files, and the trajectory of each run by its own stamps."""
    save(system, folder, rows, None, folder.path.name)
    merged = system.trajectory()
    for number, source in enumerate(sources, 1):
        begin_s, end_s = source.span_s
        stamps_s = merged.timestamps_s
        inside = (stamps_s > begin_s - SLACK_S) & (stamps_s < end_s + SLACK_S)
        own = Trajectory(stamps_s[inside] - source.shift.stamp_s, merged.poses_world_camera[inside])
        folder.write_trajectory(own, TRAJECTORY_OF_RUN.format(number))
