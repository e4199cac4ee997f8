"""Loops by fiducial markers: one that is seen again where the map can have drifted moves the map.

The sighting enters without a robust kernel, so that it moves the map however far that has drifted.
If it fits afterwards, it gets the kernel of all others, and the landmarks of both sides are fused;
if not, the marker was moved, and the sighting leaves the graph again.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from bmask_slam.back_end.segment_joining import move_segment
from bmask_slam.events import EventLog
from bmask_slam.graph.arrays import Array, no_pairs
from bmask_slam.graph.factors.checks import chi2_quantile, mahalanobis
from bmask_slam.graph.factors.graph_update import (
    LOOP,
    MARKER,
    RelativePose,
    RelativePoseName,
    marker_id,
    marker_of,
)
from bmask_slam.graph.geometry import inverse, se3_exp, se3_log
from bmask_slam.graph.smoother.smoother import Smoother
from bmask_slam.loops.closing import LoopCloser
from bmask_slam.loops.verification import LoopConstraint
from bmask_slam.sensing.marker_fusion import NEWEST, PROBABILITY
from bmask_slam.sensing.marker_sightings import (
    MIN_SHARED,
    MarkerSight,
    Sighting,
    drift_path,
    has,
    markers_in,
    sightings_of,
    spread,
)
from bmask_slam.sensing.sensor_fusion import SensorFusion
from bmask_slam.world.world_map import WorldMap

MIN_SIGHTINGS = 2
"""So many keyframes of each of two segments see a marker that joins them."""


class MapOwner(Protocol):
    """Has the graph, sensors and loops, and changes them; `back_end.mapper.Mapper` does."""

    world: WorldMap
    smoother: Smoother
    sensors: SensorFusion
    loops: LoopCloser
    events: EventLog

    def change_graph(self, **changes: Any) -> None:
        """Change the graph, and iterate until it converges."""

    def fuse(self, loops: list[LoopConstraint]) -> None:
        """Fuse the landmarks of both sides of loops."""

    def rebuild(self) -> None:
        """Build the graph anew, after segments were moved."""


def close_marker_loops(mapper: MapOwner) -> None:
    """Close the loops of sightings that wait, or refuse them."""
    unite_markers(mapper)
    markers, smoother = mapper.sensors.markers, mapper.smoother
    waiting, markers.waiting = markers.waiting, []
    known = smoother.tables.keyframes.ids
    waiting = [s for s in waiting if np.isin(s.factor.keyframe_ids, known).all()]
    if not waiting:
        return
    ends = [_older_end(mapper, s) for s in waiting]
    agreeing, before = _agreeing(mapper, waiting), _misfits(mapper)
    mapper.change_graph(relative_poses=tuple(replace(s.factor, robust=None) for s in agreeing))
    misfits, names = _misfits(mapper), {s.factor.name for s in agreeing}
    spoilt = misfits - before - names  # others fitted, and no longer do
    wrong = names if spoilt else names & misfits
    wrong |= {s.factor.name for s in waiting} - {s.factor.name for s in agreeing}
    for sighting in waiting:
        mapper.sensors.keep_verdict(sighting, moved=sighting.factor.name in wrong)
    kept = [(s, end) for s, end in zip(waiting, ends, strict=True) if s.factor.name not in wrong]
    mapper.change_graph(
        remove_relative_poses=tuple(sorted(names)), relative_poses=tuple(s.factor for s, _ in kept)
    )
    kept = [(s, end) for s, end in kept if not _is_covisible(mapper, end, s.factor.keyframe_b)]
    loops = [_to_fuse(end, s.factor.keyframe_b) for s, end in kept]
    for sighting, end in kept:
        off_m = float(np.linalg.norm(sighting.error[3:]))
        mapper.events.marker_loop((end, sighting.factor.keyframe_b), sighting.marker, off_m)
    if loops:
        mapper.fuse(loops)


def unite_markers(mapper: MapOwner) -> None:
    """Make one of the markers that two map segments had each, after these were joined.

    It concerns markers of earlier recordings: one that is not where the other segment saw it,
    farther than the map can have drifted, was moved in between, and its sightings are refused.
    """
    tables, world = mapper.smoother.tables, mapper.world
    for key in markers_in(tables):
        own, (segment, number) = sightings_of(tables, key), marker_of(key) or (0, 0)
        here = world.keyframes[own[0].keyframe_b].segment if own else segment
        home = marker_id(here, number)
        if home == key or not has(tables, home):
            continue
        sightings = [_seen_elsewhere(mapper, f, home) for f in own]
        fitting = [_fits(mapper, s) for s in sightings]
        moved = 2 * sum(fitting) < len(fitting)
        mapper.sensors.forget(f.name for f in own)
        for sighting in sightings:
            mapper.sensors.keep_verdict(sighting, moved)
        kept = () if moved else tuple(s.factor for s in sightings)
        mapper.change_graph(remove_keyframes=np.array([key]), relative_poses=kept)


def _seen_elsewhere(mapper: MapOwner, factor: RelativePose, home: int) -> Sighting:
    """A sighting as one of the same marker in another segment."""
    (T_world_marker,) = mapper.smoother.tables.keyframes.get(np.array([home]))
    T_world_camera = mapper.world.keyframes[factor.keyframe_b].T_world_camera
    error = se3_log(inverse(factor.T_a_b) @ inverse(T_world_marker) @ T_world_camera)
    return Sighting(replace(factor, keyframe_a=home), np.nan, np.nan, error)


def _fits(mapper: MapOwner, sighting: Sighting) -> bool:
    """Whether a marker is where it was seen before, as far as the map is certain of that."""
    tables, factor = mapper.smoother.tables, sighting.factor
    earlier = sightings_of(tables, factor.keyframe_a)
    if not earlier:
        return True
    sight = MarkerSight(mapper.world, tables, mapper.loops.noise, {})
    path = drift_path(sight, factor.keyframe_b, [f.keyframe_b for f in earlier])
    S = factor.covariance + spread(earlier[-NEWEST:], factor.T_a_b)
    S = S + mapper.loops.noise.map_covariances(path)
    return bool(mahalanobis(sighting.error[None], S[None])[0] <= chi2_quantile(PROBABILITY, 6))


def _older_end(mapper: MapOwner, sighting: Sighting) -> int:
    """The newest keyframe that saw the marker before."""
    earlier = sightings_of(mapper.smoother.tables, sighting.factor.keyframe_a)
    return max(f.keyframe_b for f in earlier)


def _is_covisible(mapper: MapOwner, a: int, b: int) -> bool:
    """Whether two keyframes have landmarks in common: then there is no loop to close."""
    first, second = (mapper.world.keyframes[k].landmark_ids for k in (a, b))
    shared = np.intersect1d(first, second)
    return int((shared >= 0).sum()) >= MIN_SHARED


def _agreeing(mapper: MapOwner, waiting: list[Sighting]) -> list[Sighting]:
    """The largest set of sightings that move the newest keyframe alike, or of several the least.

    What two markers say may differ by their noise, and by what the map errs between them.
    """
    still = 2 * mapper.loops.noise.map_covariances(np.zeros(2))
    gate, best = chi2_quantile(PROBABILITY, 6), (0, 0.0)
    chosen: list[Sighting] = []
    for one in waiting:
        off = np.array([se3_log(se3_exp(-one.error) @ se3_exp(o.error)) for o in waiting])
        S = np.array([one.factor.covariance + o.factor.covariance + still for o in waiting])
        agree = mahalanobis(off, S) <= gate
        score = int(agree.sum()), -float(np.linalg.norm(one.error))
        if score > best:
            best = score
            chosen = [o for o, fits in zip(waiting, agree.tolist(), strict=True) if fits]
    return chosen


def _misfits(mapper: MapOwner) -> set[RelativePoseName]:
    """Names of the sightings and loops that do not fit the graph."""
    found: set[RelativePoseName] = set()
    for kind in (MARKER, LOOP):
        errors = mapper.smoother.relative_pose_errors(
            kind, lambda T: mapper.loops.noise.map_covariances(np.zeros((len(T), 2)))
        )
        misfit = errors.chi2 > chi2_quantile(PROBABILITY, 6)
        ends = errors.keyframe_a[misfit].tolist(), errors.keyframe_b[misfit].tolist()
        found |= {(a, b, kind) for a, b in zip(*ends, strict=True)}
    return found


def _to_fuse(older: int, newer: int) -> LoopConstraint:
    """A loop of which only the ends are read: their landmarks are fused by projection."""
    return LoopConstraint(older, newer, np.eye(4), np.eye(6), 0, 1.0, no_pairs())


def join_by_markers(mapper: MapOwner, segment: int) -> Array | None:
    """Move a map segment into another one that has a marker in common with it.

    Each must have seen it in ``MIN_SIGHTINGS`` keyframes. Of several markers, or segments, that
    with most sightings counts. Returns T_other_segment (4, 4); None where there is no such marker.
    """
    tables, best, chosen = mapper.smoother.tables, 0, None
    seen = {key: sightings_of(tables, key) for key in markers_in(tables)}
    markers = {key: marker for key in seen if (marker := marker_of(key)) is not None}
    for key, (own_segment, number) in markers.items():
        for other, (other_segment, other_number) in markers.items():
            own, theirs = seen[key], seen[other]
            count = min(len(own), len(theirs))
            joins = own_segment == segment != other_segment and number == other_number
            if joins and count >= MIN_SIGHTINGS and count > best:
                best, chosen = count, (key, other, own[-1].keyframe_b, theirs[-1].keyframe_b)
    if chosen is None:
        return None
    T_segment_marker, T_other_marker = (tables.keyframes.get(np.array([k]))[0] for k in chosen[:2])
    T_other_segment: Array = T_other_marker @ inverse(T_segment_marker)
    (target, number), (older, newer) = markers[chosen[1]], sorted(chosen[2:])
    mapper.events.joined_by_marker(segment, target, number)
    move_segment(mapper.world, segment, T_other_segment, target)
    mapper.rebuild()
    mapper.fuse([_to_fuse(older, newer)])
    unite_markers(mapper)
    return T_other_segment
