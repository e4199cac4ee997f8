"""Fiducial markers in the graph: each is a pose that the keyframes which see it have in common.

A marker that is not where it was seen before has moved, or the map has drifted since. The common
landmarks of keyframes say how much it can have drifted: more is refused; if it is possible, the
sighting waits for `back_end.marker_loops`, which closes the loop or refuses it.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence

import numpy as np

from bmask_slam.events import EventLog
from bmask_slam.features.marker_detection import FREE, possible_poses
from bmask_slam.graph.arrays import Array, Arrays
from bmask_slam.graph.factors.checks import chi2_quantile, mahalanobis
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_update import (
    MARKER,
    SITE,
    PosePrior,
    RelativePose,
    RelativePoseName,
    marker_id,
    marker_of,
    site_id,
)
from bmask_slam.graph.factors.observability import diagonal_covariance
from bmask_slam.graph.geometry import inverse, se3_log
from bmask_slam.graph.sensors.markers import FoundMarker, MarkerMap, MarkersConfig, SeenCorners
from bmask_slam.graph.sensors.mounting import T_of
from bmask_slam.graph.sensors.odometry import kernel_of
from bmask_slam.graph.sensors.streams import SensorStreams
from bmask_slam.sensing.marker_sightings import (
    MarkerSight,
    Sighting,
    Verdict,
    chosen,
    drift_path,
    markers_in,
    of_keyframes,
    place_of,
    sightings_of,
    spread,
)
from bmask_slam.sensing.reference_frame import SIGMA_M, SIGMA_RAD, Made, SensorChanges
from bmask_slam.world.keyframe import Keyframe

PROBABILITY = 0.9999
"""Sightings that fit less well than all but this share do not fit."""
NOISE_PROBABILITY = 0.99
"""Corners that fit less well than all but this share have a larger sigma than was said."""
NEWEST = 20
"""So many sightings say where a marker is."""
MAX_SCALE = 3.0
"""Corners that fit worse than by so many times their sigma are not those of a square."""
SIZE_PRIOR = 0.002
"""A size by depth is never believed better than this, relative."""


class MarkerFusion:
    """Makes the factors of markers.

    Attributes:
        config: of markers.
        waiting: sightings that may close a loop; they are handled before the next frame.
        sizes: by marker without a known size: its logarithm times weight, and weight.
    """

    def __init__(self, config: MarkersConfig, events: EventLog) -> None:
        self.config = config
        self.waiting: list[Sighting] = []
        self.sizes: dict[int, tuple[float, float]] = {}
        self._refused: dict[RelativePoseName, tuple[float, float]] = {}  # size; of unknown markers
        self._events = events

    def changes(
        self,
        segment: int,
        keyframes: Sequence[Keyframe],
        sight: MarkerSight,
        streams: SensorStreams,
    ) -> SensorChanges:
        """The factors of a segment that can be made now: of its new keyframes, and known poses."""
        if not self.config.enabled:
            return SensorChanges()
        rows, factors = streams.of("markers"), []
        begun, places = dict[int, Array](), dict[int, Array | None]()
        self.waiting = [s for s in self.waiting if s.factor.keyframe_b in sight.world.keyframes]
        for keyframe, row in of_keyframes(keyframes, rows):
            key = marker_id(segment, int(row[1]))
            name = (key, keyframe.id, MARKER)
            if key not in places:
                places[key] = place_of(sight.tables, key)
            T_known, size = places[key], self.size_of(int(row[1]))
            is_done = T_known is not None or self._refused.get(name) == size
            if (name in sight.made and is_done) or any(s.factor.name == name for s in self.waiting):
                continue
            seen = self._sighting(name, SeenCorners.of(row[2:]), keyframe, T_known)
            found = self._verdict(seen, sight) if isinstance(seen, Sighting) else seen
            if found is None:
                continue
            sight.made[name] = float(found) if isinstance(found, Verdict) else np.nan
            if isinstance(found, Verdict) and T_known is None:
                self._refused[name] = size
            if isinstance(found, Sighting):
                if T_known is None:
                    begun[key] = places[key] = keyframe.T_world_camera @ inverse(found.factor.T_a_b)
                factors.append(found.factor)
                self._add_size(found)
        new = SensorChanges(
            np.array(list(begun), np.int64),
            np.array(list(begun.values())).reshape(-1, 4, 4),
            relative_poses=tuple(factors),
        )
        return new.with_more(self._site(segment, begun, sight))

    def _sighting(
        self,
        name: RelativePoseName,
        seen: SeenCorners,
        keyframe: Keyframe,
        T_world_marker: Array | None,
    ) -> Sighting | Verdict:
        """What a keyframe sees of a marker; of two poses the one that the map tells."""
        found = marker_of(name[0])
        assert found is not None
        poses = possible_poses(seen, *self.size_of(found[1]))
        if not poses:
            return Verdict.NO_SQUARE
        expected = None
        if T_world_marker is not None:
            expected = inverse(T_world_marker) @ keyframe.T_world_camera
        best = chosen(poses, expected)
        if best is None:
            return Verdict.AMBIGUOUS
        scale = best.chi2 / best.degrees
        if scale > MAX_SCALE**2:
            return Verdict.NO_SQUARE
        if best.chi2 <= chi2_quantile(NOISE_PROBABILITY, best.degrees):
            scale = 1.0
        robust = kernel_of(self.config.robust)
        T, covariance = best.T_marker_camera, scale * best.covariance
        factor = RelativePose(name[0], name[1], T, covariance, robust, MARKER)
        error = np.zeros(6) if expected is None else se3_log(inverse(T) @ expected)
        return Sighting(factor, best.log_size, best.log_size_sigma, error)

    def _verdict(self, found: Sighting, sight: MarkerSight) -> Sighting | Verdict | None:
        """The sighting if it fits the map; None if it waits, since it may close a loop."""
        earlier = sightings_of(sight.tables, found.factor.keyframe_a)
        if not earlier or not found.error.any():
            return found
        S = found.factor.covariance + spread(earlier[-NEWEST:], found.factor.T_a_b)
        gate = chi2_quantile(PROBABILITY, 6)
        still = sight.drift.map_covariances(np.zeros(2))
        if mahalanobis(found.error[None], (S + still)[None])[0] <= gate:
            return found
        path = drift_path(sight, found.factor.keyframe_b, [f.keyframe_b for f in earlier])
        drifted = sight.drift.map_covariances(path)
        if mahalanobis(found.error[None], (S + drifted)[None])[0] <= gate:
            self.waiting.append(found)
            return None
        self.tell_moved(found, sight.made)
        return Verdict.MOVED

    def tell_moved(self, found: Sighting, made: Made) -> None:
        """Say that a marker is not where it was, the first time."""
        key = found.factor.keyframe_a
        if any(name[0] == key and value == Verdict.MOVED for name, value in made.items()):
            return
        off_m = float(np.linalg.norm(found.error[3:]))
        off_deg = float(np.degrees(np.linalg.norm(found.error[:3])))
        self._events.sensor(
            f"marker {found.marker} in keyframe {found.factor.keyframe_b} is {off_m:.3f} m and "
            f"{off_deg:.1f} degrees from its place, more than the map can have drifted: refused, "
            "it was moved or misread",
            logging.WARNING,
        )

    def size_of(self, number: int) -> tuple[float, float]:
        """The logarithm of a marker's size in metres, and its sigma; FREE if it is not known."""
        size_m = self.config.size_of(number)
        if size_m is not None:
            return float(np.log(size_m)), self.config.size_sigma
        total, weight = self.sizes.get(number, (0.0, 0.0))
        if not weight:
            return 0.0, FREE
        return total / weight, max(weight**-0.5, SIZE_PRIOR)

    def _add_size(self, found: Sighting) -> None:
        """Remember the size that depth gives; what the prior says is not counted again."""
        if self.config.size_of(found.marker) is not None:
            return
        size, sigma = self.size_of(found.marker)
        own = found.log_size_sigma**-2 - sigma**-2
        if own > 0:
            mean = found.log_size
            if np.isfinite(sigma):
                mean = (found.log_size * found.log_size_sigma**-2 - size * sigma**-2) / own
            total, weight = self.sizes.get(found.marker, (0.0, 0.0))
            self.sizes[found.marker] = total + own * mean, weight + own

    def _site(self, segment: int, begun: Mapping[int, Array], sight: MarkerSight) -> SensorChanges:
        """The known poses of markers, in the frame of the site, which begins with the first."""
        site, factors, poses = site_id(segment), [], dict(begun)
        T_world_site = place_of(sight.tables, site)
        begins = T_world_site is None
        covariance = diagonal_covariance(self.config.sigma_rad, self.config.sigma_m)
        for row in self.config.poses:
            key, T_site_marker = marker_id(segment, row[0]), T_of(row[1:])
            name = (site, key, SITE)
            if key not in poses and (T := place_of(sight.tables, key)) is not None:
                poses[key] = T
            if key not in poses or (name in sight.made and not begins):
                continue
            if T_world_site is None:
                T_world_site = poses[key] @ inverse(T_site_marker)
            sight.made[name] = np.nan
            robust = kernel_of(self.config.robust)
            factors.append(RelativePose(site, key, T_site_marker, covariance, robust, SITE))
        if not begins or T_world_site is None:
            return SensorChanges(relative_poses=tuple(factors))
        prior = PosePrior(site, T_world_site, diagonal_covariance(SIGMA_RAD, SIGMA_M))
        return SensorChanges(np.array([site]), T_world_site[None], (prior,), tuple(factors))

    def map(
        self, tables: FactorTables, segment: int, sightings: Mapping[int, Mapping[str, int]]
    ) -> MarkerMap:
        """The markers of a map segment, with what became of their sightings."""
        found = []
        for key in markers_in(tables):
            where, number = marker_of(key) or (-1, -1)
            if where == segment:
                (T,) = tables.keyframes.get(np.array([key]))
                size, sigma = self.size_of(number)
                size_m = float(np.exp(size)) if np.isfinite(sigma) else np.nan
                used = len(sightings_of(tables, key))
                counts = sightings.get(key, {})
                seen = used + sum(n for what, n in counts.items() if what != "used")
                found.append(FoundMarker(number, size_m, T, seen, used))
        site = place_of(tables, site_id(segment))
        return MarkerMap(self.config.dictionary, site, tuple(found))

    def report(self, sightings: Mapping[int, Mapping[str, int]]) -> None:
        """Tell and count how many markers were seen, and what became of their sightings."""
        total: dict[str, int] = {}
        for counts in sightings.values():
            for what, number in counts.items():
                total[what] = total.get(what, 0) + number
        if not total:
            return
        seen, used = sum(total.values()), total.pop("used", 0)
        told = [f"{number} {what}" for what, number in sorted(total.items())]
        numbers = {marker_of(key) for key in sightings}
        self._events.sensor(
            f"{len(numbers)} markers seen {seen} times in keyframes: "
            + ", ".join([f"{used} sightings used", *told])
        )
        self._events.counts |= {
            "markers: number": len(numbers),
            "markers: seen": seen,
            "markers: used": used,
            "markers: refused": seen - used,
        }

    def state(self) -> Arrays:
        """The sizes so far."""
        rows = [(number, *sums) for number, sums in self.sizes.items()]
        return {"marker_sizes": np.array(rows, float).reshape(-1, 3)}

    def restore(self, state: Arrays) -> None:
        """Go on from a state."""
        rows = state["marker_sizes"].tolist()
        self.sizes = {int(number): (total, weight) for number, total, weight in rows}
