"""report.html of a run: figures, warnings, plots, pictures, objects, events and files."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from bmask_slam.evaluation.recordings import JOINED, OVERLAPPING, MergedClock, merged_clock
from bmask_slam.events import EventKind
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.whole_file import whole_file
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.reporting.metric_table import BY_NAME
from bmask_slam.reporting.page import Page, page_text
from bmask_slam.reporting.parts import Entry, Listing, Picture, Section, Table, TableRow, Tile
from bmask_slam.reporting.path_errors import find_reference, path_pictures, with_errors
from bmask_slam.reporting.picture_files import read_picture
from bmask_slam.reporting.run_plots import frame_pictures
from bmask_slam.run_folder.folder import REPORT
from bmask_slam.run_folder.frame_file import STAGES, FrameTable
from bmask_slam.run_folder.reader import Metric, Run
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import TrackingStatus

PICTURES = {
    "film.gif": "The run as a film",
    "objects.png": "Objects and landmarks from above",
    "dense/plan.png": "Floor plan",
    "dense/view_overview.png": "Dense map",
    "dense/view_overview_semantic.png": "Dense map in the colours of its labels",
    "dense/view_mesh.png": "Mesh",
}
ABOUT = {
    "trajectory.txt": "T_world_camera of every tracked frame, TUM format",
    "keyframes.txt": "the same of the keyframes",
    "frames.csv": "a line a frame: status, matches, milliseconds, keyframe",
    "events.csv": "a line for what happened",
    "landmarks.ply": "landmarks with colour, number of observations, id",
    "labels.csv": "label and surface of every landmark",
    "objects.json": "objects with label, box, keyframes",
    "graph": "the factor graph, which loads again",
    "map": "the whole map, for run --continue and run --localise",
    "metrics.json": "every figure of the run",
    "config.yaml": "the configuration; run --config takes it",
    "camera.yaml": "the camera that was found",
    "log.txt": "the log",
    "dense": "the dense map: cloud, mesh, floor plan, views",
}
MOST = 40
LOG_HEAD, LOG_TAIL, LINE_CHARACTERS = 6, 15, 400
FULLY_TRACKED = 0.95
PICTURE_PX = 1200
TOLD = (
    *("tracked_share", "ate_rmse", "rpe_trans_rmse_second", "frames_per_second"),
    *("loops_closed", "peak_rss_mb"),
)
FREQUENT = (EventKind.GRAPH, EventKind.LOOP_FOUND, EventKind.LOOP_REFUSED)
COUNTED = ("keyframes", "landmarks")
STAMPED = re.compile(r"^\S+ (\d\d:\d\d:\d\d)\S* [A-Z]+ \S+: (.*)$")
"""A line of log.txt: its date is left out, and which module wrote it."""
WARNED = re.compile(r"^\S+ \S+ (?:WARNING|ERROR|CRITICAL) \S+: (.*)$")
T = TypeVar("T")


def write_run_report(folder: Path, out: Path | None = None, reference: Path | None = None) -> Path:
    """Write one self-contained page about a run, also one that is not finished, to ``out``.

    None: report.html in the run's folder. A part whose files are missing is left out; one whose
    files are broken is named under the page's warnings. ``reference``: a trajectory or a sequence
    with one, against which all errors are; None: that of the run's sequence, if it is there, and
    the errors of metrics.json. The same files give the same bytes.

    Raises:
        InputError: no run, a broken reference or one of other times, or a page that is not written.
    """
    run, path = Run(folder), folder / REPORT if out is None else out
    if not path.parent.is_dir():
        raise InputError(f"{path.parent}: no such folder for the report; make it first")
    text = page_text(_RunReport(run, reference).page())
    with whole_file(path) as temporary:
        temporary.write_bytes(text.encode("utf-8", "replace"))
    return path


class _RunReport:
    """Reads the parts of a run; what is broken becomes a warning."""

    def __init__(self, run: Run, given: Path | None) -> None:
        self._run, self._given = run, given
        self._reference = find_reference(run, given)
        self._broken: list[str] = []
        merged = given and self._try(JOINED, lambda: merged_clock(run.path))
        self._clock = merged or MergedClock()
        if self._clock.overlapping:
            self._broken.append(OVERLAPPING % run.path)

    def page(self) -> Page:
        """The whole page; the warnings are put together last."""
        metrics = self._try("metrics.json", lambda: self._run.metrics) or {}
        if self._given and self._reference:
            files = self._run.path / "trajectory.txt", self._given
            metrics = with_errors(metrics, self._path(), self._reference, files)
        tiles = self._tiles(metrics)
        sections = [
            Section("Path and frames", pictures=tuple(self._plots())),
            self._map(),
            self._objects(),
            self._events(),
            self._numbers(metrics),
            self._files(),
            self._provenance(),
        ]
        shown = [s for s in (self._warnings(), *sections) if not s.empty]
        return Page(self._run.path.resolve().name, self._lead(), (), shown, tiles)

    def _try(self, name: str, read: Callable[[], T]) -> T | None:
        """What is read of a file; None without it, and, with a warning on the page, if broken."""
        if not (self._run.path / name).exists():
            return None
        try:
            return read()
        except InputError as error:
            self._broken.append(str(error))
            return None

    def _path(self) -> Trajectory | None:
        """The trajectory, by the stamps of a given reference."""
        path = self._try("trajectory.txt", lambda: self._run.trajectory)
        return None if path is None else self._clock.own_trajectory(path)

    def _lead(self) -> str:
        sequence = self._run.sequence
        what = f"a run of bmask-slam on {sequence}" if sequence else "a live run of bmask-slam"
        what += "" if self._run.is_finished else "; not finished"
        what += "" if self._given is None else f"; errors against {self._given}"
        return f"{what[0].upper()}{what[1:]}."

    def _warnings(self) -> Section:
        """What the log warns of, and what could not be read."""
        lines = self._try("log.txt", lambda: self._run.log) or ()
        found = (match[1] for line in lines if (match := WARNED.match(line)))
        counted = Counter(text[:LINE_CHARACTERS] for text in (*found, *dict.fromkeys(self._broken)))
        items = [f"{text} ({n} times)" if n > 1 else text for text, n in counted.items()]
        if len(items) > MOST:
            items = [*items[:MOST], f"and {len(items) - MOST} more: see log.txt"]
        return Section("Warnings", items=tuple(items))

    def _tiles(self, metrics: Mapping[str, Metric]) -> list[Tile]:
        tiles = []
        for name in (name for name in TOLD if name in metrics):
            metric, value = BY_NAME[name], metrics[name].value
            low = name == "tracked_share" and value < FULLY_TRACKED
            shown = f"{metric.scale * value:.{metric.digits}f}"
            tiles.append(Tile(metric.title, shown, metric.unit, failed=low))
        tiles += [Tile(n, f"{metrics[n].value:.0f}") for n in COUNTED if n in metrics]
        objects = self._try("objects.json", lambda: self._run.objects)
        tiles += [] if objects is None else [Tile("objects", str(len(objects)))]
        frames = self._try("frames.csv", lambda: self._run.frames)
        status = Counter(frames.status if frames is not None else ())
        bad = (kind.value for kind in (TrackingStatus.WEAK, TrackingStatus.LOST))
        tiles += [Tile(f"frames {k}", str(status[k]), failed=True) for k in bad if status[k]]
        return tiles

    def _plots(self) -> list[Picture]:
        """The path with the errors, if there is a reference, and plots over the frames."""
        events = self._clock.own_events(self._try("events.csv", lambda: self._run.events) or ())
        path = self._path()
        frames = self._try("frames.csv", lambda: self._run.frames)
        drawn = [] if path is None else path_pictures(path, events, self._reference)
        return drawn + ([] if frames is None else frame_pictures(frames))

    def _map(self) -> Section:
        """Pictures of the map, and the film."""
        read = (self._try(name, partial(self._picture, name)) for name in PICTURES)
        return Section("Map", pictures=tuple(picture for picture in read if picture is not None))

    def _picture(self, name: str) -> Picture:
        return replace(read_picture(self._run.path / name, PICTURES[name], PICTURE_PX), wide=True)

    def _objects(self) -> Section:
        read = self._try("objects.json", lambda: self._run.objects) or ()
        found = sorted(read, key=lambda o: -o.probability)
        rows = tuple(
            TableRow(
                f"{o.label} {o.id}",
                (
                    Entry(f"{100 * o.probability:.0f}"),
                    Entry(" × ".join(f"{m:.2f}" for m in o.box.size_m)),
                    Entry(", ".join(f"{m:.2f}" for m in o.centroid_world)),
                    Entry(str(len(o.keyframes))),
                ),
            )
            for o in found[:MOST]
        )
        caption = "The surest first; the world frame is that of the first keyframe's camera."
        if len(found) > MOST:
            caption += f" {len(found) - MOST} more are in objects.json."
        columns = ("sure (%)", "size (m)", "centre x, y, z (m)", "keyframes")
        table = Table("objects", "What was found", caption, columns, rows, "object")
        return Section("Objects", tables=(table,) if rows else ())

    def _events(self) -> Section:
        """What happened; of kinds that happen all the time only how often."""
        events = self._try("events.csv", lambda: self._run.events) or ()
        found = [event for event in events if event.kind not in FREQUENT]
        counts = Counter(event.kind.value for event in events if event.kind in FREQUENT)
        rows = tuple(
            TableRow(f"{e.frame}", (Entry(e.kind.value), Entry(e.text[:LINE_CHARACTERS])))
            for e in found[:MOST]
        )
        more = f" {len(found) - MOST} more are in events.csv." if len(found) > MOST else ""
        caption = f"By the frame of the sequence at which it happened.{more}"
        if counts:
            often = ", ".join(f"{kind} ({count})" for kind, count in counts.items())
            caption += f" Not listed: {often}."
        columns = ("event", "more")
        table = Table("events", "What happened", caption, columns, rows, "frame", prose=True)
        return Section("Events", tables=(table,) if rows else ())

    def _numbers(self, metrics: Mapping[str, Metric]) -> Section:
        """The times of the stages and all figures of metrics.json."""
        tables = []
        frames = self._try("frames.csv", lambda: self._run.frames)
        if frames is not None and (rows := tuple(_stage_rows(frames))):
            caption = "Milliseconds over the frames that passed the stage."
            columns = ("median", "95 %", "largest", "frames")
            tables.append(Table("stages", "Time of each stage", caption, columns, rows, "stage"))
        units = {name: "" if m.unit in (name, "1") else m.unit for name, m in metrics.items()}
        width = max(map(len, units.values()), default=0)
        text = "\n".join(f"{m.value:>11.6g} {units[n]:<{width}} {n}" for n, m in metrics.items())
        title = "metrics.json" if self._given is None else f"metrics.json, and {self._given}"
        listings = (Listing(title, text),) if metrics else ()
        return Section("Numbers", tables=tuple(tables), listings=listings)

    def _files(self) -> Section:
        rows = tuple(
            TableRow(name, (Entry(_size(self._run.path / name)), Entry(about)))
            for name, about in ABOUT.items()
            if (self._run.path / name).exists()
        )
        caption = f"In {self._run.path.resolve()}."
        table = Table("files", "Files", caption, ("size", "what"), rows, "file", prose=True)
        return Section("Files", tables=(table,))

    def _provenance(self) -> Section:
        """How the run was started, what differs from the default, and the end of its log."""
        lines = self._try("log.txt", lambda: self._run.log) or ()
        lines = tuple(STAMPED.sub(r"\1 \2", line)[:LINE_CHARACTERS] for line in lines)
        config = self._try("config.yaml", lambda: self._run.config)
        changed = [] if config is None else list(_changed(asdict(config)))
        texts: dict[str, Sequence[str]] = {
            "How it was started": lines[:LOG_HEAD],
            "Settings that are not the default": changed,
            "End of the log": lines[-LOG_TAIL:],
        }
        listings = [Listing(title, "\n".join(text)) for title, text in texts.items() if text]
        return Section("How it was made", listings=tuple(listings))


def _stage_rows(frames: FrameTable) -> Iterator[TableRow]:
    for stage in STAGES:
        spent_ms = frames.stage_ms[stage][np.isfinite(frames.stage_ms[stage])]
        if len(spent_ms):
            shown = (*np.percentile(spent_ms, (50, 95)), spent_ms.max())
            entries = (*(Entry(f"{ms:.1f}") for ms in shown), Entry(str(len(spent_ms))))
            yield TableRow(stage, entries)


def _changed(given: Mapping[str, Any]) -> Iterator[str]:
    """Settings that differ from the default, by dotted path."""
    before = dict(_flat(asdict(SystemConfig())))
    for path, value in _flat(given):
        if path in before and value != before[path]:
            yield f"{path} = {value}  (default: {before[path]})"


def _flat(tree: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{path}{key}.")
        else:
            yield f"{path}{key}", value


def _size(path: Path) -> str:
    """The size of a file, or of all files in a folder."""
    files = path.rglob("*") if path.is_dir() else [path]
    count = float(sum(f.lstat().st_size for f in files if f.is_file()))
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} GB"
