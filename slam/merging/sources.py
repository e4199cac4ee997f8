"""The runs that are merged, read and checked, and their frames, events and recordings as one."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from shlex import quote

import numpy as np

from bmask_slam.config.configuration import resolve
from bmask_slam.evaluation.recordings import Part, is_joined, read_parts
from bmask_slam.events import Event, read_events
from bmask_slam.graph.arrays import Arrays
from bmask_slam.graph.camera import NO_DEPTH_DISTORTION, Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.graph_update import marker_id, site_id
from bmask_slam.graph.files.reading import read_table
from bmask_slam.merging.joint_state import Shift
from bmask_slam.run_folder.folder import CHECKPOINT
from bmask_slam.run_folder.frame_file import COLUMNS, FRAMES, FrameTable, read_frames
from bmask_slam.run_folder.map_file import MAP, read_map
from bmask_slam.run_folder.origin import CONFIG, find_sequence
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.system_results import checked_state

GAP_S = 10.0
"""At least so long after the last frame of one run the next one begins, if it has to be moved."""
SLACK_S = 1e-4
"""Stamps in files have six decimals."""
MAX_STAMP_S, MAX_INDEX = 1e11, 2**40
MAX_SHARED = 0.5
"""Of the keyframes of a run. Parts of one recording may overlap; more is the same run again."""


@dataclass(frozen=True, eq=False)
class Source:
    """A finished run.

    Attributes:
        path: its folder.
        state: of its system. camera: of its map. config: it was made with.
        frames: that it processed.
        shift: of its ids, indices and stamps in the merged run.
    """

    path: Path
    state: Arrays
    camera: Camera
    config: SystemConfig
    frames: FrameTable
    shift: Shift

    @property
    def span_s(self) -> tuple[float, float]:
        """Stamps of its first and its last frame, in the merged run."""
        begin_s, end_s = self.frames.timestamps_s[[0, -1]].tolist()
        return begin_s + self.shift.stamp_s, end_s + self.shift.stamp_s

    @property
    def labels(self) -> tuple[list[str], ...]:
        """The names of the labels of things, how they were measured, and those of surfaces."""
        names = ("names", "measured", "surfaces.names")
        return tuple(self.state.get(f"semantics.{name}", np.array([""])).tolist() for name in names)

    @property
    def has_markers(self) -> bool:
        """Whether fiducial markers are in its graph."""
        ids = self.state["mapper.graph.keyframe_ids"]
        return bool(((ids >= marker_id(0, 0)) & (ids < site_id(0))).any())

    def frame_rows(self) -> Iterator[dict[str, object]]:
        """The lines of frames.csv, as they are in the merged run's."""
        table = read_table(self.path / FRAMES, COLUMNS[:2], "run again", growing=True)
        shift = self.shift
        for values in zip(*table.values(), strict=True):
            row: dict[str, object] = dict(zip(table, values, strict=True))
            row["index"] = int(str(row["index"])) + shift.frames
            row["timestamp"] = f"{float(str(row['timestamp'])) + shift.stamp_s:.6f}"
            for name, more in (("segment", shift.segments), ("keyframe", shift.keyframes)):
                if row.get(name):
                    row[name] = int(str(row[name])) + more
            yield {name: row[name] for name in COLUMNS if name in row}

    def events(self) -> list[Event]:
        """What happened in it, at the frames of the merged run."""
        return [
            replace(e, frame=e.frame + self.shift.frames, timestamp_s=e.timestamp_s + s)
            for s in (self.shift.stamp_s,)
            for e in read_events(self.path)
        ]

    def parts(self) -> list[Part]:
        """Its recordings. Raises InputError if they are not known or not there any more."""
        sequence, shift_s = find_sequence(self.path).absolute(), self.shift.stamp_s
        if is_joined(sequence):
            parts = read_parts(sequence)
            return [p.model_copy(update={"shift_s": p.shift_s + shift_s}) for p in parts]
        begin_s, end_s = self.frames.timestamps_s[[0, -1]].tolist()
        return [Part(sequence=str(sequence), begin_s=begin_s, end_s=end_s, shift_s=shift_s)]


def read_sources(paths: Sequence[Path]) -> list[Source]:
    """The runs, each after the one before it.

    Raises:
        InputError: fewer than two, one given twice, one that is not finished, or runs that cannot
            be one.
    """
    if len(paths) < 2:
        raise InputError("merge: give two runs or more")
    if len({path.resolve() for path in paths}) < len(paths):
        raise InputError("merge: a run is given twice; give each once")
    found: list[Source] = []
    for path in paths:
        found.append(_read_source(path, found[-1] if found else None))
        _check_alike(found[0], found[-1])
    for a, b in combinations(found, 2):
        _check_apart(a, b)
    labelled = [source for source in found if len(source.labels[0]) > 1]
    for source in labelled[1:]:
        _check_labels(labelled[0], source)
    return _with_markers(found)


def _read_source(path: Path, before: Source | None) -> Source:
    if not path.is_dir():
        raise InputError(f"{path}: no such folder; give the folder of a finished run")
    if not (path / MAP).is_file():
        cure = "run the sequence again, without --localise"
        if (path / CHECKPOINT).is_file():
            cure = f"finish the run by: bmask-slam run --resume {quote(str(path))}"
        raise InputError(f"{path}: holds no map, so it is not a finished run; {cure}")
    state, camera = read_map(path)
    config = resolve(SystemConfig, path / CONFIG if (path / CONFIG).is_file() else None)
    state = checked_state(state, SlamSystem(camera, config).state(), path / MAP)
    state = _without_foreign_stamps(state)
    frames = _frames_of(path / FRAMES, state)
    source = Source(path, state, camera, config, frames, Shift())
    if before is None:
        return source
    end_s, shift_s = before.span_s[1], 0.0
    if frames.timestamps_s[0] <= end_s:
        shift_s = float(math.ceil(end_s + GAP_S - frames.timestamps_s[0]))
    indices = before.frames.index.max() + before.shift.frames + 1
    shift = before.shift.after(before.state, int(indices - frames.index[0]), shift_s)
    return replace(source, shift=shift)


def _frames_of(path: Path, state: Arrays) -> FrameTable:
    """The frames of a run with a state. Raises InputError where they are not the map's."""
    frames, map_s = read_frames(path), state["mapper.history.timestamps_s"]
    if not len(frames):
        raise InputError(f"{path}: holds no frame; run the sequence again")
    stamps_s, index = frames.timestamps_s, frames.index
    rising = (np.diff(stamps_s) >= 0).all() and (np.diff(index) > 0).all()
    known = bool(rising) and bool((np.abs(stamps_s) < MAX_STAMP_S).all())
    known = known and index[0] >= 0 and index[-1] < MAX_INDEX
    inside = (map_s > stamps_s[0] - SLACK_S) & (map_s < stamps_s[-1] + SLACK_S)
    if not (known and inside.all()):
        raise InputError(f"{path}: its stamps or indices are not those of the map; run again")
    return frames


def _check_alike(first: Source, other: Source) -> None:
    """Refuse a run with another camera: the graph has one."""
    same = _without_times(first.camera), _without_times(other.camera)
    if same[0] != same[1]:
        names = [n for n, value in vars(same[0]).items() if getattr(same[1], n) != value]
        ours, theirs = (", ".join(f"{n} {getattr(c, n)}" for n in names) for c in same)
        raise InputError(
            f"{other.path}: made with another camera ({theirs}) than {first.path} ({ours}); only "
            "runs of one camera can be merged"
        )


def _check_apart(first: Source, other: Source) -> None:
    """Refuse a run whose images are in the other one: what they show would count twice."""
    ours, theirs = _seen_by(first.state), _seen_by(other.state)
    same, fewest = len(ours & theirs), min(len(ours), len(theirs))
    if same > MAX_SHARED * fewest:
        raise InputError(
            f"{other.path}: {same} keyframes are in {first.path} too, so what they show would "
            "count twice; leave one of the two out (a run that continued another, a merged run "
            "and the result of optimise have the whole map)"
        )


def _seen_by(state: Arrays) -> set[bytes]:
    """What each keyframe with features has seen: the bytes of its descriptors."""
    ends = np.cumsum(state["mapper.world.keyframes.keypoints"])[:-1]
    rows = np.split(state["mapper.world.keypoints.descriptors"], ends)
    return {hashlib.sha256(row.tobytes()).digest() for row in rows if len(row)}


def _without_times(camera: Camera) -> Camera:
    """The camera without what a run finds by itself, and without what only images have."""
    return replace(
        camera,
        rolling_shutter_s=0.0,
        depth_time_offset_s=0.0,
        depth_distortion=NO_DEPTH_DISTORTION,
        depth_noise=None,
        fps=1.0,
    )


def _check_labels(first: Source, other: Source) -> None:
    """Refuse a run with other labels; one without a segmenter has none."""
    (names, *more), (other_names, *other_more) = first.labels, other.labels
    surfaces = [s for s in (more[1], other_more[1]) if len(s) > 1]
    if (
        names != other_names
        or more[0] != other_more[0]
        or (surfaces and surfaces[0] != surfaces[-1])
    ):
        raise InputError(
            f"{other.path}: made with another segmenter than {first.path}, so that their labels "
            "differ; run one of them again with the other's, or with --segmenter none"
        )


def _with_markers(found: list[Source]) -> list[Source]:
    """The runs, of which the first has the settings of markers of one that has markers.

    Raises InputError for markers of several dictionaries: the same number is another marker there.
    """
    having = [source for source in found if source.has_markers]
    for source in having[1:]:
        ours, theirs = (s.config.sensors.markers.dictionary for s in (having[0], source))
        if ours != theirs:
            raise InputError(
                f"{source.path}: made with markers of {theirs}, and {having[0].path} with those of "
                f"{ours}; their numbers would be mixed up, run one of them again without --markers"
            )
    if not having or found[0].has_markers:
        return found
    markers = having[0].config.sensors.markers
    config = replace(found[0].config, sensors=replace(found[0].config.sensors, markers=markers))
    return [replace(found[0], config=config), *found[1:]]


def _without_foreign_stamps(state: Arrays) -> Arrays:
    """The state, with stamps of NaN of keyframes of recordings that the run continued.

    Their images are not those of the run's recording, and their stamps may be of another clock.
    """
    name = "mapper.world.keyframes."
    foreign = state[f"{name}id"] < state["first_keyframe"]
    stamps_s = np.where(foreign, np.nan, state[f"{name}timestamp_s"])
    return state | {f"{name}timestamp_s": stamps_s}
